"""Codebooks of numbers: the optimum for the data, spanning all of it, and the index of the nearest entry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

_BINS = 2048
_DESCENT_ROUNDS = 64


def fit_codebook(values: Float32, weights: Float32 | None = None, *, size: int = 256, spans: bool = True) -> Float32:
    """Return the codebook with the smallest weighted squared error.

    Parameters
    ----------
    values
        (N,) finite numbers.
    weights
        (N,) positive weights; by default all alike.
    size
        Entries, at least 2.
    spans
        Keep the smallest and the largest value as the first and last entry, so that nothing lies outside.

    Returns
    -------
    Float32
        (size,) ascending; exactly the distinct values where there are no more than `size`, the last one repeated.

    Raises
    ------
    ValueError
        A value is not finite, or the size is below 2.

    Notes
    -----
    Dynamic programming over 2,048 bins (exact where there are no more distinct values), then descent on the values
    themselves. Bins follow the density of optimal codes, the cube root of the density of the data.

    Source
    ------
    Wu 1991, Optimal quantization by matrix searching; Panter and Dite 1951 (cube-root rule).
    """
    from gsplat_tools.kernels.scalar_dp import cluster_bins

    if size < 2:
        raise ValueError(f"size must be at least 2, got {size}")
    values = np.ravel(values)
    if not np.isfinite(values).all():
        raise ValueError("values must be finite")
    if values.size == 0:
        return np.zeros(size, np.float32)
    points, point_weights = _merge_equal(values, weights)
    if len(points) <= size:
        return _padded(points.astype(np.float32), size)
    # Centered, so that prefix sums of squares keep their digits.
    center = np.average(points, weights=point_weights)
    points = points - center
    prefix_weights = _prefix(point_weights)
    prefix_sums = _prefix(point_weights * points)
    edges = _bin_edges(points, point_weights)
    inner = size - 2 if spans else size
    bounds = np.empty(inner + 1, np.int64)
    squares = _prefix(point_weights * points * points)
    cluster_bins(prefix_weights[edges], prefix_sums[edges], squares[edges], inner, bounds)
    cuts = edges[bounds]
    weight = np.diff(prefix_weights[cuts])
    means = np.diff(prefix_sums[cuts]) / np.where(weight > 0, weight, 1)
    codebook = np.concatenate([points[:1], means, points[-1:]]) if spans else means
    codebook.sort()
    _descend(points, prefix_weights, prefix_sums, spans, codebook)
    codebook = np.clip(np.sort(codebook) + center, values.min(), values.max())
    if spans:
        codebook[0], codebook[-1] = values.min(), values.max()
    return codebook.astype(np.float32)


def nearest_entry(values: Float32, codebook: Float32) -> NDArray[np.int64]:
    """Return the index of the entry of an ascending codebook that is nearest to each value; ties go to the lower one."""
    middles = (codebook[:-1].astype(np.float64) + codebook[1:].astype(np.float64)) / 2
    return np.searchsorted(middles.astype(np.float32), values)


def _merge_equal(values: Float32, weights: Float32 | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distinct values in ascending order with their summed weights, float64."""
    if weights is None:
        points, counts = np.unique(values, return_counts=True)
        return points.astype(np.float64), counts.astype(np.float64)
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    first = np.flatnonzero(np.concatenate([[True], ascending[1:] != ascending[:-1]]))
    summed = np.add.reduceat(np.ravel(weights)[order].astype(np.float64), first)
    return ascending[first].astype(np.float64), np.maximum(summed, np.finfo(np.float64).tiny)


def _descend(
    points: NDArray[np.float64],
    prefix_weights: NDArray[np.float64],
    prefix_sums: NDArray[np.float64],
    keeps_ends: bool,
    codebook: NDArray[np.float64],
) -> None:
    """Improve a codebook in place by Lloyd rounds; with prefix sums one costs a binary search an entry."""
    for _ in range(_DESCENT_ROUNDS):
        middles = (codebook[:-1] + codebook[1:]) / 2
        cuts = np.concatenate([[0], np.searchsorted(points, middles), [len(points)]])
        weights = np.diff(prefix_weights[cuts])
        means = np.diff(prefix_sums[cuts]) / np.where(weights > 0, weights, 1)
        # Differences of long prefix sums may leave the interval by rounding.
        low, high = points[np.minimum(cuts[:-1], len(points) - 1)], points[np.maximum(cuts[1:] - 1, 0)]
        moves = (weights > 0) & (np.diff(cuts) > 0)
        if keeps_ends:
            moves[[0, -1]] = False
        updated = np.where(moves, np.clip(means, low, np.maximum(low, high)), codebook)
        if np.array_equal(updated, codebook):
            break
        codebook[:] = updated


def _bin_edges(points: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the first index of each bin, and the count at the end: at most `_BINS` bins, none empty."""
    if len(points) <= _BINS:
        return np.arange(len(points) + 1)
    # An interval of length d that holds weight w has density w / d; codes are spread as (w / d)^(1/3) d. Half of the bins
    # follow the ranks instead, so that far outliers cannot take them all.
    spread = np.cumsum(np.cbrt(weights[1:]) * np.cbrt(np.diff(points)) ** 2)
    shares = (spread / spread[-1] + np.arange(1, len(points)) / (len(points) - 1)) / 2
    ids = np.concatenate([[0], np.minimum((shares * _BINS).astype(np.int64), _BINS - 1)])
    return np.concatenate([np.flatnonzero(np.diff(ids, prepend=-1)), [len(points)]])


def _prefix(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([[0.0], np.cumsum(values)])


def _padded(entries: Float32, size: int) -> Float32:
    return np.concatenate([entries, np.full(size - len(entries), entries[-1], np.float32)])
