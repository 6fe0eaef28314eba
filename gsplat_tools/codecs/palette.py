"""Palettes of vectors: weighted k-means, and the label of the nearest entry."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from gsplat_tools.parallel import run_blocks

Float32 = NDArray[np.float32]
Labels = NDArray[np.int64]

_TILE_ELEMENTS = 1 << 22
"""Distances held at once by a thread: 16 MiB, in tiles that depend on the palette alone."""

_TOLERANCE = 2e-3
"""Rounds end when one lowers the error by less than this share."""

_LEAF_SIZE = 8
"""Entries that are compared one by one at the bottom of a tree."""

_MIN_FIRST_POINTS = 1 << 15
_FIRST_POINTS_PER_ENTRY = 8
_MOMENT_ROWS = 4096


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

    with one_blas_thread():
        run_blocks(assign, len(points), tile)
    return labels, distances


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep matrix products to the thread that calls them: blocks already keep all processors busy.

    Products that start threads of their own wait for each other, a multiple of the time where the machine does other
    work as well.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def _nearest_of_three(points: Float32, centroids: Float32) -> tuple[Labels, Float32]:
    """Return labels and squared distances by an exact search."""
    from gsplat_tools.kernels.nearest import nearest_in_tree

    centroids = np.ascontiguousarray(centroids, np.float32)
    points = np.ascontiguousarray(points, np.float32)
    order, axes, cuts = _build_tree(centroids)
    leaves = centroids[order]
    labels = np.empty(len(points), np.int64)
    distances = np.empty(len(points), np.float32)
    run_blocks(
        lambda start, stop: nearest_in_tree(points, leaves, order, axes, cuts, start, stop, labels, distances), len(points)
    )
    return labels, distances


def _build_tree(centroids: Float32) -> tuple[Labels, NDArray[np.int64], Float32]:
    """Return a balanced tree: the order of the leaves, and the axis (-1 for a leaf) and the cut of every node.

    Each node halves its range along its widest axis; a level at a time, all its nodes at once.
    """
    size = len(centroids)
    order = np.arange(size)
    depth = max(0, int(np.ceil(np.log2(size / _LEAF_SIZE)))) + 1
    axes, cuts = np.full((1 << (depth + 1)) - 1, -1, np.int64), np.zeros((1 << (depth + 1)) - 1, np.float32)
    nodes, starts, stops = np.zeros(1, np.int64), np.zeros(1, np.int64), np.full(1, size)
    while True:
        is_wide = stops - starts > _LEAF_SIZE
        nodes, starts, stops = nodes[is_wide], starts[is_wide], stops[is_wide]
        if len(nodes) == 0:
            return order, axes, cuts
        lengths = stops - starts
        owners = np.repeat(np.arange(len(nodes)), lengths)
        firsts = np.cumsum(lengths) - lengths
        places = np.arange(len(owners)) - firsts[owners] + starts[owners]
        rows = centroids[order[places]]
        spans = np.maximum.reduceat(rows, firsts) - np.minimum.reduceat(rows, firsts)
        widest = spans.argmax(axis=1)
        values = rows[np.arange(len(rows)), widest[owners]]
        ranks = np.lexsort((values, owners))
        order[places] = order[places[ranks]]
        middles = (starts + stops) // 2
        axes[nodes] = widest
        cuts[nodes] = centroids[order[middles - 1], widest]
        nodes = np.concatenate([2 * nodes + 1, 2 * nodes + 2])
        starts, stops = np.concatenate([starts, middles]), np.concatenate([middles, stops])


def fit_palette(points: Float32, weights: Float32, *, size: int, max_rounds: int = 3) -> Float32:
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
    of converged k-means. Cuts and the first round take an even choice of 8 points an entry, 32,768 at least; later rounds
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
    if max_rounds > 0 and len(some) < len(points):
        centroids, _ = _refine(some, some_weights, centroids)
        max_rounds -= 1
    before = np.inf
    for _ in range(max_rounds):
        centroids, error = _refine(points, weights, centroids)
        if error >= before * (1 - _TOLERANCE):
            break
        before = error
    return centroids


def _refine(points: Float32, weights: Float32, centroids: Float32) -> tuple[Float32, float]:
    """Return centroids after one Lloyd round, and the weighted error before it."""
    labels, distances = nearest_labels(points, centroids)
    error = float(np.dot(distances.astype(np.float64), weights))
    return _means_of_clusters(points, weights, labels, distances, centroids), error


def principal_axes(points: Float32, weights: Float32) -> tuple[Float32, Float32]:
    """Return the weighted mean (D,) and the principal directions as columns (D, D), the widest first.

    Sums run over fixed blocks, so that the number of threads changes nothing.
    """
    dimensions = points.shape[1]
    total = float(weights.sum(dtype=np.float64))
    center = (np.einsum("n,nd->d", weights.astype(np.float64), points) / total).astype(np.float32)
    if dimensions <= 3:
        return center, np.eye(dimensions, dtype=np.float32)
    moments = np.zeros((dimensions, dimensions))
    for start in range(0, len(points), _MOMENT_ROWS):
        offsets = (points[start : start + _MOMENT_ROWS] - center).astype(np.float64)
        moments += (offsets * weights[start : start + _MOMENT_ROWS, None]).T @ offsets
    _, axes = np.linalg.eigh(moments / total)
    axes = axes[:, ::-1]
    # Eigenvectors have no sign of their own: make the largest component positive.
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(dimensions)])
    return center, np.ascontiguousarray(axes * np.where(signs == 0, 1, signs), np.float32)


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
