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


LEAF_SIZE = 8
"""Centroids that are compared one by one at the bottom of a tree."""


@kernel()
def build_tree(centroids, order, axes, cuts):
    """Balanced tree over centroids with three coordinates: each node halves its range along its widest axis.

    centroids  float32 (K, 3)  read
    order      int64 (K,)      written; centroids in the order of the leaves
    axes       int64 (M,)      written; axis of node i, its children are 2 i + 1 and 2 i + 2, -1 for a leaf
    cuts       float32 (M,)    written; left of the cut are coordinates of at most this
    """
    size = centroids.shape[0]
    for k in range(size):
        order[k] = k
    axes[:] = -1
    nodes = axes.shape[0]
    starts, stops = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64)
    stops[0] = size
    values = np.empty(size, np.float32)
    part = np.empty(size, np.int64)
    for node in range(nodes):
        start, stop = starts[node], stops[node]
        if stop - start <= LEAF_SIZE:
            continue
        best, widest = np.float32(-1), 0
        for axis in range(3):
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for j in range(start, stop):
                low = min(low, centroids[order[j], axis])
                high = max(high, centroids[order[j], axis])
            if high - low > best:
                best, widest = high - low, axis
        for j in range(start, stop):
            values[j - start] = centroids[order[j], widest]
            part[j - start] = order[j]
        ranks = np.argsort(values[: stop - start], kind="mergesort")
        for j in range(stop - start):
            order[start + j] = part[ranks[j]]
        middle = (start + stop) // 2
        axes[node], cuts[node] = widest, centroids[order[middle - 1], widest]
        starts[2 * node + 1], stops[2 * node + 1] = start, middle
        starts[2 * node + 2], stops[2 * node + 2] = middle, stop


@kernel()
def nearest_in_tree(points, leaves, order, axes, cuts, start, stop, labels, distances):
    """Nearest centroid of points with three coordinates, exact.

    points     float32 (N, 3)  read
    leaves     float32 (K, 3)  read; centroids in the order of the leaves
    order, axes, cuts          read; as `build_tree` writes them
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
