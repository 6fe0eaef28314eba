"""The tables of docs/targets.md from what `bench_targets.py` printed.

Run: python benchmarks/targets_table.py OUTPUT.txt ...
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

LEVELS = ("35", "40", "45")
SHORT = {"balanced": "b."}


def rows(paths: list[Path]) -> Iterator[list[str]]:
    """Yield the cells of every row that was measured."""
    for path in paths:
        for line in path.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.strip("| ").split("|")]
            if line.startswith("|") and len(cells) > 3 and cells[0] != "scene":
                yield cells


def level_cell(cells: list[str]) -> tuple[str, float | None]:
    """Return what a row says of one level, and its ratio to the smallest preset where one reaches the level."""
    found = cells[3]
    ceiling = re.search(r"the finest has ([\d.]+) dB in the worst view at (\d+) bytes", found)
    if ceiling:
        return f"c {ceiling[1]}, {int(ceiling[2]):,}", None
    beside, ratio, level = cells[4:7]
    if not ratio:
        return f"{found} ({level}), none", None
    size, _, preset = beside.partition(" ")
    return f"{float(ratio):.2f}: {found} / {size} {SHORT.get(preset, preset)} ({level})", float(ratio)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("outputs", nargs="+", type=Path)
    levels: dict[tuple[str, str], dict[str, str]] = {}
    ratios: list[float] = []
    autos: list[str] = []
    for cells in rows(parser.parse_args().outputs):
        scene, target, what = cells[:3]
        if what in LEVELS:
            levels.setdefault((scene, target), {})[what], ratio = level_cell(cells)
            ratios += [] if ratio is None else [ratio]
        elif what == "auto":
            size, level, smaller, reached = cells[3:7]
            lost = "0.00" if reached == "inf" else f"{max(0.0, float(level) - float(reached)):.2f}"
            saved = 1 - int(smaller.replace(",", "")) / int(size.replace(",", ""))
            autos.append(f"| {scene} | {target} | {size} | {level} | {smaller} | {reached} | {saved:.0%} | {lost} |")
    print(f"{len(ratios)} cases with a preset that reaches the level, ratios {min(ratios):.3f} to {max(ratios):.3f}\n")
    print("| scene | format | 35 dB | 40 dB | 45 dB |\n|---|---|---|---|---|")
    for (scene, target), found in levels.items():
        print(f"| {scene} | {target} | {' | '.join(found.get(level, 'not run') for level in LEVELS)} |")
    print("\n| scene | format | best, bytes | dB | auto, bytes | dB | saved | dB lost |\n|---|---|---|---|---|---|---|---|")
    print("\n".join(autos))


if __name__ == "__main__":
    main()
