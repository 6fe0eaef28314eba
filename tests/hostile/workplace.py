"""Where hostile files lie while they are read: each seed has a folder of its own with the files beside it."""

from __future__ import annotations

from pathlib import Path

from tests.hostile.cases import Case
from tests.hostile.seed import Seed


class Workplace:
    """Writes cases below a folder."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folders: dict[str, Path] = {}

    def put(self, case: Case) -> Path:
        """Write a case and return its path."""
        path = self._folder(case.seed) / case.seed.filename
        path.write_bytes(case.data)
        return path if case.seed.target is None else path.with_name(case.seed.target)

    def _folder(self, seed: Seed) -> Path:
        key = f"{seed.filename} {seed.name}"
        if key not in self._folders:
            folder = self._root / str(len(self._folders))
            for name, data in seed.beside.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(data)
            folder.mkdir(parents=True, exist_ok=True)
            self._folders[key] = folder
        return self._folders[key]
