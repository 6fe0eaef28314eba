from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.attributes.activations import exp_scales, log_scales, logit, sigmoid


def _ulps(found: np.float32, exact: mpmath.mpf) -> float:
    return float(abs(mpmath.mpf(float(found)) - exact) / mpmath.mpf(float(np.spacing(np.abs(found)))))


@given(st.floats(-80, 80, width=32))
def test_sigmoid__is_within_a_rounding_of_the_exact_value(x: float) -> None:
    with mpmath.workdps(40):
        exact = 1 / (1 + mpmath.exp(-mpmath.mpf(x)))

        assert _ulps(sigmoid(np.float32([x]))[0], exact) <= 0.5001


@given(st.floats(2.0**-100, 1 - 2.0**-24, width=32))
def test_logit__is_within_a_rounding_of_the_exact_value(p: float) -> None:
    with mpmath.workdps(40):
        exact = mpmath.log(mpmath.mpf(p)) - mpmath.log(1 - mpmath.mpf(p))

        # Near p = 1/2 the logarithms cancel; float64 leaves an absolute error of 2^-53 or so.
        assert (
            abs(float(logit(np.float32([p]))[0]) - float(exact)) <= 0.5001 * float(np.spacing(np.float32(abs(exact)))) + 3e-16
        )


def test_activations__keep_the_ends() -> None:
    ends = np.float32([-np.inf, np.inf])

    np.testing.assert_array_equal(sigmoid(ends), np.float32([0, 1]))
    np.testing.assert_array_equal(logit(np.float32([0, 1])), ends)
    np.testing.assert_array_equal(exp_scales(np.float32([-np.inf, 89])), np.float32([0, np.inf]))
    np.testing.assert_array_equal(log_scales(np.float32([0])), np.float32([-np.inf]))
    assert np.isnan(logit(np.float32([-0.1, 1.1, np.nan]))).all()
    assert np.isnan(log_scales(np.float32([-1, np.nan]))).all()
    assert np.isnan(sigmoid(np.float32([np.nan]))).all()


@pytest.mark.parametrize("function", [sigmoid, logit, exp_scales, log_scales])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_activations__keep_shape_and_dtype(function, dtype) -> None:
    result = function(np.full((2, 3), 0.25, dtype))

    assert result.dtype == dtype
    assert result.shape == (2, 3)


def test_sigmoid__saturates_where_float32_does() -> None:
    # 1 - 2^-25 is the last value below the midpoint to 1: logit 17.33.
    assert sigmoid(np.float32([17.4]))[0] == 1
    assert sigmoid(np.float32([16.6]))[0] < 1
    assert sigmoid(np.float32([-100]))[0] == pytest.approx(math.exp(-100), rel=1e-4)


def test_scales__invert_their_logarithms() -> None:
    logs = np.linspace(-30, 30, 1001).astype(np.float32)

    # exp loses half an ulp of its result, relative 2^-24, which is an absolute 2^-24 of the logarithm.
    np.testing.assert_allclose(log_scales(exp_scales(logs)), logs, rtol=2.0**-23, atol=2.0**-23)
