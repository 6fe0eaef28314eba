"""Which splats hold values that no splat may hold; float32 is looked at as bits, so that loops stay integer and wide."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import kernel

_MAGNITUDE = np.uint32(0x7FFFFFFF)
_INFINITY = np.uint32(0x7F800000)  # as a magnitude; NaN is above

REFUSES_INFINITY, ALLOWS_NEGATIVE_INFINITY, ALLOWS_INFINITY = 0, 1, 2


@kernel()
def has_nonfinite(bits):
    """Return whether any value is NaN or infinite.

    bits  uint32 (M,)  read; float32 values seen as integers
    """
    largest = np.uint32(0)
    for i in range(bits.shape[0]):
        magnitude = np.uint32(bits[i] & _MAGNITUDE)
        largest = max(largest, magnitude)
    return largest >= _INFINITY


@kernel()
def has_zero_rows(bits):
    """Return whether any row is zero in all four places, of either sign.

    bits  uint32 (n, 4)  read; float32 values seen as integers
    """
    found = 0
    for i in range(bits.shape[0]):
        union = bits[i, 0] | bits[i, 1] | bits[i, 2] | bits[i, 3]
        found |= (union & _MAGNITUDE) == 0
    return found != 0


@kernel()
def mark_nonfinite(bits, policy, nan_code, infinity_code, codes):
    """Write the code of the first cause to splats that have none yet.

    bits           uint32 (n, W)  read; float32 values seen as integers
    policy         int            which infinities are legal: one of the constants above
    nan_code       int            cause for NaN, which comes before infinity
    infinity_code  int            cause for infinity
    codes          uint8 (n,)     read and written; 0 is valid
    """
    for i in range(bits.shape[0]):
        if codes[i] != 0:
            continue
        is_nan = False
        is_infinite = False
        for j in range(bits.shape[1]):
            magnitude = np.uint32(bits[i, j] & _MAGNITUDE)
            is_nan |= magnitude > _INFINITY
            if magnitude == _INFINITY:
                is_negative = bits[i, j] > _MAGNITUDE
                is_infinite |= policy == 0 or (policy == 1 and not is_negative)
        if is_nan:
            codes[i] = nan_code
        elif is_infinite:
            codes[i] = infinity_code


@kernel()
def mark_zero_rows(bits, code, codes):
    """Write the code to splats that have none yet and whose row is zero in all four places.

    bits   uint32 (n, 4)  read; float32 values seen as integers
    code   int            cause
    codes  uint8 (n,)     read and written; 0 is valid
    """
    for i in range(bits.shape[0]):
        union = bits[i, 0] | bits[i, 1] | bits[i, 2] | bits[i, 3]
        if codes[i] == 0 and (union & _MAGNITUDE) == 0:
            codes[i] = code
