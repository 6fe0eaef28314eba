"""Quaternions in four bytes, (b - 128) / 128 a component, where the decoder normalizes: the search of the free scale.

A decoder that normalizes reads the direction of the stored 4-vector only, so that any lattice point near the ray through
the quaternion may be stored. The search walks the ray from saturation inwards and keeps the point at the smallest angle.
"""

import numpy as np

from gsplat_tools.kernels._jit import kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS

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
_QUATS = FRAME_QUATS.astype(np.float32)


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


NUM_FRAME_SCALES = 48
"""Scales that are tried in each of 24 frames; more of them gain little against more frames."""
_FRAME_SCALES = np.linspace(1.0, 0.5, NUM_FRAME_SCALES).astype(np.float32)
_FRAME_WEIGHTS = (1.0 / np.square(_FRAME_SCALES.astype(np.float64))).astype(np.float32)


@kernel()
def quantize_in_frames(quats, log_scales, out, frames):
    """Codes in the frame and at the scale with the smallest error of the covariance; ties take the first frame.

    With l the squared scales and d the vector part of the turn from the source to the stored rotation in local axes, the
    error is 8 sum_k (l_i - l_j)^2 d_k^2 to second order, where i and j are the axes other than k.

    quats       float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    log_scales  float32 (N, 3)  read
    out         uint8 (N, 4)    written
    frames      uint8 (N,)      written
    """
    unit = np.empty((4, LANES), np.float32)
    turned = np.empty((4, LANES), np.float32)
    limit = np.empty(LANES, np.float32)
    weights = np.empty((3, LANES), np.float32)
    best = np.empty(LANES, np.float32)
    best_frame = np.empty(LANES, np.int32)
    best_scale = np.empty(LANES, np.float32)
    codes = np.empty((4, LANES), np.float32)
    for start in range(0, quats.shape[0], LANES):
        count = min(LANES, quats.shape[0] - start)
        for j in range(LANES):
            i = start + (j if j < count else 0)
            w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
            square = w * w + x * x + y * y + z * z
            if square == 0.0:
                w, square = 1.0, 1.0
            factor = 1.0 / np.sqrt(square)
            unit[0, j] = np.float32(w * factor)
            unit[1, j] = np.float32(x * factor)
            unit[2, j] = np.float32(y * factor)
            unit[3, j] = np.float32(z * factor)
            s0, s1, s2 = np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]), np.float64(log_scales[i, 2])
            longest = max(s0, s1, s2)
            if longest == -np.inf:
                longest = 0.0
            l0, l1, l2 = np.exp(2.0 * (s0 - longest)), np.exp(2.0 * (s1 - longest)), np.exp(2.0 * (s2 - longest))
            weights[0, j] = np.float32((l1 - l2) * (l1 - l2))
            weights[1, j] = np.float32((l2 - l0) * (l2 - l0))
            weights[2, j] = np.float32((l0 - l1) * (l0 - l1))
            best[j] = np.float32(1e30)
            best_frame[j] = np.int32(0)
        for f in range(24):
            a, b, c, d = _QUATS[f, 0], _QUATS[f, 1], _QUATS[f, 2], _QUATS[f, 3]
            kx, ky, kz = FRAME_AXES[f, 0], FRAME_AXES[f, 1], FRAME_AXES[f, 2]
            frame = np.int32(f)
            for j in range(LANES):
                w, x, y, z = unit[0, j], unit[1, j], unit[2, j], unit[3, j]
                p = w * a - x * b - y * c - z * d
                sign = _ONE if p >= _ZERO else -_ONE
                turned[0, j] = p * sign
                turned[1, j] = (w * b + x * a + y * d - z * c) * sign
                turned[2, j] = (w * c - x * d + y * a + z * b) * sign
                turned[3, j] = (w * d + x * c - y * b + z * a) * sign
                highest = max(turned[0, j], turned[1, j], turned[2, j], turned[3, j])
                lowest = min(turned[1, j], turned[2, j], turned[3, j])
                upper = _POSITIVE_LIMIT / max(highest, np.float32(1e-3))
                limit[j] = min(upper, _NEGATIVE_LIMIT / max(-lowest, np.float32(1e-3)))
            for j in range(LANES):
                best_scale[j] = _ZERO
            for n in range(NUM_FRAME_SCALES):
                fraction = _FRAME_SCALES[n]
                weight = _FRAME_WEIGHTS[n]
                for j in range(LANES):
                    scale = limit[j] * fraction
                    w, x, y, z = turned[0, j], turned[1, j], turned[2, j], turned[3, j]
                    rw = ((w * scale + _ROUND) - _ROUND) - w * scale
                    rx = ((x * scale + _ROUND) - _ROUND) - x * scale
                    ry = ((y * scale + _ROUND) - _ROUND) - y * scale
                    rz = ((z * scale + _ROUND) - _ROUND) - z * scale
                    # Vector part of conj(q) (scale q + r): what lies along q drops out.
                    dx = w * rx - rw * x - (y * rz - z * ry)
                    dy = w * ry - rw * y - (z * rx - x * rz)
                    dz = w * rz - rw * z - (x * ry - y * rx)
                    error = dx * dx * weights[kx, j] + dy * dy * weights[ky, j] + dz * dz * weights[kz, j]
                    error = error * weight / (limit[j] * limit[j])
                    is_better = error < best[j]
                    best[j] = error if is_better else best[j]
                    best_scale[j] = scale if is_better else best_scale[j]
            for j in range(LANES):
                if best_scale[j] > _ZERO:
                    best_frame[j] = frame
                    for k in range(4):
                        codes[k, j] = (turned[k, j] * best_scale[j] + _ROUND) - _ROUND
        for j in range(count):
            frames[start + j] = np.uint8(best_frame[j])
            for k in range(4):
                out[start + j, k] = np.uint8(np.int32(codes[k, j]) + np.int32(128))
