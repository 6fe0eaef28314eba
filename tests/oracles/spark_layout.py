"""Spark's layout one splat at a time, in Python's own float64 arithmetic, written from docs/formats/spark.md."""

import math

import numpy as np

SH_C0 = 0.28209479177387814


def rounded(value):
    """JavaScript's Math.round."""
    below = math.floor(value)
    return below + 1 if value - below >= 0.5 else below


def clamp(value, low, high):
    return max(low, min(high, value))


def rotation_codes(w, x, y, z):
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if length == 0:
        w, x, y, z = 1.0, 0.0, 0.0, 0.0
    else:
        inverse = 1 / length
        w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    norm = math.sqrt(x * x + y * y + z * z)
    axis = (1.0, 0.0, 0.0) if norm < 1e-6 else tuple(c * (1 / norm) for c in (x, y, z))
    total = sum(abs(c) for c in axis)
    px, py = axis[0] / total, axis[1] / total
    if axis[2] < 0:
        px, py = (1 - abs(py)) * (1 if px >= 0 else -1), (1 - abs(px)) * (1 if py >= 0 else -1)
    angle = rounded(2 * math.acos(w) * (255 / math.pi)) if w <= 1 else 0
    return rounded((px * 0.5 + 0.5) * 255), rounded((py * 0.5 + 0.5) * 255), angle


def decoded_rotation(u, v, angle):
    """Unit quaternion wxyz."""
    x, y = 2 * u / 255 - 1, 2 * v / 255 - 1
    z = 1 - abs(x) - abs(y)
    fold = max(-z, 0)
    x += -fold if x >= 0 else fold
    y += -fold if y >= 0 else fold
    length = math.sqrt(x * x + y * y + z * z)
    half = angle / 255 * math.pi / 2
    return (math.cos(half), *(c / length * math.sin(half) for c in (x, y, z)))


def scale_code(log_scale, low, high):
    if log_scale < -30:
        return 0
    return clamp(rounded((log_scale - low) * (254 / (high - low))) + 1, 1, 255)


def splat_words(mean, log_scales, quat, opacity_logit, sh0, rgb=(0.0, 1.0), ln=(-12.0, 9.0)):
    """Four words of a splat given as a 3DGS PLY holds it."""
    color = [clamp(rounded((float(c) * SH_C0 + 0.5 - rgb[0]) / (rgb[1] - rgb[0]) * 255), 0, 255) for c in sh0]
    logit = float(opacity_logit)
    opacity = 0.0 if logit < -700 else 1 / (1 + math.exp(-logit))
    color.append(rounded(opacity * 255))
    halves = [int(np.float16(c).view(np.uint16)) for c in mean]
    u, v, angle = rotation_codes(*(float(c) for c in quat))
    scales = [scale_code(float(s), *ln) for s in log_scales]
    return [
        color[0] | color[1] << 8 | color[2] << 16 | color[3] << 24,
        halves[0] | halves[1] << 16,
        halves[2] | u << 16 | v << 24,
        scales[0] | scales[1] << 8 | scales[2] << 16 | angle << 24,
    ]


def band_words(values, band, largest=1.0):
    """Words of one SH band: a long integer, cut into 32-bit pieces."""
    bits = {1: 7, 2: 8, 3: 6, 4: 4}[band]
    limit = 2 ** (bits - 1) - 1
    string = 0
    for i, value in enumerate(values):
        scaled = float(value) * (1 / largest) * limit if band == 2 else float(value) * (limit / largest)
        string |= (clamp(rounded(scaled), -limit, limit) % 2**bits) << (i * bits)
    return [string >> (32 * k) & 0xFFFFFFFF for k in range({1: 2}.get(band, 4))]
