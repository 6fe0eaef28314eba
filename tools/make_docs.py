"""Write the tables of the documents that follow from the code: formats in README.md, presets and knobs in docs/tuning.md."""

from __future__ import annotations

from pathlib import Path

from gsplat_tools.cli._tuning import knob_table
from gsplat_tools.formats.registry import FORMATS

ROOT = Path(__file__).parents[1]


def formats_table() -> str:
    """One row a format, from its record."""
    rows = ["| format | id | extension | read | write | SH | streams |", "|---|---|---|---|---|---|---|"]
    for record in FORMATS.values():
        cells = (
            f"[{record.title}]({record.spec})",
            f"`{record.id}`",
            " ".join(record.extensions),
            "yes" if record.read else "no",
            "yes" if record.write else "no",
            f"0-{record.max_sh_degree}",
            "yes" if record.streams else "no",
        )
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def with_table(text: str, name: str, table: str) -> str:
    """Replace what stands between the markers of a table."""
    start, stop = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    before, rest = text.split(start)
    return f"{before}{start}{table}\n{stop}{rest.split(stop)[1]}"


def documents() -> dict[Path, str]:
    """Return what the documents should say, by path."""
    tables = {ROOT / "README.md": ("formats", formats_table()), ROOT / "docs" / "tuning.md": ("knobs", knob_table())}
    return {path: with_table(path.read_text(encoding="utf-8"), *table) for path, table in tables.items()}


def main() -> None:
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
