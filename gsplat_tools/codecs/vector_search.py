"""The nearest of many vectors: exact searches, and one that looks at the likeliest part alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from gsplat_tools.parallel import run_blocks
from gsplat_tools.remembering import remembered

Float32 = NDArray[np.float32]
Labels = NDArray[np.int64]

_TILE = 1024
"""Points and entries of one matrix product: 4 MiB of distances, which stay in the cache until they are compared."""

_LEAF_SIZE = 8
"""Entries that are compared one by one at the bottom of a tree."""

_MIN_CELLS = 16
"""Cells below which comparing with all entries costs less than leaving cells out."""

_FIRST_PROBES = 4
"""Cells that an exact search looks at before it leaves any out."""

_PILOT_POINTS = 512
_MAX_WORK = 0.3
"""Share of comparisons that is left at most where leaving cells out pays: products take less time for each."""

_CELL_POINTS = 2048
_SPLIT_AXES = 16
_MOMENT_ROWS = 4096


@remembered
def nearest_labels(
    points: Float32, centroids: Float32, *, probes: int | None = None, pilot: Float32 | None = None
) -> tuple[Labels, Float32]:
    """Return the label of the nearest centroid of every point, and the squared distance.

    Parameters
    ----------
    points
        (N, D).
    centroids
        (K, D).
    probes
        Look for each point at this many cells of at most 64 centroids alone, those whose boxes are nearest; by default the
        search is exact. Has no effect in three dimensions or below 1,024 centroids.
    pilot
        Rows on which it is tried how to search; by default `pilot_rows` of the points. Where the points are a part of more,
        those of all of them give every point the label that it has among all.

    Returns
    -------
    tuple[Labels, Float32]
        (N,) int64 labels; (N,) squared distances. Near-ties within float32 rounding may go either way. The same bits at
        any number of threads.
    """
    points, centroids = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(centroids, np.float32)
    if points.shape[1] == 3:
        return _nearest_of_three(points, centroids)
    with one_blas_thread():
        from gsplat_tools.kernels.cells import CELL

        if len(centroids) < _MIN_CELLS * CELL:
            return _nearest_by_products(points, centroids)
        cells = _Cells.of(centroids)
        if probes is None:
            tried = points[pilot_rows(len(points))] if pilot is None else pilot
            if cells.search(tried, _FIRST_PROBES, is_exact=True)[2] > _MAX_WORK:
                return _nearest_by_products(points, centroids)
        labels, distances, _ = cells.search(points, probes or _FIRST_PROBES, is_exact=probes is None)
    return labels, distances


def pilot_rows(count: int) -> slice:
    """Return which of `count` points an exact search is tried on: 512 at least where there are, and less than 1,024."""
    return slice(None, None, max(1, count // _PILOT_POINTS))


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


def _nearest_by_products(points: Float32, centroids: Float32) -> tuple[Labels, Float32]:
    """Return labels and squared distances by comparing all with all, as matrix products of fixed tiles."""
    center = centroids.mean(axis=0, dtype=np.float64).astype(np.float32)  # short vectors keep their digits
    entries = centroids - center
    # The square of an entry is one more dimension.
    table = np.vstack([-2 * entries.T, np.einsum("kd,kd->k", entries, entries)])
    tiles = [(first, np.ascontiguousarray(table[:, first : first + _TILE])) for first in range(0, len(centroids), _TILE)]
    labels = np.empty(len(points), np.int64)
    distances = np.empty(len(points), np.float32)

    def assign(start: int, stop: int) -> None:
        block = np.ones((stop - start, table.shape[0]), np.float32)
        np.subtract(points[start:stop], center, out=block[:, :-1])
        rows = np.arange(stop - start)
        best, chosen = np.full(len(rows), np.inf, np.float32), np.zeros(len(rows), np.int64)
        for first, tile in tiles:
            scores = block @ tile
            places = scores.argmin(axis=1)
            least = scores[rows, places]
            is_less = least < best
            best[is_less], chosen[is_less] = least[is_less], places[is_less] + first
        labels[start:stop] = chosen
        offsets = points[start:stop] - centroids[chosen]
        distances[start:stop] = np.einsum("nd,nd->n", offsets, offsets)

    run_blocks(assign, len(points), _TILE)
    return labels, distances


@dataclass(frozen=True, slots=True)
class _Cells:
    """Centroids turned to their principal axes, in cells of neighbors; see `kernels.cells`.

    Parameters
    ----------
    center, axes
        (D,) and (D, D): coordinates are (x - center) axes.
    entries
        (C, G, GROUP + 1, CELL) coordinates and tails.
    lows, highs
        (C, GROUP + 1) boxes.
    names
        (C CELL,) centroid in each slot.
    """

    center: Float32
    axes: Float32
    entries: Float32
    lows: Float32
    highs: Float32
    names: Labels

    @classmethod
    def of(cls, centroids: Float32) -> _Cells:
        """Cut the centroids in halves along their widest axis until they fit into cells."""
        from gsplat_tools.kernels.cells import CELL, GROUP

        center, axes = principal_axes(centroids, np.ones(len(centroids), np.float32))
        turned = np.matmul(centroids - center, axes)
        order, starts = _halve(np.ascontiguousarray(turned[:, :_SPLIT_AXES]), CELL)
        groups, tails = _grouped(turned[order])
        sizes = np.diff(starts, append=len(order))
        owners = np.repeat(np.arange(len(starts)), sizes)
        places = np.arange(len(order)) - np.repeat(starts, sizes)
        entries = np.full((len(starts), groups.shape[1], GROUP + 1, CELL), np.inf, np.float32)
        entries[owners, :, :GROUP, places] = groups
        entries[owners, :, GROUP, places] = tails
        boxed = np.concatenate([groups[:, 0], tails[:, :1]], axis=1)
        names = np.zeros(len(starts) * CELL, np.int64)
        names[owners * CELL + places] = order
        return cls(center, axes, entries, np.minimum.reduceat(boxed, starts), np.maximum.reduceat(boxed, starts), names)

    def search(self, points: Float32, probes: int, *, is_exact: bool) -> tuple[Labels, Float32, float]:
        """Return labels, squared distances, and the share of all comparisons that had to be made."""
        from gsplat_tools.kernels.cells import nearest_in_cells

        slots = np.empty(len(points), np.int64)
        distances = np.empty(len(points), np.float32)
        work = np.zeros(-(-len(points) // _CELL_POINTS), np.int64)

        def assign(start: int, stop: int) -> None:
            turned = np.matmul(points[start:stop] - self.center, self.axes)
            groups, tails = _grouped(turned)
            work[start // _CELL_POINTS] = nearest_in_cells(
                groups, tails, self.entries, self.lows, self.highs, probes, is_exact, slots[start:stop], distances[start:stop]
            )

        run_blocks(assign, len(points), _CELL_POINTS)
        return self.names[slots], distances, float(work.sum()) / (len(points) * self.entries.shape[0] * self.entries.shape[1])


def _grouped(turned: Float32) -> tuple[Float32, Float32]:
    """Return coordinates in groups, (N, G, GROUP), and the length of what follows each group, (N, G)."""
    from gsplat_tools.kernels.cells import GROUP

    count, dimensions = turned.shape
    groups = np.zeros((count, -(-dimensions // GROUP), GROUP), np.float32)
    groups.reshape(count, -1)[:, :dimensions] = turned
    squares = np.einsum("ngj,ngj->ng", groups, groups)
    tails = np.zeros(groups.shape[:2], np.float32)
    for g in range(groups.shape[1] - 2, -1, -1):
        tails[:, g] = tails[:, g + 1] + squares[:, g + 1]
    return groups, np.sqrt(tails)


def _halve(rows: Float32, size: int) -> tuple[Labels, Labels]:
    """Return an order of the rows, and where cells of at most `size` begin in it; all cells of a level are cut at once."""
    order = np.arange(len(rows))
    starts = np.zeros(1, np.int64)
    while True:
        sizes = np.diff(starts, append=len(rows))
        if sizes.max() <= size:
            return order, starts
        chosen = rows[order]
        means = np.add.reduceat(chosen, starts) / sizes[:, None]
        owners = np.repeat(np.arange(len(starts)), sizes)
        chosen -= means[owners]
        widest = np.add.reduceat(chosen * chosen, starts).argmax(axis=1)
        order = order[np.lexsort((chosen[np.arange(len(chosen)), widest[owners]], owners))]
        starts = np.stack([starts, starts + sizes // 2], axis=1).ravel()


def _nearest_of_three(points: Float32, centroids: Float32) -> tuple[Labels, Float32]:
    """Return labels and squared distances by an exact search."""
    from gsplat_tools.kernels.nearest import nearest_in_tree

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
