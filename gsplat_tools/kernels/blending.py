"""Compositing of tiles: falloff, alpha and blending of every splat of a list, in its order.

A tile is drawn in a buffer of its own, by groups of LANES pixels side by side, each as transmittance, red, green, blue.
"""

import numpy as np

from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.exponential import exp_nonpositive
from gsplat_tools.kernels.tile_binning import TILE_HEIGHT, TILE_WIDTH

LANES = 16
"""Pixels that are computed together. The compiler turns loops of 16 into vector code; shorter ones it unrolls instead."""

_GROUPS = TILE_WIDTH // LANES
_RED, _GREEN, _BLUE = LANES, 2 * LANES, 3 * LANES
_GROUP_SIZE = 4 * LANES


@device()
def _fill_alphas(record, rules, x_first, y, alphas):
    """Write the alphas of a group of pixels; 0 where the model draws nothing.

    record   float (RECORD_SIZE,)  read
    rules    float (RULES_SIZE,)   read
    x_first  float                 center of the first pixel, relative to the splat
    y        float                 center of the row, relative to the splat
    alphas   float (LANES,)        written
    """
    f = rules.dtype.type
    zero = f(0)
    opacity = record[R.REC_OPACITY]
    gain, offset = rules[R.GAIN], rules[R.OFFSET]
    cutoff, cap, floor = rules[R.CUTOFF], rules[R.ALPHA_CAP], rules[R.ALPHA_FLOOR]
    s = record[R.REC_S]
    row = record[R.REC_K] * y
    q_row = record[R.REC_H] * y
    q_row = q_row * q_row
    for lane in range(LANES):
        u = s * (x_first + f(lane)) + row
        q = u * u + q_row
        alpha = min(cap, opacity * (gain * exp_nonpositive(-q) - offset))
        alphas[np.uintp(lane)] = alpha if (q <= cutoff) & (alpha >= floor) else zero


@device()
def _fill_alphas_in_axes(record, rules, x_first, y, alphas):
    """Do as `_fill_alphas`, with what depends on the splat's own axes: the sides of the quad and the edge of the falloff."""
    f = rules.dtype.type
    zero, half = f(0), f(0.5)
    opacity = record[R.REC_OPACITY]
    gain, offset = rules[R.GAIN], rules[R.OFFSET]
    cutoff, cap, floor = rules[R.CUTOFF], rules[R.ALPHA_CAP], rules[R.ALPHA_FLOOR]
    edge_start, edge_slope = rules[R.EDGE_START], rules[R.EDGE_SLOPE]
    edge_gain = rules[R.EDGE_GAIN]
    ux, vx = record[R.REC_UX], record[R.REC_VX]
    row_u, row_v = record[R.REC_UY] * y, record[R.REC_VY] * y
    box = record[R.REC_BOX]
    for lane in range(LANES):
        x = x_first + f(lane)
        u, v = abs(ux * x + row_u), abs(vx * x + row_v)
        q = u * u + v * v
        side = max(u, v)
        edge = edge_gain * exp_nonpositive(min(zero, (half * side - edge_start) * edge_slope))
        alpha = min(cap, opacity * (gain * exp_nonpositive(-q) - offset - edge))
        alphas[np.uintp(lane)] = alpha if (q <= cutoff) & (side <= box) & (alpha >= floor) else zero


@device()
def _blend_front(alphas, red, green, blue, stop, buffer, at):
    """Add a splat behind what is there; return how many pixels it finished.

    A finished pixel keeps its transmittance with a negative sign.
    """
    f = buffer.dtype.type
    zero, one = f(0), f(1)
    finished = np.int32(0)
    for lane in range(LANES):
        i = at + np.uintp(lane)
        transmittance = buffer[i]
        alpha = alphas[np.uintp(lane)] if transmittance > zero else zero
        rest = transmittance * (one - alpha)
        ends = (rest < stop) & (alpha > zero)
        weight = zero if ends else alpha * transmittance
        buffer[i] = -transmittance if ends else rest
        buffer[i + np.uintp(_RED)] += weight * red
        buffer[i + np.uintp(_GREEN)] += weight * green
        buffer[i + np.uintp(_BLUE)] += weight * blue
        finished += np.int32(ends)
    return finished


@device()
def _blend_back(alphas, red, green, blue, buffer, at):
    """Draw a splat over what is there."""
    one = buffer.dtype.type(1)
    for lane in range(LANES):
        i = at + np.uintp(lane)
        alpha = alphas[np.uintp(lane)]
        rest = one - alpha
        buffer[i] *= rest
        buffer[i + np.uintp(_RED)] = alpha * red + buffer[i + np.uintp(_RED)] * rest
        buffer[i + np.uintp(_GREEN)] = alpha * green + buffer[i + np.uintp(_GREEN)] * rest
        buffer[i + np.uintp(_BLUE)] = alpha * blue + buffer[i + np.uintp(_BLUE)] * rest


@device()
def _blend_quantized(alphas, red, green, blue, rounding, buffer, at):
    """Draw a splat over a framebuffer of 8 bits: the fragment is clamped to [0, 1], the result rounded to steps of 1/255."""
    f = buffer.dtype.type
    zero, one, steps = f(0), f(1), f(255)
    for lane in range(LANES):
        i = at + np.uintp(lane)
        alpha = alphas[np.uintp(lane)]
        rest = one - alpha
        covered = alpha + (one - buffer[i]) * rest
        buffer[i] = one - ((covered * steps + rounding) - rounding) / steps
        i += np.uintp(_RED)
        value = min(one, min(one, max(zero, alpha * red)) + buffer[i] * rest)
        buffer[i] = ((value * steps + rounding) - rounding) / steps
        i += np.uintp(LANES)
        value = min(one, min(one, max(zero, alpha * green)) + buffer[i] * rest)
        buffer[i] = ((value * steps + rounding) - rounding) / steps
        i += np.uintp(LANES)
        value = min(one, min(one, max(zero, alpha * blue)) + buffer[i] * rest)
        buffer[i] = ((value * steps + rounding) - rounding) / steps


@device()
def _load_tile(planes, x, y, buffer):
    """Copy a tile of the planes into the buffer; return how many of its pixels are not finished."""
    zero = buffer.dtype.type(0)
    live = 0
    for row in range(TILE_HEIGHT):
        for column in range(TILE_WIDTH):
            at = (row * _GROUPS + column // LANES) * _GROUP_SIZE + column % LANES
            for plane in range(4):
                buffer[at + plane * LANES] = planes[plane, y + row, x + column]
            live += 1 if buffer[at] > zero else 0
    return live


@device()
def _store_tile(buffer, x, y, planes):
    """Copy the buffer back."""
    for row in range(TILE_HEIGHT):
        for column in range(TILE_WIDTH):
            at = (row * _GROUPS + column // LANES) * _GROUP_SIZE + column % LANES
            for plane in range(4):
                planes[plane, y + row, x + column] = buffer[at + plane * LANES]


@kernel()
def blend_tiles(records, bounds, lists, offsets, first_list, start, stop, rules, choices, planes):
    """Draw the lists of the tiles start .. stop - 1.

    records      float (N, RECORD_SIZE)  read
    bounds       int32 (N, 4)            read
    lists        uint32 (entries,)       read; splats of each tile in drawing order
    offsets      int64 (tiles + 1,)      read; where each list starts, from offsets[first_list] on
    first_list   int                     tile of the first list
    start, stop  int                     range of tiles
    rules        float (RULES_SIZE,)     read
    choices      int64 (CHOICES_SIZE,)   read
    planes       float (4, H, W)         read and written; transmittance, red, green, blue, padded to whole tiles
    """
    f = rules.dtype.type
    half = f(0.5)
    alphas = np.empty(LANES, planes.dtype)
    buffer = np.empty(TILE_HEIGHT * _GROUPS * _GROUP_SIZE, planes.dtype)
    in_axes = choices[R.IN_AXES] != 0
    is_front = choices[R.IS_FRONT_TO_BACK] != 0
    is_quantized = choices[R.IS_QUANTIZED] != 0
    stop_below, rounding = rules[R.STOP], rules[R.ROUNDING]
    tiles_x = planes.shape[2] // TILE_WIDTH
    for tile in range(start, stop):
        left, top = (tile % tiles_x) * TILE_WIDTH, (tile // tiles_x) * TILE_HEIGHT
        live = _load_tile(planes, left, top, buffer)
        for entry in range(offsets[tile] - offsets[first_list], offsets[tile + 1] - offsets[first_list]):
            i = lists[entry]
            record = records[i]
            red, green, blue = record[R.REC_R], record[R.REC_G], record[R.REC_B]
            first = (max(bounds[i, 0], left) - left) // LANES
            last = (min(bounds[i, 1], left + TILE_WIDTH) - left + LANES - 1) // LANES
            for y in range(max(bounds[i, 2], top), min(bounds[i, 3], top + TILE_HEIGHT)):
                dy = (f(y) + half) - record[R.REC_Y]
                for group in range(first, last):
                    dx = (f(left + group * LANES) + half) - record[R.REC_X]
                    at = np.uintp(((y - top) * _GROUPS + group) * _GROUP_SIZE)
                    if in_axes:
                        _fill_alphas_in_axes(record, rules, dx, dy, alphas)
                    else:
                        _fill_alphas(record, rules, dx, dy, alphas)
                    if is_front:
                        live -= _blend_front(alphas, red, green, blue, stop_below, buffer, at)
                    elif is_quantized:
                        _blend_quantized(alphas, red, green, blue, rounding, buffer, at)
                    else:
                        _blend_back(alphas, red, green, blue, buffer, at)
            if is_front and live <= 0:
                break
        _store_tile(buffer, left, top, planes)
