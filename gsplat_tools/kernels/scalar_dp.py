"""Optimal one-dimensional clustering: dynamic programming over sorted bins."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import device, kernel


@device()
def _cost(first, last, weights, sums, squares):
    """Weighted squared error of bins first..last-1 around their mean, from prefix sums."""
    weight = weights[last] - weights[first]
    if weight <= 0.0:
        return 0.0
    total = sums[last] - sums[first]
    return max((squares[last] - squares[first]) - total * total / weight, 0.0)


@kernel()
def cluster_bins(weights, sums, squares, num_clusters, bounds):
    """Cut sorted bins into clusters with the least weighted squared error.

    weights, sums, squares  float64 (B + 1,)  read; prefix sums of w, w x, w x^2
    num_clusters            int               K, at least 1, at most B
    bounds                  int64 (K + 1,)    written; cluster k holds bins bounds[k]..bounds[k + 1] - 1

    The best start of the last cluster grows with its end (the cost is concave Monge), so that each layer is filled by
    halving the range of ends: K B log B steps (Wu 1991, Optimal quantization by matrix searching).
    """
    num_bins = weights.shape[0] - 1
    previous = np.empty(num_bins + 1)
    current = np.empty(num_bins + 1)
    starts = np.zeros((num_clusters, num_bins + 1), np.int32)
    for end in range(num_bins + 1):
        previous[end] = _cost(0, end, weights, sums, squares)
    stack = np.empty((64, 4), np.int64)
    for layer in range(1, num_clusters):
        for end in range(layer):
            current[end] = previous[end]
            starts[layer, end] = end
        stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = layer, num_bins, layer, num_bins
        depth = 1
        while depth > 0:
            depth -= 1
            low, high, first, last = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
            if low > high:
                continue
            end = (low + high) // 2
            best, best_start = np.inf, first
            for start in range(first, min(end, last) + 1):
                value = previous[start] + _cost(start, end, weights, sums, squares)
                if value < best:
                    best, best_start = value, start
            current[end], starts[layer, end] = best, best_start
            stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3] = low, end - 1, first, best_start
            stack[depth + 1, 0], stack[depth + 1, 1] = end + 1, high
            stack[depth + 1, 2], stack[depth + 1, 3] = best_start, last
            depth += 2
        previous, current = current, previous
    end = num_bins
    bounds[num_clusters] = end
    for layer in range(num_clusters - 1, -1, -1):
        end = starts[layer, end] if layer > 0 else 0
        bounds[layer] = end
