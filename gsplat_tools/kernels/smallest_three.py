"""Quaternions without their largest component, the other three on a regular grid: codes, and the frame that errs least.

A grid holds (integer + offset) / steps. The decoder makes the largest component up from the others, so that an error of
those moves it too. Of the 24 frames (rotation_frames) those that differ by half turns hold the same numbers in another
order: they err alike, and the one that leaves w largest is taken. Six candidates remain, one for each order of the axes.
"""

import numpy as np

from gsplat_tools.kernels._jit import kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS, fitting_scale

LANES = 64

_HALF_TURNS = np.eye(4)


def _multiply(p, q):
    """Hamilton product of two quaternions wxyz."""
    a, b, c, d = p
    w, x, y, z = q
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def _frame_of(quat):
    """Return the frame that a rotation of the cube is, whatever its sign."""
    return int(np.argmax(np.abs(FRAME_QUATS @ quat)))


_FIRSTS = np.array([np.flatnonzero((axes == FRAME_AXES).all(axis=1))[0] for axes in np.unique(FRAME_AXES, axis=0)])
CANDIDATES = np.sort(_FIRSTS).astype(np.int64)
"""(6,): one frame for each order of the axes, the identity first."""

# Multiplying by 1, i, j or k from the right brings component 0, 1, 2 or 3 to w, up to its sign.
_FRAME_OF_LARGEST = np.array(
    [[_frame_of(_multiply(FRAME_QUATS[f], _HALF_TURNS[m])) for m in range(4)] for f in CANDIDATES], np.uint8
)
_QUATS = FRAME_QUATS[CANDIDATES].astype(np.float32)
_AXES = FRAME_AXES[CANDIDATES]

_CANDIDATE_OF_ORDER = np.full(27, -1, np.int64)
for _index, _axes in enumerate(_AXES):
    _CANDIDATE_OF_ORDER[9 * _axes[0] + 3 * _axes[1] + _axes[2]] = _index

# Adding and subtracting 1.5 x 2^23 rounds a float32 below 2^22 to an integer, ties to even.
_ROUND = np.float32(12582912.0)
_ZERO, _ONE = np.float32(0), np.float32(1)
SQRT_HALF = float(np.sqrt(0.5))


@kernel()
def choose_frames(quats, log_scales, steps, offset, by_angle, frames):
    """The frame that decodes with the smallest error; ties take the first.

    quats       float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    log_scales  float32 (N, 3)  read
    steps       float64         grid points per unit
    offset      float64         0 or 0.5
    by_angle    bool            minimize the angle instead of the covariance's error
    frames      uint8 (N,)      written
    """
    step, inverse, shift = np.float32(steps), np.float32(1.0 / steps), np.float32(offset)
    unit = np.empty((4, LANES), np.float32)
    weights = np.empty((3, LANES), np.float32)
    best = np.empty(LANES, np.float32)
    best_frame = np.empty(LANES, np.int32)
    squares = np.empty(3, np.float64)
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
            if by_angle:
                for k in range(3):
                    weights[k, j] = _ONE
            else:
                # With the vector part d of the turn from source to decoded rotation in local axes the squared error of
                # the covariance is 8 sum_k (l_i - l_j)^2 d_k^2 up to third order, l the squared scales, i and j not k.
                s0, s1, s2 = np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]), np.float64(log_scales[i, 2])
                longest = max(s0, s1, s2)
                longest = 0.0 if longest == -np.inf else longest
                squares[0], squares[1] = np.exp(2.0 * (s0 - longest)), np.exp(2.0 * (s1 - longest))
                squares[2] = np.exp(2.0 * (s2 - longest))
                weights[0, j] = np.float32((squares[1] - squares[2]) * (squares[1] - squares[2]))
                weights[1, j] = np.float32((squares[2] - squares[0]) * (squares[2] - squares[0]))
                weights[2, j] = np.float32((squares[0] - squares[1]) * (squares[0] - squares[1]))
        for c in range(6):
            a, b, e, f = _QUATS[c, 0], _QUATS[c, 1], _QUATS[c, 2], _QUATS[c, 3]
            kx, ky, kz = _AXES[c, 0], _AXES[c, 1], _AXES[c, 2]
            f0, f1 = np.int32(_FRAME_OF_LARGEST[c, 0]), np.int32(_FRAME_OF_LARGEST[c, 1])
            f2, f3 = np.int32(_FRAME_OF_LARGEST[c, 2]), np.int32(_FRAME_OF_LARGEST[c, 3])
            for j in range(LANES):
                qw, qx, qy, qz = unit[0, j], unit[1, j], unit[2, j], unit[3, j]
                w = qw * a - qx * b - qy * e - qz * f
                x = qw * b + qx * a + qy * f - qz * e
                y = qw * e - qx * f + qy * a + qz * b
                z = qw * f + qx * e - qy * b + qz * a
                aw, ax, ay, az = abs(w), abs(x), abs(y), abs(z)
                largest = max(aw, ax, ay, az)
                rw = (((w * step - shift) + _ROUND) - _ROUND + shift) * inverse
                rx = (((x * step - shift) + _ROUND) - _ROUND + shift) * inverse
                ry = (((y * step - shift) + _ROUND) - _ROUND + shift) * inverse
                rz = (((z * step - shift) + _ROUND) - _ROUND + shift) * inverse
                is_w = aw == largest
                is_x = (ax == largest) & (not is_w)
                is_y = (ay == largest) & (not is_w) & (not is_x)
                is_z = (not is_w) & (not is_x) & (not is_y)
                rest = (_ZERO if is_w else rw * rw) + (_ZERO if is_x else rx * rx)
                rest = rest + (_ZERO if is_y else ry * ry) + (_ZERO if is_z else rz * rz)
                made = np.sqrt(max(_ZERO, _ONE - rest))
                rw = (made if w >= _ZERO else -made) if is_w else rw
                rx = (made if x >= _ZERO else -made) if is_x else rx
                ry = (made if y >= _ZERO else -made) if is_y else ry
                rz = (made if z >= _ZERO else -made) if is_z else rz
                # Vector part of conj(q) q'.
                dx = w * rx - x * rw - (y * rz - z * ry)
                dy = w * ry - y * rw - (z * rx - x * rz)
                dz = w * rz - z * rw - (x * ry - y * rx)
                error = dx * dx * weights[kx, j] + dy * dy * weights[ky, j] + dz * dz * weights[kz, j]
                frame = f0 if is_w else (f1 if is_x else (f2 if is_y else f3))
                is_better = error < best[j]
                best[j] = error if is_better else best[j]
                best_frame[j] = frame if is_better else best_frame[j]
        for j in range(count):
            frames[start + j] = np.uint8(best_frame[j])


@kernel()
def sorted_frames(quats, log_scales, frames):
    """The frame whose first axis is the longest, whose second is the shortest, and whose quaternion has w largest.

    quats       float32 (N, 4)  read, wxyz, any length
    log_scales  float32 (N, 3)  read
    frames      uint8 (N,)      written
    """
    for i in range(quats.shape[0]):
        longest, shortest = 0, 2
        for k in range(1, 3):
            longest = k if log_scales[i, k] > log_scales[i, longest] else longest
        for k in range(1, -1, -1):
            shortest = k if log_scales[i, k] < log_scales[i, shortest] else shortest
        if longest == shortest:  # a ball, or values that are no numbers
            longest, shortest = 0, 1
        c = _CANDIDATE_OF_ORDER[9 * longest + 3 * shortest + (3 - longest - shortest)]
        a, b, e, f = _QUATS[c, 0], _QUATS[c, 1], _QUATS[c, 2], _QUATS[c, 3]
        scale = np.float32(fitting_scale(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]))
        qw, qx, qy, qz = quats[i, 0] * scale, quats[i, 1] * scale, quats[i, 2] * scale, quats[i, 3] * scale
        sizes = (
            abs(qw * a - qx * b - qy * e - qz * f),
            abs(qw * b + qx * a + qy * f - qz * e),
            abs(qw * e - qx * f + qy * a + qz * b),
            abs(qw * f + qx * e - qy * b + qz * a),
        )
        largest = 0
        for k in range(1, 4):
            largest = k if sizes[k] > sizes[largest] else largest
        frames[i] = _FRAME_OF_LARGEST[c, largest]


@kernel()
def pack_signed(quats, words):
    """Words of SPZ 3: index of the largest of x, y, z, w above three fields of a sign and nine bits, the first highest.

    quats  float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    words  uint32 (N,)     written
    """
    q = np.empty(4, np.float64)
    for i in range(quats.shape[0]):
        square = 0.0
        for k in range(4):
            q[k] = np.float64(quats[i, (k + 1) & 3])
            square += q[k] * q[k]
        if square == 0.0:
            q[3], square = 1.0, 1.0
        factor = 1.0 / np.sqrt(square)
        largest = 0
        for k in range(1, 4):
            if abs(q[k]) > abs(q[largest]):
                largest = k
        factor = -factor if q[largest] < 0.0 else factor
        word = np.uint32(largest)
        for k in range(4):
            if k != largest:
                value = q[k] * factor
                code = np.uint32(min(511.0, np.floor(511.0 * (abs(value) / SQRT_HALF) + 0.5)))
                sign = np.uint32(512) if value < 0.0 else np.uint32(0)
                word = np.uint32((word << np.uint32(10)) | sign | code)
        words[i] = word


@kernel()
def unpack_signed(words, quats):
    """Unit quaternions, wxyz, of the words of SPZ 3.

    words  uint32 (N,)     read
    quats  float32 (N, 4)  written
    """
    for i in range(words.shape[0]):
        word = words[i]
        largest = np.int64(word >> np.uint32(30))
        rest = 0.0
        for k in range(3, -1, -1):
            if k != largest:
                value = np.float64(word & np.uint32(511)) / 511.0 * SQRT_HALF
                rest += value * value
                value = -value if word & np.uint32(512) else value
                quats[i, (k + 1) & 3] = np.float32(value)
                word = np.uint32(word >> np.uint32(10))
        made = np.sqrt(max(0.0, 1.0 - rest))
        # Three fields at their ends leave nothing for the fourth and are longer than 1.
        factor = 1.0 if rest <= 1.0 else 1.0 / np.sqrt(rest)
        quats[i, (largest + 1) & 3] = np.float32(made)
        if factor != 1.0:
            for k in range(4):
                quats[i, k] = np.float32(quats[i, k] * factor)


@kernel()
def pack_unsigned(quats, words):
    """Words of compressed.ply: index of the largest of w, x, y, z above three fields of ten bits, the first highest.

    quats  float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    words  uint32 (N,)     written
    """
    for i in range(quats.shape[0]):
        square = 0.0
        largest = 0
        for k in range(4):
            square += np.float64(quats[i, k]) * np.float64(quats[i, k])
            if abs(quats[i, k]) > abs(quats[i, largest]):
                largest = k
        factor = 1.0 / np.sqrt(1.0 if square == 0.0 else square)
        factor = -factor if quats[i, largest] < 0.0 else factor
        word = np.uint32(largest)
        for k in range(4):
            if k != largest:
                value = np.float64(quats[i, k]) * factor * SQRT_HALF + 0.5
                code = np.uint32(max(0.0, min(1023.0, np.floor(value * 1023.0 + 0.5))))
                word = np.uint32((word << np.uint32(10)) | code)
        words[i] = word


@kernel()
def unpack_unsigned(words, quats):
    """Unit quaternions, wxyz, of the words of compressed.ply.

    words  uint32 (N,)     read
    quats  float32 (N, 4)  written
    """
    for i in range(words.shape[0]):
        word = words[i]
        largest = np.int64(word >> np.uint32(30))
        rest = 0.0
        for k in range(3, -1, -1):
            if k != largest:
                value = (np.float64(word & np.uint32(1023)) / 1023.0 - 0.5) / SQRT_HALF
                rest += value * value
                quats[i, k] = np.float32(value)
                word = np.uint32(word >> np.uint32(10))
        made = np.sqrt(max(0.0, 1.0 - rest))
        factor = 1.0 if rest <= 1.0 else 1.0 / np.sqrt(rest)
        quats[i, largest] = np.float32(made)
        if factor != 1.0:
            for k in range(4):
                quats[i, k] = np.float32(quats[i, k] * factor)


@kernel()
def pack_first_three(quats, codes):
    """Bytes of SPZ 1 and 2: x, y, z of the quaternion whose w is not negative.

    quats  float32 (N, 4)  read, wxyz, any length; length 0 is the identity
    codes  uint8 (N, 3)    written
    """
    for i in range(quats.shape[0]):
        square = 0.0
        for k in range(4):
            square += np.float64(quats[i, k]) * np.float64(quats[i, k])
        factor = 127.5 / np.sqrt(1.0 if square == 0.0 else square)
        factor = -factor if quats[i, 0] < 0.0 else factor
        for k in range(3):
            codes[i, k] = np.uint8(max(0.0, min(255.0, np.floor(np.float64(quats[i, k + 1]) * factor + 128.0))))


@kernel()
def unpack_first_three(codes, quats):
    """Unit quaternions, wxyz, of the bytes of SPZ 1 and 2.

    codes  uint8 (N, 3)    read
    quats  float32 (N, 4)  written
    """
    for i in range(codes.shape[0]):
        x = np.float64(codes[i, 0]) / 127.5 - 1.0
        y = np.float64(codes[i, 1]) / 127.5 - 1.0
        z = np.float64(codes[i, 2]) / 127.5 - 1.0
        rest = x * x + y * y + z * z
        factor = 1.0 if rest <= 1.0 else 1.0 / np.sqrt(rest)
        quats[i, 0] = np.float32(np.sqrt(max(0.0, 1.0 - rest)))
        quats[i, 1] = np.float32(x * factor)
        quats[i, 2] = np.float32(y * factor)
        quats[i, 3] = np.float32(z * factor)
