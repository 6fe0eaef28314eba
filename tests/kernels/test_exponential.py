import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from gsplat_tools.kernels.exponential import exp_nonpositive


@njit()
def fill(x, values):
    for i in range(len(x)):
        values[i] = exp_nonpositive(x[i])


def evaluate(x):  # type: ignore[no-untyped-def]
    values = np.empty_like(x)
    fill(x, values)
    return values


def test_exp_nonpositive__errs_by_at_most_two_units_in_the_last_place() -> None:
    x = np.concatenate([np.linspace(-86.9, 0, 200_001), -np.logspace(-40, 1.9, 50_000)]).astype(np.float32)

    values, exact = evaluate(x), np.exp(x.astype(np.float64))

    assert np.abs((values - exact) / np.spacing(exact.astype(np.float32))).max() <= 2
    assert evaluate(np.zeros(1, np.float32))[0] == 1


def test_exp_nonpositive__is_zero_far_down_and_for_nan() -> None:
    assert not evaluate(np.array([-87.5, -1e30, -np.inf, np.nan], np.float32)).any()


def test_exp_nonpositive__never_exceeds_one_nor_its_neighbour_by_more_than_an_ulp() -> None:
    x = np.linspace(-8, 0, 100_001).astype(np.float32)
    values = evaluate(x)

    assert values.max() == 1
    assert np.all(np.diff(values) >= -np.spacing(values[:-1]))


@given(st.floats(-700, 0))
def test_exp_nonpositive__is_the_library_function_in_float64(x: float) -> None:
    assert evaluate(np.array([x]))[0] == math.exp(x)
