import numpy as np
import pytest
from numba import njit

from gsplat_tools.kernels.half_floats import round_to_half

pytestmark = pytest.mark.uncompiled


@njit()
def fill(x, values):
    for i in range(len(x)):
        values[i] = round_to_half(x[i])


def rounded(x):  # type: ignore[no-untyped-def]
    values = np.empty_like(x)
    fill(x, values)
    return values


def test_round_to_half__equals_the_ieee_conversion_around_every_half() -> None:
    halves = np.arange(1 << 16, dtype=np.uint32).astype(np.uint16).view(np.float16)
    halves = np.sort(halves[np.isfinite(halves)].astype(np.float32))
    middles = (halves[:-1] + halves[1:]) / 2
    x = np.concatenate([halves, middles, np.nextafter(middles, np.float32(np.inf)), np.nextafter(middles, -np.float32(np.inf))])

    with np.errstate(over="ignore"):
        wanted = x.astype(np.float16).astype(np.float32)

    assert np.array_equal(rounded(x).view(np.uint32), wanted.view(np.uint32))


def test_round_to_half__overflows_to_infinity_and_keeps_nan() -> None:
    values = rounded(np.array([65519.9, 65520.0, -1e30, np.inf, -np.inf, np.nan], np.float32))

    assert values[0] == 65504
    assert values[1:5].tolist() == [np.inf, -np.inf, np.inf, -np.inf]
    assert np.isnan(values[5])
