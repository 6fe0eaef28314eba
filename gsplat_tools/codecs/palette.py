"""Palettes of vectors: weighted k-means, and the label of the nearest entry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.parallel import run_blocks

Float32 = NDArray[np.float32]
Labels = NDArray[np.int64]

_TILE_ELEMENTS = 1 << 22
"""Distances held at once by a thread: 16 MiB, in tiles that depend on the palette alone."""

_TOLERANCE = 2e-3
"""Rounds end when one lowers the error by less than this share."""


def nearest_labels(points: Float32, centroids: Float32, penalties: Float32 | None = None) -> tuple[Labels, Float32]:
    """Return the label of the nearest centroid of every point, and the squared distance.

    Parameters
    ----------
    points
        (N, D).
    centroids
        (K, D).
    penalties
        (K,) added to the squared distance to each centroid, as a price; by default nothing.

    Returns
    -------
    tuple[Labels, Float32]
        (N,) int64 labels; (N,) squared distances, without the penalty. Three dimensions without a price are searched
        exactly; else distances come from a matrix product, and near-ties within float32 rounding may go either way.
    """
    if points.shape[1] == 3 and penalties is None:
        return _nearest_of_three(points, centroids)
    center = centroids.mean(axis=0, dtype=np.float64).astype(np.float32)  # short vectors keep their digits
    entries = centroids - center
    norms = np.einsum("kd,kd->k", entries, entries)
    table = np.ascontiguousarray(np.vstack([-2 * entries.T, norms if penalties is None else norms + penalties]), np.float32)
    labels = np.empty(len(points), np.int64)
    distances = np.empty(len(points), np.float32)
    tile = max(64, _TILE_ELEMENTS // len(centroids))

    def assign(start: int, stop: int) -> None:
        block = np.ones((stop - start, table.shape[0]), np.float32)
        np.subtract(points[start:stop], center, out=block[:, :-1])
        scores = np.matmul(block, table)
        labels[start:stop] = scores.argmin(axis=1)
        offsets = points[start:stop] - centroids[labels[start:stop]]
        distances[start:stop] = np.einsum("nd,nd->n", offsets, offsets)

    run_blocks(assign, len(points), tile)
    return labels, distances


def _nearest_of_three(points: Float32, centroids: Float32) -> tuple[Labels, Float32]:
    """Return labels and squared distances by an exact search."""
    from gsplat_tools.kernels.nearest import nearest_of_three

    order = np.argsort(centroids[:, 0], kind="stable")
    ascending = np.ascontiguousarray(centroids[order], np.float32)
    points = np.ascontiguousarray(points, np.float32)
    labels = np.empty(len(points), np.int64)
    distances = np.empty(len(points), np.float32)
    run_blocks(lambda start, stop: nearest_of_three(points, ascending, start, stop, labels, distances), len(points))
    return order[labels], distances


def fit_palette(points: Float32, weights: Float32, *, size: int, seed: int = 0, max_rounds: int = 10) -> Float32:
    """Return at most `size` centroids with a small weighted squared error to the points.

    Parameters
    ----------
    points
        (N, D) finite sample.
    weights
        (N,) positive weights.
    size
        Largest number of centroids.
    seed
        Of the first choice of centroids; the same seed gives the same bits at any number of threads.
    max_rounds
        Lloyd rounds at most; they end earlier when the error hardly falls.

    Returns
    -------
    Float32
        (K, D), K <= size; the distinct points themselves where they are no more than `size`.

    Raises
    ------
    ValueError
        The size is below 1, or there is no point.
    """
    if size < 1 or len(points) == 0:
        raise ValueError(f"needs a size of at least 1 and at least one point, got {size} and {len(points)}")
    points = np.ascontiguousarray(points, np.float32)
    if len(points) <= size or _has_few_distinct(points, size):
        distinct = np.unique(points, axis=0)
        if len(distinct) <= size:
            return distinct
    centroids = _first_centroids(points, weights, size, seed)
    before = np.inf
    for _ in range(max_rounds):
        labels, distances = nearest_labels(points, centroids)
        error = float(np.dot(distances.astype(np.float64), weights))
        centroids = _means_of_clusters(points, weights, labels, distances, centroids)
        if error >= before * (1 - _TOLERANCE):
            break
        before = error
    return centroids


def _has_few_distinct(points: Float32, size: int) -> bool:
    """Whether a sample of the points repeats itself so much that counting all is worth the time."""
    sample = points[:: max(1, len(points) // 4096)]
    return len(np.unique(sample, axis=0)) < min(size, 0.9 * len(sample))


def _first_centroids(points: Float32, weights: Float32, size: int, seed: int) -> Float32:
    """Draw distinct points without replacement, with odds that follow the square root of the weights."""
    # Exponential keys: the `size` smallest of E_i / p_i are a draw without replacement (Efraimidis and Spirakis 2006).
    keys = np.random.default_rng(seed).exponential(size=len(points)) / np.sqrt(weights.astype(np.float64))
    chosen = np.sort(np.argsort(keys, kind="stable")[:size])
    return points[chosen]


def _means_of_clusters(points: Float32, weights: Float32, labels: Labels, distances: Float32, centroids: Float32) -> Float32:
    """Return the weighted means; empty clusters move to the points that err most."""
    from gsplat_tools.kernels.nearest import add_to_clusters

    sums = np.zeros(centroids.shape, np.float64)
    totals = np.zeros(len(centroids), np.float64)
    add_to_clusters(points, np.ascontiguousarray(weights, np.float32), labels, sums, totals)
    is_empty = totals <= 0
    means = (sums / np.where(is_empty, 1.0, totals)[:, None]).astype(np.float32)
    if is_empty.any():
        worst = np.argsort(-(distances.astype(np.float64) * weights), kind="stable")[: np.count_nonzero(is_empty)]
        means[np.flatnonzero(is_empty)[: len(worst)]] = points[worst]
    return means
