"""Rounding to half precision without a half type."""

import numpy as np

from gsplat_tools.kernels._jit import device

_SMALLEST_NORMAL = np.float32(2.0**-14)
_OVERFLOW = np.float32(65520.0)
# Numbers in [0.5, 1) have steps of 2^-24, the step of half subnormals.
_SUBNORMAL_SHIFT = np.float32(0.75)
_SIGN = np.uint32(0x80000000)
_INFINITY = np.float32(np.inf)


@device()
def round_to_half(x):
    """Return x rounded to the nearest half, ties to even; subnormals are kept, overflow gives infinity."""
    single = np.float32(x)
    size = np.float32(abs(single))
    if size < _SMALLEST_NORMAL:
        rounded = np.float32(np.float32(size + _SUBNORMAL_SHIFT) - _SUBNORMAL_SHIFT)
    elif size < _OVERFLOW:
        bits = np.float32(size).view(np.uint32)
        odd = np.uint32((bits >> np.uint32(13)) & np.uint32(1))
        rounded = np.uint32((bits + np.uint32(0x0FFF) + odd) & np.uint32(0xFFFFE000)).view(np.float32)
    elif size >= _OVERFLOW:
        rounded = _INFINITY
    else:
        return single
    # By its bit, so that -0 keeps its sign.
    sign = np.uint32(np.float32(single).view(np.uint32) & _SIGN)
    return np.uint32(np.float32(rounded).view(np.uint32) | sign).view(np.float32)
