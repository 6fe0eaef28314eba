"""Spark's SH words: signed values of a few bits each, one after another in a string of 32-bit words.

Source: docs/formats/spark.md, from encodeSh1Rgb, encodeSh2Rgb and encodeSh3Rgb of @sparkjsdev/spark 2.2.0.
"""

import numpy as np

from gsplat_tools.kernels._jit import kernel

LANES = 64

CLAMPED, INVALID = 0, 1
"""Places in the array of counts: values beyond the range by more than half a step, values that are not finite."""


@kernel()
def encode_band(rest, first, scale, then, limit, bits, num_values, packed, counts):
    """Words of one band.

    rest        float32 (N, V)           read: coefficients of all bands, r g b interleaved
    first       int                      column of the band's first value
    scale       float64                  factor of the values
    then        float64                  second factor; the original multiplies band 2 twice
    limit       float64                  largest code
    bits        int                      bits a code
    num_values  int                      values of the band
    packed      uint32 (N, ceil(num_values bits / 32))  written
    counts      int64 (2,)               added to: CLAMPED, INVALID
    """
    words = np.empty((4, LANES), np.uint32)
    codes = np.empty(LANES, np.uint32)
    values = np.empty(LANES, np.float64)
    num_words = packed.shape[1]
    mask = np.uint32((1 << bits) - 1)
    clamped, invalid = 0, 0
    for start in range(0, rest.shape[0], LANES):
        count = min(LANES, rest.shape[0] - start)
        for k in range(4):
            for j in range(LANES):
                words[k, j] = np.uint32(0)
        for v in range(num_values):
            for j in range(count):
                values[j] = np.float64(rest[start + j, first + v]) * scale * then
            for j in range(count, LANES):
                values[j] = 0.0
            for j in range(LANES):
                value = values[j]
                invalid += 0 if abs(value) < np.inf else 1
                below = np.floor(value)
                code = below + 1.0 if value - below >= 0.5 else below
                clamped += 1 if abs(code) > limit else 0
                code = max(-limit, code)
                code = min(limit, code)
                codes[j] = np.uint32(np.int32(code)) & mask
            place = v * bits
            word, shift = place >> 5, np.uint32(place & 31)
            for j in range(LANES):
                words[word, j] |= codes[j] << shift
            if (place & 31) + bits > 32:
                rest_shift = np.uint32(32 - (place & 31))
                for j in range(LANES):
                    words[word + 1, j] |= codes[j] >> rest_shift
        for j in range(count):
            for k in range(num_words):
                packed[start + j, k] = words[k, j]
    counts[CLAMPED] += clamped
    counts[INVALID] += invalid


@kernel()
def decode_band(packed, bits, num_values, step, first, rest):
    """Values of one band.

    packed      uint32 (N, words)  read
    bits        int                bits a code
    num_values  int                values of the band
    step        float64            value of code 1
    first       int                column of the band's first value
    rest        float32 (N, V)     columns first .. first + num_values written
    """
    sign = np.int64(1) << (bits - 1)
    mask = (np.int64(1) << bits) - 1
    for i in range(packed.shape[0]):
        for v in range(num_values):
            place = v * bits
            word, shift = place >> 5, place & 31
            code = np.int64(packed[i, word]) >> shift
            if shift + bits > 32:
                code |= np.int64(packed[i, word + 1]) << (32 - shift)
            rest[i, first + v] = np.float32(np.float64(((code & mask) ^ sign) - sign) * step)
