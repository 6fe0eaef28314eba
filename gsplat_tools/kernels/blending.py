"""Compositing of tiles: falloff, alpha and blending of every splat of a list, in its order."""

import numpy as np

from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.exponential import exp_nonpositive
from gsplat_tools.kernels.tile_binning import TILE_HEIGHT, TILE_WIDTH

LANES = 8
"""Pixels that are computed together; a tile is a whole number of them wide."""


@device()
def _fill_alphas(record, rules, has_edge, x_first, y, alphas):
    """Write the alpha of LANES pixels of a row; 0 where the model draws nothing.

    record   float (RECORD_SIZE,)  read
    rules    float (RULES_SIZE,)   read
    x_first  float                 center of the first pixel, relative to the splat
    y        float                 center of the row, relative to the splat
    alphas   float (LANES,)        written
    """
    f = rules.dtype.type
    zero, half = f(0), f(0.5)
    opacity = record[R.REC_OPACITY]
    gain, offset = rules[R.GAIN], rules[R.OFFSET]
    cutoff, cap, floor = rules[R.CUTOFF], rules[R.ALPHA_CAP], rules[R.ALPHA_FLOOR]
    if not has_edge:
        s = record[R.REC_S]
        row = record[R.REC_K] * y
        q_row = record[R.REC_H] * y
        q_row = q_row * q_row
        for lane in range(LANES):
            u = s * (x_first + f(lane)) + row
            q = u * u + q_row
            alpha = min(cap, opacity * (gain * exp_nonpositive(-q) - offset))
            alphas[lane] = alpha if (q <= cutoff) & (alpha >= floor) else zero
        return
    ux, vx = record[R.REC_UX], record[R.REC_VX]
    row_u, row_v = record[R.REC_UY] * y, record[R.REC_VY] * y
    box = record[R.REC_BOX]
    edge_start, edge_slope = rules[R.EDGE_START], rules[R.EDGE_SLOPE]
    for lane in range(LANES):
        x = x_first + f(lane)
        u, v = abs(ux * x + row_u), abs(vx * x + row_v)
        q = u * u + v * v
        side = max(u, v)
        edge = exp_nonpositive(min(zero, (half * side - edge_start) * edge_slope)) if edge_slope > zero else zero
        alpha = min(cap, opacity * (gain * exp_nonpositive(-q) - offset - edge))
        alphas[lane] = alpha if (q <= cutoff) & (side <= box) & (alpha >= floor) else zero


@device()
def _blend_front(alphas, red, green, blue, stop, planes, at, size):
    """Add a splat behind what is there; return how many pixels it finished.

    A finished pixel keeps its transmittance with a negative sign.
    """
    f = planes.dtype.type
    zero, one = f(0), f(1)
    finished = np.int32(0)
    for lane in range(LANES):
        i = at + np.uintp(lane)
        transmittance = planes[i]
        alpha = alphas[lane] if transmittance > zero else zero
        rest = transmittance * (one - alpha)
        ends = (rest < stop) & (alpha > zero)
        weight = zero if ends else alpha * transmittance
        planes[i] = -transmittance if ends else rest
        planes[i + size] += weight * red
        planes[i + size + size] += weight * green
        planes[i + size + size + size] += weight * blue
        finished += np.int32(ends)
    return finished


@device()
def _blend_back(alphas, red, green, blue, planes, at, size):
    """Draw a splat over what is there."""
    one = planes.dtype.type(1)
    for lane in range(LANES):
        i = at + np.uintp(lane)
        alpha = alphas[lane]
        rest = one - alpha
        planes[i] *= rest
        j = i + size
        planes[j] = alpha * red + planes[j] * rest
        j += size
        planes[j] = alpha * green + planes[j] * rest
        j += size
        planes[j] = alpha * blue + planes[j] * rest


@device()
def _blend_quantized(alphas, red, green, blue, rounding, planes, at, size):
    """Draw a splat over a framebuffer of 8 bits: the fragment is clamped to [0, 1], the result rounded to steps of 1/255."""
    f = planes.dtype.type
    zero, one, steps = f(0), f(1), f(255)
    for lane in range(LANES):
        i = at + np.uintp(lane)
        alpha = alphas[lane]
        rest = one - alpha
        covered = alpha + (one - planes[i]) * rest
        planes[i] = one - ((covered * steps + rounding) - rounding) / steps
        j = i + size
        value = min(one, max(zero, alpha * red)) + planes[j] * rest
        planes[j] = min(one, ((value * steps + rounding) - rounding) / steps)
        j += size
        value = min(one, max(zero, alpha * green)) + planes[j] * rest
        planes[j] = min(one, ((value * steps + rounding) - rounding) / steps)
        j += size
        value = min(one, max(zero, alpha * blue)) + planes[j] * rest
        planes[j] = min(one, ((value * steps + rounding) - rounding) / steps)


@kernel()
def blend_tiles(records, bounds, lists, offsets, grid, start, stop, rules, choices, planes):
    """Draw the lists of the tiles start .. stop - 1.

    records      float (N, RECORD_SIZE)  read
    bounds       int32 (N, 4)            read
    lists        uint32 (entries,)       read; splats of each tile in drawing order
    offsets      int64 (tiles + 1,)      read; where each list starts, from offsets[first tile in lists] on
    grid         int64 (4,)              read; tiles in a row, pixels in a padded row, in a plane, first tile in lists
    start, stop  int                     range of tiles
    rules        float (RULES_SIZE,)     read
    choices      int64 (CHOICES_SIZE,)   read
    planes       float (4 * plane,)      read and written; transmittance, red, green, blue
    """
    f = rules.dtype.type
    half = f(0.5)
    alphas = np.empty(LANES, planes.dtype)
    has_edge = choices[R.HAS_EDGE] != 0
    is_front = choices[R.IS_FRONT_TO_BACK] != 0
    is_quantized = choices[R.IS_QUANTIZED] != 0
    stop_below = rules[R.STOP]
    tiles_x, pitch, base = grid[0], grid[1], offsets[grid[3]]
    size = np.uintp(grid[2])
    for tile in range(start, stop):
        tile_x = (tile % tiles_x) * TILE_WIDTH
        tile_y = (tile // tiles_x) * TILE_HEIGHT
        live = np.int32(0)
        for y in range(tile_y, tile_y + TILE_HEIGHT):
            for x in range(tile_x, tile_x + TILE_WIDTH):
                live += np.int32(planes[y * pitch + x] > f(0))
        for entry in range(offsets[tile] - base, offsets[tile + 1] - base):
            i = lists[entry]
            record = records[i]
            s, k, h, q = record[R.REC_S], record[R.REC_K], record[R.REC_H], record[R.REC_Q]
            center_x, center_y = record[R.REC_X], record[R.REC_Y]
            red, green, blue = record[R.REC_R], record[R.REC_G], record[R.REC_B]
            x_start, x_stop = max(bounds[i, 0], tile_x), min(bounds[i, 1], tile_x + TILE_WIDTH)
            for y in range(max(bounds[i, 2], tile_y), min(bounds[i, 3], tile_y + TILE_HEIGHT)):
                dy = (f(y) + half) - center_y
                left = q - (h * dy) * (h * dy)
                if left < f(0):
                    continue
                middle = center_x - k / s * dy
                reach = np.sqrt(left) / s
                # Half a pixel of margin: the test of each pixel decides.
                low, high = middle - reach - f(1), middle + reach + f(1)
                if low >= f(x_stop) or high <= f(x_start):
                    continue
                first = np.int64(max(low, f(x_start))) // LANES
                last = (np.int64(min(high, f(x_stop))) + LANES - 1) // LANES
                for group in range(first, min(last, (x_stop + LANES - 1) // LANES)):
                    x = group * LANES
                    _fill_alphas(record, rules, has_edge, (f(x) + half) - center_x, dy, alphas)
                    at = np.uintp(y * pitch + x)
                    if is_front:
                        live -= _blend_front(alphas, red, green, blue, stop_below, planes, at, size)
                    elif is_quantized:
                        _blend_quantized(alphas, red, green, blue, rules[R.ROUNDING], planes, at, size)
                    else:
                        _blend_back(alphas, red, green, blue, planes, at, size)
            if is_front and live <= 0:
                break
