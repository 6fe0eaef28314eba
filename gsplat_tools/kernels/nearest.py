"""Steps of vector quantization that a matrix product does not do: sums per cluster, and search in few dimensions."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import kernel


@kernel()
def add_to_clusters(points, weights, labels, sums, totals):
    """Add weighted points to the sums of their clusters, in order, so that the result has one value.

    points   float32 (N, D)  read
    weights  float32 (N,)    read
    labels   int64 (N,)      read; below K
    sums     float64 (K, D)  added to
    totals   float64 (K,)    added to
    """
    for i in range(points.shape[0]):
        k = labels[i]
        weight = np.float64(weights[i])
        totals[k] += weight
        for d in range(points.shape[1]):
            sums[k, d] += weight * np.float64(points[i, d])


@kernel()
def nearest_in_tree(points, leaves, order, axes, cuts, start, stop, labels, distances):
    """Nearest centroid of points with three coordinates, exact.

    points     float32 (N, 3)  read
    leaves     float32 (K, 3)  read; centroids in the order of the leaves
    order      int64 (K,)      read; index of each leaf's centroid
    axes       int64 (M,)      read; axis of node i, whose children are 2 i + 1 and 2 i + 2, -1 for a leaf
    cuts       float32 (M,)    read; left of the cut are coordinates of at most this; a node halves its range
    start, stop  int           rows to do
    labels     int64 (N,)      written; of equally near ones the centroid met first
    distances  float32 (N,)    written; squared distance
    """
    size = leaves.shape[0]
    waiting = np.empty((64, 3), np.int64)
    gaps = np.empty(64, np.float32)
    for i in range(start, stop):
        best, best_k = np.float32(np.inf), 0
        waiting[0, 0], waiting[0, 1], waiting[0, 2] = 0, 0, size
        gaps[0] = np.float32(0)
        depth = 1
        while depth > 0:
            depth -= 1
            if gaps[depth] >= best:
                continue
            node, low, high = waiting[depth, 0], waiting[depth, 1], waiting[depth, 2]
            while axes[node] >= 0:
                axis = axes[node]
                offset = points[i, axis] - cuts[node]
                middle = (low + high) // 2
                is_left = offset <= 0
                # The other side waits, with the distance to the cut as its least distance.
                waiting[depth, 0] = 2 * node + 2 if is_left else 2 * node + 1
                waiting[depth, 1] = middle if is_left else low
                waiting[depth, 2] = high if is_left else middle
                gaps[depth] = offset * offset
                depth += 1
                node = 2 * node + 1 if is_left else 2 * node + 2
                low, high = (low, middle) if is_left else (middle, high)
            for k in range(low, high):
                dx = points[i, 0] - leaves[k, 0]
                dy = points[i, 1] - leaves[k, 1]
                dz = points[i, 2] - leaves[k, 2]
                distance = dx * dx + dy * dy + dz * dz
                if distance < best:
                    best, best_k = distance, k
        labels[i] = order[best_k]
        distances[i] = best
