"""Which of the 24 frames of a Gaussian Spark's rotation code holds best: a search in float32 over what the decoder returns.

The error of a frame is that of the decoded covariance. With l the squared scales, l' those decoded, and d the vector part
of the quaternion from the source to the decoded rotation in local axes, up to third order in d
||Sigma' - Sigma||^2 = const + 8 sum_k (l_i - l_j) (l'_i - l'_j) d_k^2, where i and j are the axes other than k.
The frame that wins is packed by the exact encoder (spark_pack).
"""

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS

LANES = 64
_QUATS = FRAME_QUATS.astype(np.float32)


def _fit(function, degree, high):
    """Return float32 coefficients, lowest first, of a polynomial close to `function` on 0..high."""
    nodes = Chebyshev.interpolate(function, degree, domain=[0.0, high])
    return nodes.convert(kind=Polynomial).coef.astype(np.float32)


# acos(w) / sqrt(1 - w^2), within 2e-5, and sin(a) / a and cos(a) in powers of a^2, within 1e-6: a code step is 0.006.
_ARC = _fit(lambda w: np.arccos(w) / np.sqrt(1.0 - w * w), 6, 1.0)
_SINE = _fit(lambda square: np.sin(np.sqrt(square)) / np.sqrt(square), 4, 2.5)
_COSINE = _fit(lambda square: np.cos(np.sqrt(square)), 4, 2.5)

_ROUND = np.float32(12582912.0)  # adding and subtracting 1.5 x 2^23 rounds to an integer
_OCT = np.float32(127.5)
_OCT_STEP = np.float32(2.0 / 255.0)
_ANGLE_STEPS = np.float32(510.0 / np.pi)
_ANGLE_STEP = np.float32(np.pi / 510.0)
_ZERO, _ONE, _TINY = np.float32(0), np.float32(1), np.float32(1e-20)


@device()
def load_weights(log_scales, start, count, ln_min, steps, shrinks, weights):
    """Write the weights of d_k^2 of a batch, relative to the largest squared scale.

    log_scales  float32 (N, 3)      read
    ln_min      float64             log of scale code 1
    steps       float64             scale codes per unit of log
    shrinks     float64 (256,)      read: squared scale of a code relative to that of the code so many above it
    weights     float32 (3, LANES)  written
    """
    codes = np.empty(3, np.int64)
    source = np.empty(3, np.float64)
    decoded = np.empty(3, np.float64)
    for j in range(count):
        highest = np.int64(1)
        for k in range(3):
            value = (np.float64(log_scales[start + j, k]) - ln_min) * steps
            codes[k] = np.int64(min(max(np.rint(value), 0.0), 254.0)) + 1
            highest = max(highest, codes[k])
            source[k] = value
        for k in range(3):
            if log_scales[start + j, k] < np.float32(-30.0):
                source[k], decoded[k] = 0.0, 0.0
            else:
                decoded[k] = shrinks[highest - codes[k]]
                # Where the scale was clamped the decoded one stands for both.
                off = source[k] - (codes[k] - 1)
                off = 2.0 * off / steps if abs(off) <= 0.5 else 0.0
                source[k] = decoded[k] * (1.0 + off * (1.0 + off * (0.5 + off * (1.0 / 6.0))))
        weights[0, j] = np.float32((source[1] - source[2]) * (decoded[1] - decoded[2]))
        weights[1, j] = np.float32((source[2] - source[0]) * (decoded[2] - decoded[0]))
        weights[2, j] = np.float32((source[0] - source[1]) * (decoded[0] - decoded[1]))


@kernel()
def choose_frames(quats, log_scales, ln_min, steps, by_angle, frames):
    """The frame that decodes with the smallest error; ties take the first.

    quats       float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    log_scales  float32 (N, 3)  read
    ln_min      float64         log of scale code 1
    steps       float64         scale codes per unit of log
    by_angle    bool            minimize the angle instead of the covariance's error
    frames      uint8 (N,)      written
    """
    unit = np.empty((4, LANES), np.float32)
    weights = np.empty((3, LANES), np.float32)
    best = np.empty(LANES, np.float32)
    best_frame = np.empty(LANES, np.int32)
    shrinks = np.empty(256, np.float64)
    for k in range(256):
        shrinks[k] = np.exp(-2.0 * k / steps)
    for start in range(0, quats.shape[0], LANES):
        count = min(LANES, quats.shape[0] - start)
        for j in range(LANES):
            i = start + (j if j < count else 0)
            w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
            square = w * w + x * x + y * y + z * z
            is_null = square == 0.0
            factor = 1.0 / np.sqrt(1.0 if is_null else square)
            unit[0, j] = np.float32(1.0 if is_null else w * factor)
            unit[1, j] = np.float32(x * factor)
            unit[2, j] = np.float32(y * factor)
            unit[3, j] = np.float32(z * factor)
            best[j] = np.float32(1e30)
            best_frame[j] = np.int32(0)
            for k in range(3):
                weights[k, j] = _ONE
        if not by_angle:
            load_weights(log_scales, start, count, ln_min, steps, shrinks, weights)
        for f in range(24):
            a, b, c, d = _QUATS[f, 0], _QUATS[f, 1], _QUATS[f, 2], _QUATS[f, 3]
            kx, ky, kz = FRAME_AXES[f, 0], FRAME_AXES[f, 1], FRAME_AXES[f, 2]
            frame = np.int32(f)
            for j in range(LANES):
                qw, qx, qy, qz = unit[0, j], unit[1, j], unit[2, j], unit[3, j]
                w = qw * a - qx * b - qy * c - qz * d
                sign = _ONE if w >= _ZERO else -_ONE
                w = w * sign
                x = (qw * b + qx * a + qy * d - qz * c) * sign
                y = (qw * c - qx * d + qy * a + qz * b) * sign
                z = (qw * d + qx * c - qy * b + qz * a) * sign
                # Octahedral code of the axis, and what it decodes to.
                ax, ay, az = abs(x), abs(y), abs(z)
                inverse = _ONE / (ax + ay + az + _TINY)
                px, py = x * inverse, y * inverse
                fold_x = _ONE - ay * inverse
                fold_y = _ONE - ax * inverse
                fold_x = fold_x if x >= _ZERO else -fold_x
                fold_y = fold_y if y >= _ZERO else -fold_y
                px = fold_x if z < _ZERO else px
                py = fold_y if z < _ZERO else py
                ox = (((px * _OCT + _OCT) + _ROUND) - _ROUND) * _OCT_STEP - _ONE
                oy = (((py * _OCT + _OCT) + _ROUND) - _ROUND) * _OCT_STEP - _ONE
                oz = _ONE - abs(ox) - abs(oy)
                t = -oz if oz < _ZERO else _ZERO
                ox = ox - t if ox >= _ZERO else ox + t
                oy = oy - t if oy >= _ZERO else oy + t
                # Code of half the angle, and its sine and cosine as decoded.
                sine = np.sqrt(x * x + y * y + z * z)
                arc = _ARC[6]
                for k in range(5, -1, -1):
                    arc = arc * w + _ARC[k]
                half = (((sine * arc * _ANGLE_STEPS) + _ROUND) - _ROUND) * _ANGLE_STEP
                square = half * half
                s, e = _SINE[4], _COSINE[4]
                for k in range(3, -1, -1):
                    s = s * square + _SINE[k]
                    e = e * square + _COSINE[k]
                length = s * half / np.sqrt(ox * ox + oy * oy + oz * oz)
                ox, oy, oz = ox * length, oy * length, oz * length
                # Vector part of conj(q) q'.
                dx = w * ox - e * x - (y * oz - z * oy)
                dy = w * oy - e * y - (z * ox - x * oz)
                dz = w * oz - e * z - (x * oy - y * ox)
                error = dx * dx * weights[kx, j] + dy * dy * weights[ky, j] + dz * dz * weights[kz, j]
                is_better = error < best[j]
                best[j] = error if is_better else best[j]
                best_frame[j] = frame if is_better else best_frame[j]
        for j in range(count):
            frames[start + j] = np.uint8(best_frame[j])
