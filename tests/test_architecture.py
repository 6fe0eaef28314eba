"""Rules of the layout that no other tool checks."""

import ast
import re
from pathlib import Path

import pytest

from gsplat_tools.formats.registry import FORMATS

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "gsplat_tools").rglob("*.py"))
MAX_LINES = 420


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_module__is_small_enough_to_read_whole(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


@pytest.mark.parametrize("path", sorted((ROOT / "tests" / "oracles").glob("*.py")), ids=name_of)
def test_oracle__imports_nothing_that_it_judges(path: Path) -> None:
    if path.name.startswith("test_"):
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
        assert not any(name.startswith("gsplat_tools") for name in names), f"line {node.lineno}"  # type: ignore[attr-defined]


@pytest.mark.parametrize("path", [p for p in MODULES if "kernels" not in p.parts], ids=name_of)
def test_module__imports_kernels_only_inside_functions_of_formats(path: Path) -> None:
    """Inspecting a header must not load the compiler."""
    if not {"formats", "cli"} & set(path.parts):
        return
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            assert not (node.module or "").startswith("gsplat_tools.kernels"), f"line {node.lineno}"


@pytest.mark.parametrize("record", FORMATS.values(), ids=lambda record: record.id)
def test_format__is_documented_with_a_byte_table(record: object) -> None:
    page = ROOT / record.spec  # type: ignore[attr-defined]

    assert page.is_file()
    assert "|" in page.read_text(encoding="utf-8")


def test_public_functions__document_every_parameter() -> None:
    missing = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_") or "kernels" in path.parts:
                continue
            docstring = ast.get_docstring(node) or ""
            if "Parameters\n" not in docstring:
                continue
            arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            section = docstring.split("Parameters\n", 1)[1]
            missing += [
                f"{name_of(path)}:{node.name}:{a.arg}"
                for a in arguments
                if a.arg not in {"self", "cls"} and a.arg[0] != "_" and a.arg not in section
            ]
    assert missing == []


@pytest.mark.parametrize(
    "page", sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/README.md")]), ids=name_of
)
def test_document__links_to_what_is_there(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))

    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]

    assert missing == []
