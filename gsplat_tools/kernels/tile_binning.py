"""Lists of splats per tile, in drawing order: count, scan, scatter."""

import numpy as np

from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel

TILE_WIDTH = 32
TILE_HEIGHT = 16
"""Size of a tile, px; ours, whatever tiles the target has."""


@device()
def _edge(record, sign, y_low, y_high):
    """Return the right (sign 1) or left (-1) end of an ellipse between two rows, relative to its center.

    The boundary is x = (-k y +- sqrt(q - h^2 y^2)) / s; its extreme lies at y = -+ k sqrt(q) / (h sqrt(h^2 + k^2)).
    """
    s, k, h, q = record[R.REC_S], record[R.REC_K], record[R.REC_H], record[R.REC_Q]
    zero = record.dtype.type(0)
    reach = np.sqrt(q) / h
    y = -sign * reach * k / np.sqrt(h * h + k * k)
    y = min(max(y, y_low, -reach), y_high, reach)
    return (sign * np.sqrt(max(zero, q - h * h * y * y)) - k * y) / s


@device()
def _tile_range(record, bounds, tile_y):
    """Return (first, stop) of the tile columns that a splat touches in a row of tiles."""
    first, stop = bounds[0] // TILE_WIDTH, (bounds[1] - 1) // TILE_WIDTH + 1
    if stop - first <= 1:
        return first, stop
    f = record.dtype.type
    # A pixel of margin covers rounding.
    y_low = f(tile_y * TILE_HEIGHT - 1) - record[R.REC_Y]
    y_high = f((tile_y + 1) * TILE_HEIGHT + 1) - record[R.REC_Y]
    left = record[R.REC_X] + _edge(record, f(-1), y_low, y_high) - f(1)
    right = record[R.REC_X] + _edge(record, f(1), y_low, y_high) + f(1)
    low = np.int32(min(max(left, f(bounds[0])), f(bounds[1])))
    high = np.int32(min(max(right, f(bounds[0])), f(bounds[1] - 1)))
    return max(first, low // TILE_WIDTH), min(stop, high // TILE_WIDTH + 1)


@kernel()
def count_tiles(order, records, bounds, tiles_x, start, stop, counts):
    """Count how many splats of a block touch each tile.

    order        uint32 (M,)              read; indices of splats in drawing order
    records      float (N, RECORD_SIZE)   read
    bounds       int32 (N, 4)             read
    tiles_x      int                      tiles in a row
    start, stop  int                      range of the order
    counts       int64 (tiles,)           added to
    """
    for j in range(start, stop):
        i = order[j]
        for tile_y in range(bounds[i, 2] // TILE_HEIGHT, (bounds[i, 3] - 1) // TILE_HEIGHT + 1):
            first, last = _tile_range(records[i], bounds[i], tile_y)
            for tile_x in range(first, last):
                counts[tile_y * tiles_x + tile_x] += 1


@kernel()
def scatter_tiles(order, records, bounds, tiles_x, start, stop, first_tile, last_tile, positions, lists):
    """Write the splats of a block into the lists of the tiles first_tile .. last_tile - 1.

    order        uint32 (M,)              read; indices of splats in drawing order
    records      float (N, RECORD_SIZE)   read
    bounds       int32 (N, 4)             read
    tiles_x      int                      tiles in a row
    start, stop  int                      range of the order
    positions    int64 (tiles,)           read and advanced; next place of this block in each list
    lists        uint32 (entries,)        written
    """
    for j in range(start, stop):
        i = order[j]
        low_y = max(bounds[i, 2] // TILE_HEIGHT, first_tile // tiles_x)
        high_y = min((bounds[i, 3] - 1) // TILE_HEIGHT, (last_tile - 1) // tiles_x)
        for tile_y in range(low_y, high_y + 1):
            first, last = _tile_range(records[i], bounds[i], tile_y)
            for tile_x in range(first, last):
                tile = tile_y * tiles_x + tile_x
                if first_tile <= tile < last_tile:
                    lists[positions[tile]] = i
                    positions[tile] += 1
