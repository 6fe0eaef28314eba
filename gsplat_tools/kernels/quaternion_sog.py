"""Smallest three components of a quaternion in 8 bits each: nearest codes, and those whose covariance errs least."""

import numpy as np

from gsplat_tools.kernels._jit import kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS
from gsplat_tools.kernels.smallest_three import CANDIDATES

_STEPS = 127.5 * np.sqrt(2.0)

_FRAMES_OF_ORDER = np.array([np.flatnonzero((FRAME_AXES[first] == FRAME_AXES).all(axis=1)) for first in CANDIDATES], np.int64)
"""(6, 4): the frames that put the axes in the same order."""


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


@kernel()
def quantize_covariances(quats, log_scales, frames, codes):
    """Frame and code with the smallest error of the covariance: six orders of the axes, components rounded down or up.

    A disc or a needle hardly changes when it turns about its axis, so that a code further off may err less.

    quats       float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    log_scales  float32 (N, 3)  read
    frames      uint8 (N,)      written; w is the largest component in the frame that is chosen
    codes       uint8 (N, 4)    written
    """
    squares = np.empty(3, np.float64)
    unit = np.empty(4, np.float64)
    for i in range(quats.shape[0]):
        square = 0.0
        for k in range(4):
            unit[k] = np.float64(quats[i, k])
            square += unit[k] * unit[k]
        if square == 0.0:
            unit[0], square = 1.0, 1.0
        factor = 1.0 / np.sqrt(square)
        for k in range(4):
            unit[k] *= factor
        s0, s1, s2 = np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]), np.float64(log_scales[i, 2])
        longest = max(s0, s1, s2)
        longest = 0.0 if longest == -np.inf else longest
        squares[0], squares[1] = np.exp(2.0 * (s0 - longest)), np.exp(2.0 * (s1 - longest))
        squares[2] = np.exp(2.0 * (s2 - longest))
        best = np.inf
        for c in range(6):
            # The four frames of an order differ by half turns, which bring each component to w in turn.
            frame, w, x, y, z = 0, -1.0, 0.0, 0.0, 0.0
            for half_turn in range(4):
                f = _FRAMES_OF_ORDER[c, half_turn]
                a, b, d, e = FRAME_QUATS[f, 0], FRAME_QUATS[f, 1], FRAME_QUATS[f, 2], FRAME_QUATS[f, 3]
                turned = unit[0] * a - unit[1] * b - unit[2] * d - unit[3] * e
                if abs(turned) > abs(w) + 1e-7 or half_turn == 0:
                    frame, w = f, turned
                    x = unit[0] * b + unit[1] * a + unit[2] * e - unit[3] * d
                    y = unit[0] * d - unit[1] * e + unit[2] * a + unit[3] * b
                    z = unit[0] * e + unit[1] * d - unit[2] * b + unit[3] * a
            if w < 0.0:
                w, x, y, z = -w, -x, -y, -z
            i0, i1, i2 = FRAME_AXES[frame, 0], FRAME_AXES[frame, 1], FRAME_AXES[frame, 2]
            # With the vector part d of the turn from source to decoded rotation in local axes the squared error of the
            # covariance is 8 sum_k (l_i - l_j)^2 d_k^2 up to third order, l the squared scales, i and j not k.
            wx = (squares[i1] - squares[i2]) * (squares[i1] - squares[i2])
            wy = (squares[i2] - squares[i0]) * (squares[i2] - squares[i0])
            wz = (squares[i0] - squares[i1]) * (squares[i0] - squares[i1])
            x0 = min(max(np.floor(x * _STEPS + 127.5), 0.0), 254.0)
            y0 = min(max(np.floor(y * _STEPS + 127.5), 0.0), 254.0)
            z0 = min(max(np.floor(z * _STEPS + 127.5), 0.0), 254.0)
            for corner in range(8):
                # The nearest first: it wins ties.
                cx = x0 + np.float64((corner & 1) ^ np.int64(x * _STEPS + 127.5 - x0 >= 0.5))
                cy = y0 + np.float64((corner >> 1 & 1) ^ np.int64(y * _STEPS + 127.5 - y0 >= 0.5))
                cz = z0 + np.float64((corner >> 2) ^ np.int64(z * _STEPS + 127.5 - z0 >= 0.5))
                rx, ry, rz = (cx - 127.5) / _STEPS, (cy - 127.5) / _STEPS, (cz - 127.5) / _STEPS
                rw = np.sqrt(max(0.0, 1.0 - (rx * rx + ry * ry + rz * rz)))
                dx = w * rx - x * rw - (y * rz - z * ry)
                dy = w * ry - y * rw - (z * rx - x * rz)
                dz = w * rz - z * rw - (x * ry - y * rx)
                # A trace of the angle decides where the covariance does not.
                error = dx * dx * (wx + 1e-9) + dy * dy * (wy + 1e-9) + dz * dz * (wz + 1e-9)
                if error < best * 0.999999:
                    best = error
                    frames[i] = np.uint8(frame)
                    codes[i, 0], codes[i, 1], codes[i, 2] = np.uint8(cx), np.uint8(cy), np.uint8(cz)
        codes[i, 3] = np.uint8(252)
