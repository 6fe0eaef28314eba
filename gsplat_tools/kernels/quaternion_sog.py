"""Smallest three components of a quaternion in 8 bits each."""

import numpy as np

from gsplat_tools.kernels._jit import kernel

_STEPS = 127.5 * np.sqrt(2.0)


@kernel()
def quantize(quats, codes):
    """Three bytes of the smaller components in order, rounded, then 252 + index of the largest, which is positive.

    quats  float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    codes  uint8 (N, 4)    written
    """
    for i in range(quats.shape[0]):
        square = 0.0
        largest = 0
        for k in range(4):
            square += np.float64(quats[i, k]) * np.float64(quats[i, k])
            if abs(quats[i, k]) > abs(quats[i, largest]):
                largest = k
        factor = _STEPS / np.sqrt(1.0 if square == 0.0 else square)
        factor = -factor if quats[i, largest] < 0.0 else factor
        place = 0
        for k in range(4):
            if k != largest:
                code = np.floor(np.float64(quats[i, k]) * factor + 128.0)
                codes[i, place] = np.uint8(max(0.0, min(255.0, code)))
                place += 1
        codes[i, 3] = np.uint8(252 + largest)
