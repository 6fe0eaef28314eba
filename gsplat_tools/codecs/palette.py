"""Palettes of vectors: weighted k-means, and the label of the nearest entry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.codecs.vector_search import nearest_labels, one_blas_thread, principal_axes
from gsplat_tools.remembering import remembered

__all__ = ["fit_palette", "nearest_labels", "principal_axes"]

Float32 = NDArray[np.float32]
Labels = NDArray[np.int64]

_TOLERANCE = 2e-3
"""Rounds end when one lowers the error by less than this share."""

_STEP = np.float32(1.8)
"""How far entries move towards the mean of their points and beyond, but for the last round: four rounds then do what seven
do without, and the end is better (docs/codebooks.md)."""

_PROBES = 16
"""Cells that rounds look at for each point: they end where exact rounds do, in a third of the time (docs/codebooks.md)."""

_MIN_FIRST_POINTS = 1 << 15
_FIRST_POINTS_PER_ENTRY = 16


@remembered
def fit_palette(points: Float32, weights: Float32, *, size: int, max_rounds: int = 5) -> Float32:
    """Return at most `size` centroids with a small weighted squared error to the points.

    Parameters
    ----------
    points
        (N, D) finite sample.
    weights
        (N,) positive weights.
    size
        Largest number of centroids.
    max_rounds
        Lloyd rounds at most; they end earlier when the error hardly falls.

    Returns
    -------
    Float32
        (K, D), K <= size, close entries near each other; the distinct points themselves where they are no more than
        `size`. The same bits at any number of threads.

    Raises
    ------
    ValueError
        The size is below 1, or there is no point.

    Notes
    -----
    The cell that errs most is cut in two along its widest principal direction until there are `size` cells; Lloyd rounds
    then start from their means. Nothing is drawn at random. In three dimensions the cuts alone come within a few percent
    of converged k-means. Cuts and the first round take an even choice of 16 points an entry, 32,768 at least; later rounds
    take all points (docs/codebooks.md).
    """
    if size < 1 or len(points) == 0:
        raise ValueError(f"needs a size of at least 1 and at least one point, got {size} and {len(points)}")
    points = np.ascontiguousarray(points, np.float32)
    weights = np.ascontiguousarray(weights, np.float32)
    with one_blas_thread():
        return _fit(points, weights, size, max_rounds)


def _fit(points: Float32, weights: Float32, size: int, max_rounds: int) -> Float32:
    """Cut, then refine; see `fit_palette`."""
    from gsplat_tools.kernels.splitting import split_cells

    chosen = slice(None, None, max(1, len(points) // max(_MIN_FIRST_POINTS, _FIRST_POINTS_PER_ENTRY * size)))
    some, some_weights = np.ascontiguousarray(points[chosen]), np.ascontiguousarray(weights[chosen])
    center, axes = principal_axes(some, some_weights)
    centroids = np.empty((min(size, len(some)), points.shape[1]), np.float32)
    turned = np.ascontiguousarray((some - center) @ axes)
    count = split_cells(turned, some_weights, centroids, np.empty(len(some), np.int64))
    centroids = centroids[:count] @ axes.T + center
    if count < size and len(some) == len(points):
        return np.unique(points, axis=0)  # every cell holds equal points
    before = np.inf
    for round_id in range(max_rounds):
        is_part = round_id == 0 and len(some) < len(points)
        rows, row_weights = (some, some_weights) if is_part else (points, weights)
        labels, distances = nearest_labels(rows, centroids, probes=_PROBES)
        error = np.inf if is_part else float(np.dot(distances.astype(np.float64), row_weights))
        is_last = round_id == max_rounds - 1 or (error >= before * (1 - _TOLERANCE) and np.isfinite(error))
        centroids = _moved(centroids, rows, row_weights, labels, distances, np.float32(1) if is_last else _STEP)
        if is_last:
            break
        before = error
    return centroids


def _moved(
    centroids: Float32, points: Float32, weights: Float32, labels: Labels, distances: Float32, step: np.float32
) -> Float32:
    """Return centroids after a step towards their weighted means; empty clusters move to the points that err most."""
    from gsplat_tools.kernels.nearest import add_to_clusters

    sums = np.zeros(centroids.shape, np.float64)
    totals = np.zeros(len(centroids), np.float64)
    add_to_clusters(points, weights, labels, sums, totals)
    is_empty = totals <= 0
    means = (sums / np.where(is_empty, 1.0, totals)[:, None]).astype(np.float32)
    moved = means if step == 1 else centroids + step * (means - centroids)
    if is_empty.any():
        worst = np.argsort(-(distances.astype(np.float64) * weights), kind="stable")[: np.count_nonzero(is_empty)]
        places = np.flatnonzero(is_empty)
        moved[places] = centroids[places]
        moved[places[: len(worst)]] = points[worst]
    return moved
