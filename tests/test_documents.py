"""Tables in documents that follow from the code are those that the code has now."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_tables__are_as_make_docs_writes_them() -> None:
    documents = runpy.run_path(str(ROOT / "tools" / "make_docs.py"))["documents"]()

    assert [path.name for path in documents] == ["README.md", "tuning.md"]
    for path, text in documents.items():
        assert path.read_text(encoding="utf-8") == text, f"run tools/make_docs.py: {path.name} is behind"
