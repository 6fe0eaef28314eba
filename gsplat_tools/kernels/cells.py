"""Exact search for the nearest of many vectors: cells of vectors, left out where their boxes are too far away."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import device, kernel

GROUP = 8
"""Coordinates that are compared at once; what is left of a vector after them counts by its length."""

CELL = 64
"""Most vectors in a cell."""

BLOCK = 128
"""Points that go through the cells together."""


@device()
def _scan(x, tails, cell, sums, best):
    """Distances of one point to the vectors of a cell, as far as they can fall below `best`.

    Returns the place of the nearest and its squared distance, or -1, and the groups of coordinates that were looked at.
    """
    for e in range(CELL):
        sums[e] = np.float32(0)
    groups = cell.shape[0]
    for g in range(groups):
        part = cell[g]
        x0, x1, x2, x3 = x[g, 0], x[g, 1], x[g, 2], x[g, 3]
        x4, x5, x6, x7 = x[g, 4], x[g, 5], x[g, 6], x[g, 7]
        tail = tails[g]
        alive = np.int32(0)
        for e in range(CELL):
            d0, d1, d2, d3 = x0 - part[0, e], x1 - part[1, e], x2 - part[2, e], x3 - part[3, e]
            d4, d5, d6, d7 = x4 - part[4, e], x5 - part[5, e], x6 - part[6, e], x7 - part[7, e]
            total = sums[e] + (((d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)) + ((d4 * d4 + d5 * d5) + (d6 * d6 + d7 * d7)))
            sums[e] = total
            rest = tail - part[8, e]
            alive += np.int32(total + rest * rest < best)
        if alive == 0:
            return -1, best, g + 1
    nearest = -1
    for e in range(CELL):
        if sums[e] < best:
            nearest, best = e, sums[e]
    return nearest, best, groups


@kernel()
def nearest_in_cells(points, tails, cells, lows, highs, probes, is_exact, labels, distances):
    """Nearest vector of points whose vectors were turned so that the first coordinates differ most.

    points     float32 (N, G, GROUP)        read
    tails      float32 (N, G)               read; length of what follows each group
    cells      float32 (C, G, GROUP + 1, CELL)  read; coordinates and tails; infinite where a cell has no more vectors
    lows       float32 (C, GROUP + 1)       read; smallest coordinates and tail of the first group in each cell
    highs      float32 (C, GROUP + 1)       read
    probes     int                          cells that are looked at first, those whose boxes are nearest
    is_exact   bool                         then look at all others that may hold a nearer one
    start, stop  int                        rows to do
    labels     int64 (N,)      written; cell times CELL plus place
    distances  float32 (N,)    written; squared distance

    Returns the number of groups of coordinates compared, CELL vectors at a time.
    """
    num_cells = cells.shape[0]
    bounds = np.empty((num_cells, BLOCK), np.float32)
    across = np.empty((GROUP + 1, BLOCK), np.float32)
    best = np.empty(BLOCK, np.float32)
    least = np.empty(BLOCK, np.float32)
    chosen = np.empty(BLOCK, np.int32)
    sums = np.empty(CELL, np.float32)
    work = 0
    for first in range(0, points.shape[0], BLOCK):
        size = min(BLOCK, points.shape[0] - first)
        for p in range(BLOCK):
            i = first + min(p, size - 1)
            for j in range(GROUP):
                across[j, p] = points[i, 0, j]
            across[GROUP, p] = tails[i, 0]
            best[p] = np.float32(np.inf)
        for c in range(num_cells):
            for p in range(BLOCK):
                bounds[c, p] = np.float32(0)
            for j in range(GROUP + 1):
                low, high = lows[c, j], highs[c, j]
                for p in range(BLOCK):
                    below, above = low - across[j, p], across[j, p] - high
                    gap = max(above, below)
                    gap = max(np.float32(0), gap)
                    bounds[c, p] += gap * gap
        for _ in range(probes):
            for p in range(BLOCK):
                least[p], chosen[p] = np.float32(np.inf), 0
            for c in range(num_cells):
                for p in range(BLOCK):
                    is_less = bounds[c, p] < least[p]
                    least[p] = bounds[c, p] if is_less else least[p]
                    chosen[p] = np.int32(c) if is_less else chosen[p]
            for p in range(size):
                if least[p] < best[p]:
                    c = chosen[p]
                    place, best[p], done = _scan(points[first + p], tails[first + p], cells[c], sums, best[p])
                    work += done
                    if place >= 0:
                        labels[first + p] = c * CELL + place
                bounds[chosen[p], p] = np.float32(np.inf)
        if is_exact:
            for c in range(num_cells):
                for p in range(size):
                    if bounds[c, p] < best[p]:
                        place, best[p], done = _scan(points[first + p], tails[first + p], cells[c], sums, best[p])
                        work += done
                        if place >= 0:
                            labels[first + p] = c * CELL + place
        for p in range(size):
            distances[first + p] = best[p]
    return work
