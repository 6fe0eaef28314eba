"""Words of compressed.ply: blocks of 256 splats, each with the box of its positions, log scales and colors.

Source: docs/formats/compressed-ply.md, from playcanvas/splat-transform.
"""

import numpy as np

from gsplat_tools.constants import SH_C0
from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.exponential import exp_nonpositive

BLOCK = 256
NUM_BOUNDS = 18
MAX_LOG_SCALE = 20.0

SCALES, SH, INVALID = 0, 1, 2
"""Places in the array of counts: clamped scale axes, clamped SH values, values that are not a number."""
NUM_COUNTS = 3

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_STEPS = np.float32(1023 * np.sqrt(0.5))
_STEP = np.float32(np.sqrt(2.0) / 1023)
"""Of the components of quaternions; 0 lies between two."""


@device()
def _code(value, low, high, levels):
    """Place of value in low..high in whole steps, 0 to levels."""
    extent = np.float64(high) - np.float64(low)
    if not extent > 0.0:
        return np.uint32(0)
    place = (np.float64(value) - np.float64(low)) / extent
    return np.uint32(np.floor(min(max(place, 0.0), 1.0) * levels + 0.5))


@kernel()
def encode_blocks(means, log_scales, opacity_logits, sh0, rotations, bounds, words, counts):
    """Boxes and words of whole blocks; the last one may be shorter.

    means           float32 (n, 3)   read
    log_scales      float32 (n, 3)   read; clamped to -20..20
    opacity_logits  float32 (n,)     read
    sh0             float32 (n, 3)   read
    rotations       uint32 (n,)      read; words of the quaternions
    bounds          float32 (m, 18)  written: lows, then highs, of x y z, of log scales, of r g b
    words           uint32 (n, 4)    written: position, rotation, scale, color
    counts          int64 (NUM_COUNTS,)  added to
    """
    values = np.empty((BLOCK, 9), np.float32)
    count = means.shape[0]
    for block in range(bounds.shape[0]):
        first = block * BLOCK
        size = min(BLOCK, count - first)
        box = bounds[block]
        for k in range(9):
            low_place = 6 * (k // 3) + k % 3
            box[low_place] = np.float32(np.inf)
            box[low_place + 3] = np.float32(-np.inf)
        for j in range(size):
            i = first + j
            for a in range(3):
                values[j, a] = means[i, a]
                scale = np.float64(log_scales[i, a])
                counts[SCALES] += (scale < -MAX_LOG_SCALE) | (scale > MAX_LOG_SCALE)
                counts[INVALID] += np.isnan(scale) | np.isnan(sh0[i, a]) | np.isnan(means[i, a])
                values[j, 3 + a] = np.float32(min(max(scale, -MAX_LOG_SCALE), MAX_LOG_SCALE))
                values[j, 6 + a] = np.float32(np.float64(sh0[i, a]) * SH_C0 + 0.5)
            for k in range(9):
                low_place = 6 * (k // 3) + k % 3
                box[low_place] = min(box[low_place], values[j, k])
                box[low_place + 3] = max(box[low_place + 3], values[j, k])
        for j in range(size):
            i = first + j
            for part in range(2):
                base, place = 3 * part, 6 * part
                x = _code(values[j, base], box[place], box[place + 3], 2047.0)
                y = _code(values[j, base + 1], box[place + 1], box[place + 4], 1023.0)
                z = _code(values[j, base + 2], box[place + 2], box[place + 5], 2047.0)
                words[i, 2 * part] = np.uint32((x << np.uint32(21)) | (y << np.uint32(11)) | z)
            words[i, 1] = rotations[i]
            r = _code(values[j, 6], box[12], box[15], 255.0)
            g = _code(values[j, 7], box[13], box[16], 255.0)
            b = _code(values[j, 8], box[14], box[17], 255.0)
            logit = np.float64(opacity_logits[i])
            counts[INVALID] += np.isnan(logit)
            alpha = np.uint32(np.floor(255.0 / (1.0 + np.exp(-logit)) + 0.5)) if logit == logit else np.uint32(0)  # noqa: PLR0124
            words[i, 3] = np.uint32((r << np.uint32(24)) | (g << np.uint32(16)) | (b << np.uint32(8)) | alpha)


@device()
def _turn(quats, i, d):
    """Write the vector part of the turn from a quaternion to what its word decodes to, in local axes."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    square = w * w + x * x + y * y + z * z
    factor = _ONE / np.sqrt(square if square > _ZERO else _ONE)
    w, x, y, z = w * factor, x * factor, y * factor, z * factor
    largest = max(abs(w), abs(x), abs(y), abs(z))
    rw = (np.floor(w * _STEPS) + _HALF) * _STEP
    rx = (np.floor(x * _STEPS) + _HALF) * _STEP
    ry = (np.floor(y * _STEPS) + _HALF) * _STEP
    rz = (np.floor(z * _STEPS) + _HALF) * _STEP
    if abs(w) == largest:
        rw = np.copysign(np.sqrt(max(_ZERO, _ONE - rx * rx - ry * ry - rz * rz)), w)
    elif abs(x) == largest:
        rx = np.copysign(np.sqrt(max(_ZERO, _ONE - rw * rw - ry * ry - rz * rz)), x)
    elif abs(y) == largest:
        ry = np.copysign(np.sqrt(max(_ZERO, _ONE - rw * rw - rx * rx - rz * rz)), y)
    else:
        rz = np.copysign(np.sqrt(max(_ZERO, _ONE - rw * rw - rx * rx - ry * ry)), z)
    d[0] = w * rx - x * rw - (y * rz - z * ry)
    d[1] = w * ry - y * rw - (z * rx - x * rz)
    d[2] = w * rz - z * rw - (x * ry - y * rx)


@kernel()
def block_errors(quats, log_scales, errors):
    """Sum over every block of the squared error of the covariance, relative to that of the source, were it stored so.

    With l the squared scales, e the errors of their logs and d the vector part of the turn to the decoded rotation, that of
    one splat is 4 sum_k l_k^2 e_k^2 + 8 sum_k (l_i - l_j)^2 d_k^2 up to third order, i and j the axes other than k.

    quats       float32 (n, 4)  read, wxyz, any length
    log_scales  float32 (n, 3)  read
    errors      float64 (m,)    written
    """
    d = np.empty(3, np.float32)
    lows, steps = np.empty(3, np.float32), np.empty(3, np.float32)
    e, squares = np.empty(3, np.float32), np.empty(3, np.float32)
    limit = np.float32(MAX_LOG_SCALE)
    for block in range(errors.shape[0]):
        first, last = block * BLOCK, min((block + 1) * BLOCK, quats.shape[0])
        for a in range(3):
            low, high = limit, -limit
            for i in range(first, last):
                value = min(max(log_scales[i, a], -limit), limit)
                low, high = min(low, value), max(high, value)
            lows[a], steps[a] = low, (high - low) / np.float32(1023 if a == 1 else 2047)
        total = 0.0
        for i in range(first, last):
            longest = max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
            if not longest > -limit:
                continue
            for a in range(3):
                value = min(max(log_scales[i, a], -limit), limit)
                place = (value - lows[a]) / steps[a] if steps[a] > _ZERO else _ZERO
                e[a] = (np.floor(place + _HALF) - place) * steps[a]
                squares[a] = exp_nonpositive(np.float32(_TWO * (value - longest)))
            _turn(quats, i, d)
            stretched, turned, norm = _ZERO, _ZERO, _ZERO
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                stretched += squares[a] * squares[a] * e[a] * e[a]
                turned += (squares[b] - squares[c]) * (squares[b] - squares[c]) * d[a] * d[a]
                norm += squares[a] * squares[a]
            total += np.float64((stretched + _TWO * turned) / norm)
        errors[block] = 4.0 * total


@kernel()
def decode_blocks(words, bounds, logits, means, log_scales, opacity_logits, sh0):
    """Values of the splats of whole blocks.

    words           uint32 (n, 4)    read: position, rotation, scale, color
    bounds          float32 (m, 18)  read, a row for every 256 splats
    logits          float32 (256,)   read: opacity logit of every byte
    means           float32 (n, 3)   written
    log_scales      float32 (n, 3)   written
    opacity_logits  float32 (n,)     written
    sh0             float32 (n, 3)   written
    """
    for i in range(words.shape[0]):
        box = bounds[i // BLOCK]
        for part in range(2):
            word = words[i, 2 * part]
            for a in range(3):
                shift = np.uint32(21 if a == 0 else (11 if a == 1 else 0))
                levels = np.uint32(1023 if a == 1 else 2047)
                place = np.float64((word >> shift) & levels) / np.float64(levels)
                low, high = np.float64(box[6 * part + a]), np.float64(box[6 * part + 3 + a])
                value = np.float32(low * (1.0 - place) + high * place)
                if part == 0:
                    means[i, a] = value
                else:
                    log_scales[i, a] = value
        word = words[i, 3]
        for a in range(3):
            place = np.float64((word >> np.uint32(24 - 8 * a)) & np.uint32(255)) / 255.0
            color = np.float64(box[12 + a]) * (1.0 - place) + np.float64(box[15 + a]) * place
            sh0[i, a] = np.float32((color - 0.5) / SH_C0)
        opacity_logits[i] = logits[word & np.uint32(255)]


@kernel()
def encode_sh(shN, codes, counts):
    """Bytes of SH, channel by channel: the code whose value, 8 ((code + 1/2) / 256 - 1/2) but -4 and 4 at the ends, is nearest.

    shN     float32 (n, R, 3)  read, basis-major
    codes   uint8 (n, 3 R)     written, channel-major
    counts  int64 (NUM_COUNTS,)  added to
    """
    num_rest = shN.shape[1]
    for i in range(shN.shape[0]):
        for c in range(3):
            for k in range(num_rest):
                value = np.float64(shN[i, k, c]) * 32.0 + 128.0
                counts[INVALID] += not abs(value) < 1e300
                counts[SH] += (value < -0.5) | (value > 256.5)
                code = np.floor(value)
                # Halfway, as 0 is: up and down in turn, or scenes with many zeros would be tinted.
                code -= (code == value) & ((i + c + k) & 1)
                code = min(max(code, 1.0), 254.0)
                # The ends stand for 0 and 256, their neighbors for 1.5 and 254.5.
                code = 0.0 if value < 0.75 else (255.0 if value > 255.25 else code)
                codes[i, c * num_rest + k] = np.uint8(code)


@kernel()
def decode_sh(codes, table, shN):
    """Values of SH bytes.

    codes  uint8 (n, 3 R)     read, channel-major
    table  float32 (256,)     read: value of every byte
    shN    float32 (n, R, 3)  written, basis-major
    """
    num_rest = shN.shape[1]
    for i in range(shN.shape[0]):
        for c in range(3):
            for k in range(num_rest):
                shN[i, k, c] = table[codes[i, c * num_rest + k]]
