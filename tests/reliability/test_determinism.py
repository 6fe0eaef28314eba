"""The same scene gives the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.reliability.cases import Case, cases
from tests.reliability.determinism import JOBS, differences, digests, in_fresh_process

SPLATS = 17_000
"""Two blocks of work, so that threads have something to share."""
RUNS = 3


@pytest.fixture(scope="module")
def found() -> dict[str, str]:
    return digests(SPLATS, 1)


def test_bytes__are_the_same_in_every_run_for_any_number_of_threads(found: dict[str, str]) -> None:
    for _ in range(RUNS):
        for jobs in JOBS:
            assert differences(found, digests(SPLATS, jobs)) == []


def test_bytes__are_the_same_in_another_process_that_compiles_its_kernels(found: dict[str, str], tmp_path: Path) -> None:
    assert differences(found, in_fresh_process(SPLATS, 2, hash_seed=12345, cache=tmp_path)) == []
    assert any(tmp_path.rglob("*.nbc"))


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.id)
def test_bytes__tell_scenes_apart(case: Case, tmp_path: Path) -> None:
    case.write(tmp_path / case.name, 20, 1)
    first = case.content(tmp_path / case.name)

    case.write(tmp_path / case.name, 20, 2)

    assert case.content(tmp_path / case.name) != first
