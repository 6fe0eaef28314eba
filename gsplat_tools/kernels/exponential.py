"""Exponential that gives the same bits on every machine in float32, and vectorizes."""

import math

import numpy as np
from numba import types
from numba.extending import overload

_LOG2_E = np.float32(1.0 / math.log(2.0))
_ROUNDING = np.float32(1.5 * 2.0**23)
_ROUNDING_BITS = np.int32(0x4B400000)
# ln 2 in two parts; the first has nine bits, so that its products with small integers are exact.
_LN2_HIGH = np.float32(355.0 / 512.0)
_LN2_LOW = np.float32(math.log(2.0) - 355.0 / 512.0)
_TAYLOR = tuple(np.float32(1.0 / math.factorial(k)) for k in range(2, 8))
_LOWEST = np.float32(-87.0)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_BIAS = np.int32(127)
_MANTISSA_BITS = np.int32(23)


def exp_nonpositive(x):
    """Return exp(x) for x <= 0 in the type of x; float32 errs by at most 2 units in the last place.

    In float32 results below exp(-87) are 0, and NaN gives 0.
    """
    return np.exp(x)


@overload(exp_nonpositive, jit_options={"nogil": True, "error_model": "numpy"})
def _overload_exp_nonpositive(x):
    if x == types.float32:
        c2, c3, c4, c5, c6, c7 = _TAYLOR

        def single(x):
            # x = n ln 2 + r with |r| <= ln 2 / 2, where the Taylor polynomial of degree 7 errs by 5e-9.
            y = max(_LOWEST, x)
            shifted = y * _LOG2_E + _ROUNDING
            n = shifted - _ROUNDING
            r = (y - n * _LN2_HIGH) - n * _LN2_LOW
            tail = ((((c7 * r + c6) * r + c5) * r + c4) * r + c3) * r + c2
            value = (tail * (r * r) + r) + _ONE
            exponent = np.int32(np.float32(shifted).view(np.int32) - _ROUNDING_BITS + _BIAS)
            power = np.int32(exponent << _MANTISSA_BITS).view(np.float32)
            return value * power if x > _LOWEST else _ZERO

        return single

    def double(x):
        return math.exp(x)

    return double
