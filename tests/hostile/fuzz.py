"""The full run over every reader: `python -m tests.hostile.fuzz --help`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

from gsplat_tools.formats.registry import FORMATS
from tests.hostile.cases import Case, cases, make_mutant, num_systematic
from tests.hostile.worker import Result, batches, judge_case, run, warm_up
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
    results = {format_id: Result() for format_id in formats}
    for turn in _turns(formats, given.cases):
        for format_id, part in turn:
            result = results[format_id]
            run(format_id, [part], result)
            print(f"{format_id}: {result.cases} files in {result.seconds:.0f} s, {len(result.flaws)} flaws", flush=True)
        if given.report:
            given.report.write_text(
                json.dumps({name: _figures(name, result) for name, result in results.items()}, indent=2) + "\n"
            )
    figures = {name: _figures(name, result) for name, result in results.items()}
    print(table(figures))
    for format_id, result in results.items():
        for kind, flaw in result.flaws.items():
            print(f"{format_id}: {kind}, {flaw['count']} times, first case {flaw['case']}: {flaw['detail']}")
    return int(any(result.flaws for result in results.values()))


def _turns(formats: list[str], wanted: int) -> Iterator[list[tuple[str, tuple[int, int]]]]:
    """Yield the next batch of every format, systematic cases and mutants in turn: a run that is ended early is of all kinds."""
    queues = []
    for format_id in formats:
        systematic = num_systematic(format_id)
        mutants = max(wanted - systematic, min(LEAST_MUTANTS, wanted))
        both = zip_longest(batches(0, systematic), batches(systematic, systematic + mutants))
        queues.append([(format_id, part) for pair in both for part in pair if part is not None])
    for turn in zip_longest(*queues):
        yield [item for item in turn if item is not None]


def _figures(format_id: str, result: Result) -> dict[str, Any]:
    return {
        "systematic": num_systematic(format_id),
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
