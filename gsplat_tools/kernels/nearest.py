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
def nearest_of_three(points, centroids, start, stop, labels, distances):
    """Nearest centroid of points with three coordinates, exact: search outward along the first coordinate.

    points     float32 (N, 3)  read
    centroids  float32 (K, 3)  read; ascending in the first coordinate
    start, stop  int           rows to do
    labels     int64 (N,)      written; the centroid met first wins a tie
    distances  float32 (N,)    written; squared distance
    """
    size = centroids.shape[0]
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        low, high = 0, size
        while low < high:
            middle = (low + high) // 2
            if centroids[middle, 0] < x:
                low = middle + 1
            else:
                high = middle
        up, down = low, low - 1
        best, best_k = np.float32(np.inf), 0
        while True:
            gap_up = centroids[up, 0] - x if up < size else np.float32(np.inf)
            gap_down = x - centroids[down, 0] if down >= 0 else np.float32(np.inf)
            is_up = gap_up <= gap_down
            gap = gap_up if is_up else gap_down
            if not gap * gap < best:
                break
            k = up if is_up else down
            dy, dz = centroids[k, 1] - y, centroids[k, 2] - z
            distance = gap * gap + dy * dy + dz * dz
            if distance < best:
                best, best_k = distance, k
            if is_up:
                up += 1
            else:
                down -= 1
        labels[i] = best_k
        distances[i] = best
