"""First guess of a palette: cells of points cut in two, always the one that errs most."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import device, kernel


@device()
def _measure(points, weights, order, start, stop, means, spreads):
    """Weighted mean and squared error of a cell in each dimension; returns the error over all of them."""
    dimensions = points.shape[1]
    for d in range(dimensions):
        means[d] = 0.0
        spreads[d] = 0.0
    total = 0.0
    for i in range(start, stop):
        row = order[i]
        weight = np.float64(weights[row])
        total += weight
        for d in range(dimensions):
            x = np.float64(points[row, d])
            means[d] += weight * x
            spreads[d] += weight * x * x
    error = 0.0
    for d in range(dimensions):
        means[d] /= total
        spreads[d] = max(spreads[d] - total * means[d] * means[d], 0.0)
        error += spreads[d]
    return error


@device()
def _push(heap, errors, size, cell):
    """Add a cell to a heap with the largest error on top."""
    heap[size] = cell
    child = size
    while child > 0:
        parent = (child - 1) // 2
        if errors[heap[parent]] >= errors[heap[child]]:
            break
        heap[parent], heap[child] = heap[child], heap[parent]
        child = parent


@device()
def _pop(heap, errors, size):
    """Take the cell with the largest error off a heap of `size` cells."""
    top = heap[0]
    heap[0] = heap[size - 1]
    parent = 0
    while True:
        child = 2 * parent + 1
        if child >= size - 1:
            break
        if child + 1 < size - 1 and errors[heap[child + 1]] > errors[heap[child]]:
            child += 1
        if errors[heap[parent]] >= errors[heap[child]]:
            break
        heap[parent], heap[child] = heap[child], heap[parent]
        parent = child
    return top


@kernel()
def split_cells(points, weights, centroids, order):
    """Cut the points into cells at the mean of their widest dimension, the cell with the largest error first.

    points     float32 (N, D)  read; short vectors around their mean keep their digits
    weights    float32 (N,)    read; positive
    centroids  float32 (K, D)  written; weighted means of the cells
    order      int64 (N,)      written; the points, cell by cell

    Returns the number of cells, less than K only where all that are left hold equal points.
    """
    count, dimensions = points.shape
    wanted = centroids.shape[0]
    for i in range(count):
        order[i] = i
    starts, stops = np.empty(wanted, np.int64), np.empty(wanted, np.int64)
    errors, widest = np.empty(wanted), np.empty(wanted, np.int64)
    cuts = np.empty(wanted)
    means, spreads = np.empty(dimensions), np.empty(dimensions)
    heap = np.empty(wanted, np.int64)
    waiting, num_cells = 0, 1
    starts[0], stops[0] = 0, count
    fresh = np.zeros(2, np.int64)
    num_fresh = 1
    while True:
        for f in range(num_fresh):
            cell = fresh[f]
            errors[cell] = _measure(points, weights, order, starts[cell], stops[cell], means, spreads)
            best = 0
            for d in range(dimensions):
                centroids[cell, d] = np.float32(means[d])
                if spreads[d] > spreads[best]:
                    best = d
            widest[cell], cuts[cell] = best, means[best]
            if stops[cell] - starts[cell] > 1 and errors[cell] > 0.0:
                _push(heap, errors, waiting, cell)
                waiting += 1
        if num_cells == wanted or waiting == 0:
            break
        cell = _pop(heap, errors, waiting)
        waiting -= 1
        d, cut = widest[cell], np.float32(cuts[cell])
        left, right = starts[cell], stops[cell] - 1
        while left <= right:
            if points[order[left], d] <= cut:
                left += 1
            else:
                order[left], order[right] = order[right], order[left]
                right -= 1
        num_fresh = 0
        if left == starts[cell] or left == stops[cell]:
            continue  # equal in the widest dimension but for rounding
        starts[num_cells], stops[num_cells] = left, stops[cell]
        stops[cell] = left
        fresh[0], fresh[1] = cell, num_cells
        num_fresh = 2
        num_cells += 1
    return num_cells
