"""Attributes of .spz: bytes of every splat, an attribute after the other, and back.

Source: docs/formats/spz.md, from nianticlabs/spz.
"""

import numpy as np

from gsplat_tools.kernels._jit import kernel

SCALES, COLORS, SH, INVALID, POSITIONS = 0, 1, 2, 3, 4
"""Places in the array of counts: clamped scale axes, color channels and SH values, values that are not a number, splats
whose position does not fit."""
NUM_COUNTS = 5

_LIMIT = 8388608.0


@kernel()
def encode_splats(means, log_scales, opacity_logits, sh0, steps, positions, alphas, colors, scales, counts):
    """Bytes of positions, opacities, colors and scales.

    means           float32 (N, 3)  read
    log_scales      float32 (N, 3)  read
    opacity_logits  float32 (N,)    read
    sh0             float32 (N, 3)  read
    steps           float64         steps per world unit, a power of two
    positions       uint8 (N, 9)    written, 24 bits little-endian, two's complement
    alphas          uint8 (N,)      written
    colors          uint8 (N, 3)    written
    scales          uint8 (N, 3)    written
    counts          int64 (NUM_COUNTS,)  added to
    """
    for i in range(means.shape[0]):
        is_outside = False
        for a in range(3):
            value = np.rint(np.float64(means[i, a]) * steps)
            fits = (value >= -_LIMIT) & (value < _LIMIT)
            is_outside |= not fits
            code = np.uint32(np.int32(value if fits else 0.0))
            positions[i, 3 * a] = np.uint8(code & np.uint32(255))
            positions[i, 3 * a + 1] = np.uint8((code >> np.uint32(8)) & np.uint32(255))
            positions[i, 3 * a + 2] = np.uint8((code >> np.uint32(16)) & np.uint32(255))
        counts[POSITIONS] += is_outside
        for a in range(3):
            value = np.floor((np.float64(log_scales[i, a]) + 10.0) * 16.0 + 0.5)
            counts[INVALID] += np.isnan(value)
            counts[SCALES] += (value < 0.0) | (value > 255.0)
            scales[i, a] = np.uint8(min(max(value, 0.0), 255.0))
            value = np.floor((np.float64(sh0[i, a]) * 0.15 + 0.5) * 255.0 + 0.5)
            counts[INVALID] += np.isnan(value)
            counts[COLORS] += (value < 0.0) | (value > 255.0)
            colors[i, a] = np.uint8(min(max(value, 0.0), 255.0))
        logit = np.float64(opacity_logits[i])
        counts[INVALID] += np.isnan(logit)
        alphas[i] = np.uint8(min(max(np.floor(255.0 / (1.0 + np.exp(-logit)) + 0.5), 0.0), 255.0))


@kernel()
def encode_sh(shN, bucket1, bucket_rest, codes, counts):
    """Bytes of SH: 128 (x + 1) rounded to a multiple of the bucket.

    shN          float32 (N, R, 3)  read
    bucket1      int                bucket of band 1
    bucket_rest  int                bucket of the bands above
    codes        uint8 (N, 3 R)     written
    counts       int64 (NUM_COUNTS,)  added to
    """
    for i in range(shN.shape[0]):
        for k in range(shN.shape[1]):
            bucket = np.float64(bucket1 if k < 3 else bucket_rest)
            inverse = 1.0 / bucket
            half = bucket * 0.5
            for c in range(3):
                value = np.float64(shN[i, k, c]) * 128.0 + 128.0
                counts[INVALID] += not abs(value) < 1e300
                counts[SH] += (value < -half) | (value > 255.0 + half)
                code = np.floor(value * inverse + 0.5) * bucket
                codes[i, 3 * k + c] = np.uint8(min(max(code, 0.0), 255.0))


@kernel()
def decode_positions(positions, step, means):
    """Centers of 24-bit numbers.

    positions  uint8 (N, 9)    read
    step       float64         world units of a step, a power of two
    means      float32 (N, 3)  written
    """
    for i in range(positions.shape[0]):
        for a in range(3):
            low = np.int64(positions[i, 3 * a]) | (np.int64(positions[i, 3 * a + 1]) << 8)
            value = low | (np.int64(positions[i, 3 * a + 2]) << 16)
            value = value - 16777216 if value >= 8388608 else value
            means[i, a] = np.float32(np.float64(value) * step)


@kernel()
def look_up(codes, table, values):
    """Value of every code.

    codes   uint8 (M,)      read
    table   float32 (256,)  read
    values  float32 (M,)    written
    """
    for i in range(codes.shape[0]):
        values[i] = table[codes[i]]
