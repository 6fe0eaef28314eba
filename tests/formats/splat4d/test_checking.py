import io
import math
import struct

import pytest

from gsplat_tools.formats.splat4d.checking import RULES, check
from tests.formats.splat4d import by_hand
from tests.formats.splat4d.by_hand import plain, record, with_band, with_deltas
from tests.formats.splat4d.test_reading import DELTA_LIES, LIES


def codes(data: bytes) -> dict[str, int]:
    issues = list(check(io.BytesIO(data)))
    assert {issue.code for issue in issues} <= set(RULES)
    return {issue.code: issue.count for issue in issues}


@pytest.mark.parametrize("data", [record(), plain().build(), with_band().build(), with_deltas(shares_labels=True).build()])
def test_check__finds_nothing_in_a_sound_file(data: bytes) -> None:
    assert codes(data) == {}


@pytest.mark.parametrize("name", LIES)
def test_check__names_every_lie(name: str) -> None:
    file = with_band()
    LIES[name](file)

    assert codes(file.build()) == {"label-range" if name == "label beyond the codebook" else "container": 1}


@pytest.mark.parametrize("name", DELTA_LIES)
def test_check__names_every_lie_of_a_delta(name: str) -> None:
    file = with_deltas()
    DELTA_LIES[name](file)

    found = codes(file.build())

    assert any(RULES[code].severity == "error" for code in found)


@pytest.mark.parametrize("data", [b"", bytes(65), b"SPL4DV03" + bytes(56)])
def test_check__names_what_is_of_neither_version(data: bytes) -> None:
    assert codes(data) == {"container": 1}


def test_check__counts_what_readers_repair() -> None:
    windows = plain(record(time=-1), record(time=math.nan), record(duration=2), record(quat=(128,) * 4))
    gaussians = plain(record(time=-1), record(time=math.inf), record(duration=0), record(duration=2), time_model=2)
    gaussians.sections[1] = by_hand.meta(cutoff=0)

    assert codes(windows.build()) == {"times-range": 2, "durations-range": 1, "zero-rotation": 1}
    assert codes(gaussians.build()) == {"temporal-cutoff": 1, "times-range": 1, "durations-range": 1}
    assert codes(record(time=5) * 3) == {"assumed-gaussian": 1}


def test_check__counts_labels_and_splats_that_change() -> None:
    file = with_band()
    file.sections[3].data = struct.pack("<3H", 7, 0, 8)

    assert codes(file.build()) == {"label-range": 2}
    assert codes(with_deltas().build()) == {"sh-over-time": 2}  # splats 0 and 2 change within segments
