"""The full run over every reader: `python -m tests.hostile.fuzz --help`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from gsplat_tools.formats.registry import FORMATS
from tests.hostile.cases import Case, cases, make_mutant, num_systematic
from tests.hostile.worker import Result, judge_case, run, warm_up
from tests.hostile.workplace import Workplace

LEAST_MUTANTS = 10_000
"""Mutants of a format whose systematic cases alone are as many as was asked for."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/reliability fuzz", description="Feed hostile files to every reader.")
    parser.add_argument("--cases", type=int, default=100_000, help="files a format, at least (default 100000)")
    parser.add_argument("--format", action="append", choices=list(FORMATS), help="only this one; may be repeated")
    parser.add_argument("--case", type=int, help="judge one numbered case again and say what it was")
    parser.add_argument("--report", type=Path, help="write the figures as JSON, format by format as they are known")
    given = parser.parse_args()
    formats = given.format or [record.id for record in FORMATS.values() if record.read is not None]
    if given.case is not None:
        return _again(formats[0], given.case)
    results = {}
    for format_id in formats:
        systematic = num_systematic(format_id)
        result = run(format_id, 0, max(given.cases, systematic + min(LEAST_MUTANTS, given.cases)), report=True)
        results[format_id] = {"systematic": systematic, **_figures(result)}
        if given.report:
            given.report.write_text(json.dumps(results, indent=2) + "\n")
    print(table(results))
    for format_id, figures in results.items():
        for kind, flaw in figures["flaws"].items():
            print(f"{format_id}: {kind}, {flaw['count']} times, first case {flaw['case']}: {flaw['detail']}")
    return int(any(figures["flaws"] for figures in results.values()))


def _figures(result: Result) -> dict[str, Any]:
    return {
        "cases": result.cases,
        "read": result.outcomes["read"],
        "refused": result.outcomes.total() - result.outcomes["read"],
        "errors": dict(result.outcomes.most_common()),
        "seconds": round(result.seconds),
        "flaws": result.flaws,
    }


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return the figures as rows of Markdown."""
    lines = ["| reader | files | systematic | read | refused | flaws |", "|---|---:|---:|---:|---:|---:|"]
    lines += [
        f"| {name} | {f['cases']:,} | {f['systematic']:,} | {f['read']:,} | {f['refused']:,} | {len(f['flaws'])} |"
        for name, f in results.items()
    ]
    return "\n".join(lines)


def _again(format_id: str, index: int) -> int:
    """Judge one case and print what was done to which seed."""
    case: Case = (
        next(iter(cases(format_id, index, index + 1))) if index < num_systematic(format_id) else make_mutant(format_id, index)
    )
    with tempfile.TemporaryDirectory() as folder:
        place = Workplace(Path(folder))
        warm_up(format_id, place)
        outcome, flaws = judge_case(format_id, case, place)
    print(f"{format_id} case {index}: seed {case.seed.name!r}, {case.what}, {len(case.data)} bytes: {outcome}")
    for flaw in flaws:
        print(f"  {flaw.step}: {flaw.kind}: {flaw.detail}")
    return int(bool(flaws))


if __name__ == "__main__":
    sys.exit(main())
