"""Smallest three components of a quaternion in 8 bits each: nearest codes, and those whose covariance errs least."""

import numpy as np

from gsplat_tools.kernels._jit import kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS
from gsplat_tools.kernels.smallest_three import _FRAME_OF_LARGEST, CANDIDATES, LANES

_STEPS = 127.5 * np.sqrt(2.0)

_STEPS_F32, _STEP = np.float32(_STEPS), np.float32(1.0 / _STEPS)
_QUATS = FRAME_QUATS.astype(np.float32)
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_CENTER, _LAST = np.float32(127.5), np.float32(254)
_TRACE = np.float32(1e-9)


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
    unit = np.empty((4, LANES), np.float32)
    squares = np.empty((3, LANES), np.float32)
    weights = np.empty((3, LANES), np.float32)
    turned = np.empty((4, LANES), np.float32)
    places = np.empty((3, 2, LANES), np.float32)  # the nearest code of each component, then the next
    frame = np.empty(LANES, np.int32)
    best = np.empty(LANES, np.float32)
    best_frame = np.empty(LANES, np.int32)
    best_code = np.empty((3, LANES), np.float32)
    for start in range(0, quats.shape[0], LANES):
        count = min(LANES, quats.shape[0] - start)
        for j in range(LANES):
            i = start + (j if j < count else 0)
            w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
            square = w * w + x * x + y * y + z * z
            is_null = square == 0.0
            factor = 1.0 / np.sqrt(1.0 if is_null else square)
            unit[0, j] = np.float32(1.0 if is_null else w * factor)
            unit[1, j], unit[2, j], unit[3, j] = np.float32(x * factor), np.float32(y * factor), np.float32(z * factor)
            s0, s1, s2 = np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]), np.float64(log_scales[i, 2])
            longest = max(s0, s1, s2)
            longest = 0.0 if longest == -np.inf else longest
            squares[0, j] = np.float32(np.exp(2.0 * (s0 - longest)))
            squares[1, j] = np.float32(np.exp(2.0 * (s1 - longest)))
            squares[2, j] = np.float32(np.exp(2.0 * (s2 - longest)))
            best[j] = np.float32(1e30)
            best_frame[j] = np.int32(0)
        for c in range(6):
            f = CANDIDATES[c]
            a, b, d, e = _QUATS[f, 0], _QUATS[f, 1], _QUATS[f, 2], _QUATS[f, 3]
            f0, f1 = np.int32(_FRAME_OF_LARGEST[c, 0]), np.int32(_FRAME_OF_LARGEST[c, 1])
            f2, f3 = np.int32(_FRAME_OF_LARGEST[c, 2]), np.int32(_FRAME_OF_LARGEST[c, 3])
            k0, k1, k2 = FRAME_AXES[f, 0], FRAME_AXES[f, 1], FRAME_AXES[f, 2]
            for j in range(LANES):
                w = unit[0, j] * a - unit[1, j] * b - unit[2, j] * d - unit[3, j] * e
                x = unit[0, j] * b + unit[1, j] * a + unit[2, j] * e - unit[3, j] * d
                y = unit[0, j] * d - unit[1, j] * e + unit[2, j] * a + unit[3, j] * b
                z = unit[0, j] * e + unit[1, j] * d - unit[2, j] * b + unit[3, j] * a
                aw, ax, ay, az = abs(w), abs(x), abs(y), abs(z)
                largest = max(aw, ax, ay, az)
                is_w = aw == largest
                is_x = (ax == largest) & (not is_w)
                is_y = (ay == largest) & (not is_w) & (not is_x)
                # A half turn, i, j or k from the right, brings the largest to w.
                tw = w if is_w else (-x if is_x else (-y if is_y else -z))
                tx = x if is_w else (w if is_x else (-z if is_y else y))
                ty = y if is_w else (z if is_x else (w if is_y else -x))
                tz = z if is_w else (-y if is_x else (x if is_y else w))
                frame[j] = f0 if is_w else (f1 if is_x else (f2 if is_y else f3))
                sign = _ONE if tw >= _ZERO else -_ONE
                turned[0, j], turned[1, j], turned[2, j], turned[3, j] = tw * sign, tx * sign, ty * sign, tz * sign
                # With the vector part d of the turn from source to decoded rotation in local axes the squared error of
                # the covariance is 8 sum_k (l_i - l_j)^2 d_k^2 up to third order, l the squared scales, i and j not k.
                # A trace of the angle decides where the covariance does not.
                u, v, t = squares[k0, j], squares[k1, j], squares[k2, j]
                weights[0, j] = (v - t) * (v - t) + _TRACE
                weights[1, j] = (t - u) * (t - u) + _TRACE
                weights[2, j] = (u - v) * (u - v) + _TRACE
            for k in range(3):
                for j in range(LANES):
                    place = turned[k + 1, j] * _STEPS_F32 + _CENTER
                    low = np.floor(place)
                    low = min(max(low, _ZERO), _LAST)
                    is_up = place - low >= _HALF
                    places[k, 0, j] = low + (_ONE if is_up else _ZERO)
                    places[k, 1, j] = low + (_ZERO if is_up else _ONE)
            for corner in range(8):
                px, py, pz = places[0, corner & 1], places[1, corner >> 1 & 1], places[2, corner >> 2]
                for j in range(LANES):
                    w, x, y, z = turned[0, j], turned[1, j], turned[2, j], turned[3, j]
                    rx, ry, rz = (px[j] - _CENTER) * _STEP, (py[j] - _CENTER) * _STEP, (pz[j] - _CENTER) * _STEP
                    rw = np.sqrt(max(_ZERO, _ONE - (rx * rx + ry * ry + rz * rz)))
                    dx = w * rx - x * rw - (y * rz - z * ry)
                    dy = w * ry - y * rw - (z * rx - x * rz)
                    dz = w * rz - z * rw - (x * ry - y * rx)
                    error = dx * dx * weights[0, j] + dy * dy * weights[1, j] + dz * dz * weights[2, j]
                    is_better = error < best[j]
                    best[j] = error if is_better else best[j]
                    best_frame[j] = frame[j] if is_better else best_frame[j]
                    best_code[0, j] = px[j] if is_better else best_code[0, j]
                    best_code[1, j] = py[j] if is_better else best_code[1, j]
                    best_code[2, j] = pz[j] if is_better else best_code[2, j]
        for j in range(count):
            frames[start + j] = np.uint8(best_frame[j])
            for k in range(3):
                codes[start + j, k] = np.uint8(np.int32(best_code[k, j]))
            codes[start + j, 3] = np.uint8(252)
