"""Quaternions in four bytes, (b - 128) / 128 a component, where the decoder normalizes: the search of the free scale.

A decoder that normalizes reads the direction of the stored 4-vector only, so that any lattice point near the ray through
the quaternion may be stored. The search walks the ray from saturation inwards and keeps the point at the smallest angle.
"""

import numpy as np

from gsplat_tools.kernels._jit import kernel

LANES = 64
"""Quaternions handled together, so that the compiler can use vector instructions."""

# A lattice point at distance r from the ray errs by r / scale, so that of the points good enough all but 2^-4 lie in the
# outer half of the ray; the steps are about a third of the mean distance between changes of the rounded point.
NUM_SCALES = 192
_SCALES = np.linspace(1.0, 0.5, NUM_SCALES).astype(np.float32)
_WEIGHTS = (1.0 / np.square(_SCALES.astype(np.float64))).astype(np.float32)

# Adding and subtracting 1.5 x 2^23 rounds a float32 below 2^22 to an integer, ties to even.
_ROUND = np.float32(12582912.0)
_POSITIVE_LIMIT = np.float32(127.49)
_NEGATIVE_LIMIT = np.float32(128.49)
_ZERO = np.float32(0)
_ONE = np.float32(1)


@kernel()
def quantize_reference(quats, out):
    """Unit quaternion x 128 + 128, rounded half up, clamped to 0..255.

    quats  float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    out    uint8 (N, 4)    written
    """
    for i in range(quats.shape[0]):
        square = 0.0
        for k in range(4):
            square += np.float64(quats[i, k]) * np.float64(quats[i, k])
        for k in range(4):
            value = (1.0 if k == 0 else 0.0) if square == 0.0 else np.float64(quats[i, k]) / np.sqrt(square)
            code = np.floor(value * 128.0 + 128.5)
            out[i, k] = np.uint8(max(0.0, min(255.0, code)))


@kernel()
def quantize_best(quats, out):
    """The lattice point at the smallest angle among those that rounding meets along the ray; w is stored >= 0.

    quats  float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    out    uint8 (N, 4)    written
    """
    unit = np.empty((4, LANES), np.float32)
    limit = np.empty(LANES, np.float32)
    best = np.empty(LANES, np.float32)
    best_scale = np.empty(LANES, np.float32)
    for start in range(0, quats.shape[0], LANES):
        count = min(LANES, quats.shape[0] - start)
        for j in range(LANES):
            i = start + (j if j < count else 0)
            w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
            square = w * w + x * x + y * y + z * z
            if square == 0.0:
                w, square = 1.0, 1.0
            factor = 1.0 / np.sqrt(square)
            if w < 0.0:
                factor = -factor
            unit[0, j] = np.float32(w * factor)
            unit[1, j] = np.float32(x * factor)
            unit[2, j] = np.float32(y * factor)
            unit[3, j] = np.float32(z * factor)
            largest = np.float32(1e9)
            for k in range(4):
                value = unit[k, j]
                if value > _ZERO:
                    largest = min(largest, _POSITIVE_LIMIT / value)
                elif value < _ZERO:
                    largest = min(largest, _NEGATIVE_LIMIT / -value)
            limit[j] = largest
            best[j] = np.float32(1e30)
            best_scale[j] = largest
        for c in range(NUM_SCALES):
            fraction = _SCALES[c]
            weight = _WEIGHTS[c]
            for j in range(LANES):
                scale = limit[j] * fraction
                a, b, e, f = unit[0, j] * scale, unit[1, j] * scale, unit[2, j] * scale, unit[3, j] * scale
                ra = ((a + _ROUND) - _ROUND) - a
                rb = ((b + _ROUND) - _ROUND) - b
                re = ((e + _ROUND) - _ROUND) - e
                rf = ((f + _ROUND) - _ROUND) - f
                along = ra * unit[0, j] + rb * unit[1, j] + re * unit[2, j] + rf * unit[3, j]
                across = (ra * ra + rb * rb + re * re + rf * rf - along * along) * weight
                is_better = across < best[j]
                best[j] = across if is_better else best[j]
                best_scale[j] = scale if is_better else best_scale[j]
        for j in range(count):
            for k in range(4):
                rounded = (unit[k, j] * best_scale[j] + _ROUND) - _ROUND
                out[start + j, k] = np.uint8(np.int32(rounded) + np.int32(128))
