"""Spark's 16-byte splats, in float64 and to the bit as its own encoder computes them.

Splats go through in batches of LANES, one quantity after another, so that the compiler can use vector instructions.
The two transcendental functions are monotonic, so that a code is found by comparison with the value at which it changes.

Source: docs/formats/spark.md, from encodeQuatOctXy88R8 and setPackedSplat of @sparkjsdev/spark 2.2.0 (tools/golden_spark).
"""

import numpy as np

from gsplat_tools.constants import SH_C0
from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS

LANES = 64
FLAT_LN_SCALE = -30.0
"""Scales below e^-30 are stored as code 0, exactly flat."""

RGB_MIN, RGB_MAX, LN_MIN, LN_MAX = 0, 1, 2, 3
"""Places in the array of ranges that the kernels take."""

OVERFLOWS, INVALID, COLORS, SCALES, FLATTENED = 0, 1, 2, 3, 4
"""Places in the array of counts: splats beyond half's range, splats with values that are not numbers, clamped color
channels, clamped scale axes, finite scales that became flat."""
NUM_COUNTS = 5

W, X, Y, Z, LN, OPACITY, RED = 0, 1, 2, 3, 4, 7, 8
"""Rows of the batch: quaternion, three logs of scales, opacity code, three color channels."""
NUM_ROWS = 11


def _round_half_up(values):
    """Round as Math.round does."""
    below = np.floor(values)
    return below + (values - below >= 0.5)


def _last_ws():
    """Return for each code of the angle the largest w (float64) that gives it or a larger one; 0 has +inf."""
    codes = np.arange(1.0, 256.0)
    low, high = np.zeros(255), np.ones(255)  # the code at w = 0 is 255, at w = 1 it is 0
    for _ in range(70):
        middle = 0.5 * (low + high)
        holds = _round_half_up(2.0 * np.arccos(middle) * (255.0 / np.pi)) >= codes
        low, high = np.where(holds, middle, low), np.where(holds, high, middle)
    return np.concatenate(([np.inf], low, [-np.inf]))


_LAST_WS = _last_ws()

# acos(w) = sqrt(1 - w) p(w) within 2e-8 (Abramowitz and Stegun 4.4.46): the code is found to within one, then made exact.
_ACOS = (1.5707963050, -0.2145988016, 0.0889789874, -0.0501743046, 0.0308918810, -0.0170881256, 0.0066700901, -0.0012624911)
_ANGLE_STEPS = 2.0 * 255.0 / np.pi

_LOGIT_LIMIT = 7.0
_CELLS = 128.0
"""Cells per unit of logit: 255 sigmoid(x) rises by at most 0.498 in one, so that at most one code begins there."""


def _sigmoid_cells():
    """Return for each cell of the logit its first code, and the first float32 in it that has the next code (or +inf)."""
    edges = (np.arange(int(2 * _LOGIT_LIMIT * _CELLS) + 1) / _CELLS - _LOGIT_LIMIT).astype(np.float32)

    def code(logits):
        return _round_half_up(1.0 / (1.0 + np.exp(-logits.astype(np.float64))) * 255.0)

    first = code(edges)
    low, high = edges[:-1].copy(), edges[1:].copy()
    for _ in range(40):
        middle = (0.5 * (low.astype(np.float64) + high)).astype(np.float32)
        holds = code(middle) > first[:-1]
        low, high = np.where(holds, low, middle), np.where(holds, middle, high)
    steps = np.where(code(high) > first[:-1], high, np.float32(np.inf))
    return np.append(first[:-1], first[-1]), np.append(steps, np.float32(np.inf))


_CELL_CODES, _CELL_STEPS = _sigmoid_cells()


@device()
def opacity_code(logit):
    """Code of sigmoid(logit), as float64; not a number gives 0.

    logit  float32
    """
    place = (np.float64(logit) + _LOGIT_LIMIT) * _CELLS
    if not place > 0.0:
        return 0.0
    cell = np.int64(min(place, 2.0 * _LOGIT_LIMIT * _CELLS))
    # Above the last cell, and at +inf, which is no smaller than its step, the code stays 255.
    return min(_CELL_CODES[cell] + (1.0 if logit >= _CELL_STEPS[cell] else 0.0), 255.0)


@device()
def pack_lanes(rows, halves, start, count, ranges, packed, counts):
    """Words of up to LANES splats.

    rows    float64 (NUM_ROWS, LANES)  read and overwritten: quaternion of any length, 0 being the identity; natural logs
                                       of the scales, -inf being flat; opacity code 0..255; color
    halves  uint16 (N, 3)              read: position
    start   int                        splat of the first lane
    count   int                        lanes that hold splats
    ranges  float64 (4,)               read: RGB_MIN, RGB_MAX, LN_MIN, LN_MAX
    packed  uint32 (N, 4)              written from `start` on
    counts  int64 (NUM_COUNTS,)        added to
    """
    low, extent = ranges[RGB_MIN], ranges[RGB_MAX] - ranges[RGB_MIN]
    ln_min, steps = ranges[LN_MIN], 254.0 / (ranges[LN_MAX] - ranges[LN_MIN])
    # Loops run over all lanes; those without a splat hold values that clamp nothing.
    for j in range(count, LANES):
        for k in range(NUM_ROWS):
            rows[k, j] = low if k >= RED else (ln_min if LN <= k < OPACITY else 0.0)
    invalid = 0
    for j in range(LANES):
        total = rows[0, j]
        for k in range(1, NUM_ROWS):
            total += max(rows[k, j], -1e300) if LN <= k < OPACITY else rows[k, j]
        invalid += 0 if abs(total) < np.inf else 1
    counts[INVALID] += invalid

    clamped = 0
    for k in range(RED, RED + 3):
        for j in range(LANES):
            value = (rows[k, j] - low) / extent * 255.0
            below = np.floor(value)
            code = below + 1.0 if value - below >= 0.5 else below
            clamped += 1 if code < 0.0 else 0
            clamped += 1 if code > 255.0 else 0
            code = max(0.0, code)
            rows[k, j] = min(255.0, code)
    counts[COLORS] += clamped

    clamped, flattened = 0, 0
    for k in range(LN, LN + 3):
        for j in range(LANES):
            ln_scale = rows[k, j]
            value = (ln_scale - ln_min) * steps
            below = np.floor(value)
            code = (below + 1.0 if value - below >= 0.5 else below) + 1.0
            is_flat = ln_scale < FLAT_LN_SCALE
            is_clamped = (code < 1.0) | (code > 255.0)
            flattened += 1 if is_flat & (ln_scale > -np.inf) else 0
            clamped += 1 if is_clamped & (not is_flat) else 0
            code = max(1.0, code)
            code = min(255.0, code)
            rows[k, j] = 0.0 if is_flat else code
    counts[SCALES] += clamped
    counts[FLATTENED] += flattened

    pack_rotations(rows)
    overflows = 0
    for j in range(count):
        i = start + j
        x, y, z = np.uint32(halves[i, 0]), np.uint32(halves[i, 1]), np.uint32(halves[i, 2])
        packed[i, 0] = (
            np.uint32(np.int32(rows[RED, j]))
            | (np.uint32(np.int32(rows[RED + 1, j])) << np.uint32(8))
            | (np.uint32(np.int32(rows[RED + 2, j])) << np.uint32(16))
            | (np.uint32(np.int32(rows[OPACITY, j])) << np.uint32(24))
        )
        packed[i, 1] = x | (y << np.uint32(16))
        packed[i, 2] = (
            z | (np.uint32(np.int32(rows[X, j])) << np.uint32(16)) | (np.uint32(np.int32(rows[Y, j])) << np.uint32(24))
        )
        packed[i, 3] = (
            np.uint32(np.int32(rows[LN, j]))
            | (np.uint32(np.int32(rows[LN + 1, j])) << np.uint32(8))
            | (np.uint32(np.int32(rows[LN + 2, j])) << np.uint32(16))
            | (np.uint32(np.int32(rows[W, j])) << np.uint32(24))
        )
        infinity = np.uint32(0x7C00)
        is_over = ((x & infinity) == infinity) | ((y & infinity) == infinity) | ((z & infinity) == infinity)
        overflows += 1 if is_over else 0
    counts[OVERFLOWS] += overflows


@device()
def pack_rotations(rows):
    """Replace quaternions by the codes of the octahedral axis, u and v, in rows X and Y, and of the angle in row W.

    rows  float64 (NUM_ROWS, LANES)  rows W, X, Y, Z read, W, X, Y written
    """
    for j in range(LANES):
        w, x, y, z = rows[W, j], rows[X, j], rows[Y, j], rows[Z, j]
        length = np.sqrt(x * x + y * y + z * z + w * w)
        # The division by the length is a product with its reciprocal in the original, here and at the axis.
        is_null = length == 0.0
        factor = 1.0 / (1.0 if is_null else length)
        w = 1.0 if is_null else w * factor
        factor = -factor if w < 0.0 else factor
        w = abs(w)
        x, y, z = x * factor, y * factor, z * factor
        norm = np.sqrt(x * x + y * y + z * z)
        has_axis = norm >= 1e-6
        factor = 1.0 / (norm if has_axis else 1.0)
        x = x * factor if has_axis else 1.0
        y = y * factor if has_axis else 0.0
        z = z * factor if has_axis else 0.0
        total = abs(x) + abs(y) + abs(z)
        px, py = x / total, y / total
        folded_x = (1.0 - abs(py)) if px >= 0.0 else -(1.0 - abs(py))
        folded_y = (1.0 - abs(px)) if py >= 0.0 else -(1.0 - abs(px))
        u = ((folded_x if z < 0.0 else px) * 0.5 + 0.5) * 255.0
        v = ((folded_y if z < 0.0 else py) * 0.5 + 0.5) * 255.0
        below_u, below_v = np.floor(u), np.floor(v)
        rows[X, j] = below_u + 1.0 if u - below_u >= 0.5 else below_u
        rows[Y, j] = below_v + 1.0 if v - below_v >= 0.5 else below_v
        rows[W, j] = w
        # Rounding can leave w just above 1, where the original's angle is not a number and its code 0.
        w = min(1.0, w)
        angle = _ACOS[7]
        for k in range(6, -1, -1):
            angle = angle * w + _ACOS[k]
        rows[Z, j] = np.floor(np.sqrt(1.0 - w) * angle * _ANGLE_STEPS + 0.5)
    for j in range(LANES):
        code = np.int64(rows[Z, j])
        code = min(max(code, 0), 255)
        w = rows[W, j]
        code += 1 if w <= _LAST_WS[code + 1] else 0
        rows[W, j] = np.float64(code - (1 if w > _LAST_WS[code] else 0))


@kernel()
def encode_values(halves, ln_scales, quats, opacities, colors, ranges, packed, counts):
    """Words of splats whose values are activated.

    halves     uint16 (N, 3)       read: positions as halves
    ln_scales  float64 (N, 3)      read, -inf where flat
    quats      float64 (N, 4)      read, wxyz
    opacities  float64 (N,)        read, 0..1; clamped
    colors     float64 (N, 3)      read
    ranges     float64 (4,)        read
    packed     uint32 (N, 4)       written
    counts     int64 (NUM_COUNTS,) added to
    """
    rows = np.empty((NUM_ROWS, LANES), np.float64)
    for start in range(0, halves.shape[0], LANES):
        count = min(LANES, halves.shape[0] - start)
        for j in range(count):
            i = start + j
            for k in range(4):
                rows[k, j] = quats[i, k]
            for k in range(3):
                rows[LN + k, j] = ln_scales[i, k]
                rows[RED + k, j] = colors[i, k]
            below = np.floor(opacities[i] * 255.0)
            code = below + 1.0 if opacities[i] * 255.0 - below >= 0.5 else below
            rows[OPACITY, j] = min(code, 255.0) if code > 0.0 else 0.0
        pack_lanes(rows, halves, start, count, ranges, packed, counts)


@kernel()
def encode_cloud(halves, log_scales, quats, opacity_logits, sh0, frames, ranges, packed, counts):
    """Words of splats as a cloud holds them, each in the frame that was chosen for it.

    halves          uint16 (N, 3)       read: positions as halves
    log_scales      float32 (N, 3)      read, -inf where flat
    quats           float32 (N, 4)      read, wxyz
    opacity_logits  float32 (N,)        read
    sh0             float32 (N, 3)      read
    frames          uint8 (N,)          read: frame of each splat; empty: all as they are
    ranges          float64 (4,)        read
    packed          uint32 (N, 4)       written
    counts          int64 (NUM_COUNTS,) added to
    """
    rows = np.empty((NUM_ROWS, LANES), np.float64)
    has_frames = frames.shape[0] > 0
    for start in range(0, halves.shape[0], LANES):
        count = min(LANES, halves.shape[0] - start)
        for j in range(count):
            i = start + j
            for k in range(4):
                rows[k, j] = np.float64(quats[i, k])
            for k in range(3):
                rows[LN + k, j] = np.float64(log_scales[i, k])
                rows[RED + k, j] = np.float64(sh0[i, k]) * SH_C0 + 0.5
            rows[OPACITY, j] = opacity_code(opacity_logits[i]) if opacity_logits[i] == opacity_logits[i] else np.nan
        if has_frames:
            for j in range(count):
                i = start + j
                f = np.int64(frames[i])
                w, x, y, z = rows[W, j], rows[X, j], rows[Y, j], rows[Z, j]
                a, b, c, d = FRAME_QUATS[f, 0], FRAME_QUATS[f, 1], FRAME_QUATS[f, 2], FRAME_QUATS[f, 3]
                rows[W, j] = w * a - x * b - y * c - z * d
                rows[X, j] = w * b + x * a + y * d - z * c
                rows[Y, j] = w * c - x * d + y * a + z * b
                rows[Z, j] = w * d + x * c - y * b + z * a
                for k in range(3):
                    rows[LN + k, j] = np.float64(log_scales[i, FRAME_AXES[f, k]])
        pack_lanes(rows, halves, start, count, ranges, packed, counts)
