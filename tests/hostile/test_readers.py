"""Every reader takes hostile files or refuses them with our errors, in time and within memory; the full run is a script."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

import pytest

from gsplat_tools.formats.registry import FORMATS
from tests.hostile.cases import Case, named, sample
from tests.hostile.corpus import seeds_of
from tests.hostile.judge import BASE_BYTES, judge
from tests.hostile.worker import judge_case, warm_up
from tests.hostile.workplace import Workplace

CASES = 2000
READABLE = [record.id for record in FORMATS.values() if record.read is not None]


@pytest.mark.parametrize("format_id", READABLE)
def test_hostile_file__is_read_or_refused_and_nothing_else(format_id: str, tmp_path: Path) -> None:
    place = Workplace(tmp_path)
    assert warm_up(format_id, place) == [], "a seed is not read: its mutants test nothing"

    outcomes: Counter[str] = Counter()
    found = []
    for case in sample(format_id, CASES):
        outcome, flaws = judge_case(format_id, case, place)
        outcomes[outcome] += 1
        found += [f"case {case.index} of {case.seed.name} ({case.what}), {flaw}" for flaw in flaws]

    assert found == []
    assert outcomes["read"] > 0
    assert outcomes.total() - outcomes["read"] > CASES // 4


@pytest.mark.parametrize("format_id", [format_id for format_id in READABLE if next(named(format_id), None)])
def test_file_for_one_rule__is_read_or_refused_and_nothing_else(format_id: str, tmp_path: Path) -> None:
    place = Workplace(tmp_path)
    warm_up(format_id, place)

    outcomes: Counter[str] = Counter()
    found = []
    for case in named(format_id):
        outcome, flaws = judge_case(format_id, case, place)
        outcomes[outcome] += 1
        found += [f"{case.what} of {case.seed.name}, {flaw}" for flaw in flaws]

    assert found == []
    assert outcomes["read"] > 0
    assert outcomes.total() > outcomes["read"]


def _judged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, read: object) -> list[str]:
    """What is said of a reader that does what `read` does."""
    from dataclasses import replace

    (seed,) = seeds_of("splat")
    record = replace(FORMATS["splat"], read=read, read_chunks=None)  # type: ignore[arg-type]
    monkeypatch.setitem(FORMATS, "splat", record)
    monkeypatch.setattr("tests.hostile.judge.SECONDS", 0.2)
    return [flaw.kind for flaw in judge(record, Workplace(tmp_path).put(Case(0, seed, "as it is", seed.data)))[1]]


def test_judge__notices_foreign_exceptions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def read(_stream: object, _options: object) -> None:
        raise IndexError("tuple index out of range")

    assert _judged(monkeypatch, tmp_path, read) == ["exception"]


def test_judge__notices_errors_that_do_not_say_where(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from gsplat_tools.errors import CorruptDataError

    def read(_stream: object, _options: object) -> None:
        raise CorruptDataError("something is wrong")

    assert _judged(monkeypatch, tmp_path, read) == ["no place"]


def test_judge__notices_foreign_warnings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import warnings

    from gsplat_tools.formats import splat

    def read(stream: BinaryIO, options: Any) -> Any:
        warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)
        return splat.read(stream, options)

    assert _judged(monkeypatch, tmp_path, read) == ["warning"]


def test_judge__notices_hangs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def read(_stream: object, _options: object) -> None:
        while True:
            pass

    assert _judged(monkeypatch, tmp_path, read) == ["hang"]


def test_judge__notices_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def read(_stream: object, _options: object) -> None:
        assert bytearray(b"\1") * (BASE_BYTES + (32 << 20))

    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("this system does not tell peaks of the resident set")
    assert "memory" in _judged(monkeypatch, tmp_path, read)
