"""Bounds of SH that are stored as the nearest entry of a palette: known from the palette in the file, by searching all of it.

Verification of conversions leaves them out, because that search takes as long as encoding; here it is what is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Format

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_HALF_STEP = 2.0**-24


def palette_limits(
    source: GaussianCloud, decoded: GaussianCloud, record: Format, stream: BinaryIO, frame: int
) -> Float64 | None:
    """Return the largest error of every SH coefficient, (N, K - 1, 3), or None where no palette bounds it.

    Parameters
    ----------
    source, decoded
        The splats as they were written, and as they were read.
    record, stream, frame
        The format, the file, and which of its frames.

    Notes
    -----
    Encoders search palettes exactly, so that the entry of a splat is no further from it than the nearest, at distance d,
    and no coefficient errs by more than that. Distances come from float32 products of D numbers, which are off by at most
    (D + 4) 2^-24 (|x| + |c|)^2 (Higham 2002, 3.5), c the entry: of two entries that are as near as that, either may be taken.
    Infinite where labels may have been kept from the frame before, or moved within a visual tolerance: how far is not in the
    file.
    """
    if record.id not in _PARTS or not source.sh_degree or source.sh_degree != decoded.sh_degree:
        return None
    limits = np.full(source.shN.shape, np.inf)
    if frame > 0:
        return limits
    stream.seek(0)
    for first, palette in _PARTS[record.id](stream):
        part = slice(first, first + palette.shape[1])
        points, taken = (cloud.shN[:, part].reshape(len(source), -1) for cloud in (source, decoded))
        limits[:, part] = nearest_distances(points, taken, palette.reshape(len(palette), -1))[:, None, None]
    return limits


def nearest_distances(points: Float32, taken: Float32, entries: Float32) -> Float64:
    """Return how far each point may lie from the entry that was taken for the nearest, (N,).

    Parameters
    ----------
    points
        (N, D).
    taken
        (N, D) entries that were taken; their length alone counts, for rounding.
    entries
        (K, D) all of them.
    """
    wide, all_entries = points.astype(np.float64), entries.astype(np.float64)
    nearest = np.empty(len(points), np.intp)
    halves = np.square(all_entries).sum(axis=1) / 2
    step = max(1, (1 << 22) // len(entries))
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        nearest[part] = (halves - wide[part] @ all_entries.T).argmin(axis=1)
    squares = np.square(wide - all_entries[nearest]).sum(axis=1)
    own, chosen, other = (np.linalg.norm(rows, axis=1) for rows in (wide, taken.astype(np.float64), all_entries[nearest]))
    rounding = (points.shape[1] + 4) * _HALF_STEP * (np.square(own + chosen) + np.square(own + other))
    return np.asarray(np.sqrt(squares + rounding))


def _sog(stream: BinaryIO) -> Iterator[tuple[int, Float32]]:
    from gsplat_tools.formats.sog.bundle import open_bundle

    bundle, _ = open_bundle(stream)
    assert bundle is not None
    if bundle.meta.tolerance is None and bundle.meta.has_rest:
        yield 0, bundle.palette()


def _sog4d(stream: BinaryIO) -> Iterator[tuple[int, Float32]]:
    from gsplat_tools.formats.sog4d.bundle import Bundle

    bundle = Bundle(stream)
    if bundle.meta.tolerance is not None:
        return
    first = 0
    for palette in bundle.meta.palettes:
        yield first, bundle.centroids(palette)
        first += palette.coefficients


def _splat4d(stream: BinaryIO) -> Iterator[tuple[int, Float32]]:
    from gsplat_tools.formats.splat4d.container import BAND_COEFFICIENTS, parse
    from gsplat_tools.formats.splat4d.reading import read_centroids

    for band in parse(stream).bands:
        count = BAND_COEFFICIENTS[band.number - 1]
        yield sum(BAND_COEFFICIENTS[: band.number - 1]), read_centroids(stream, band).reshape(-1, count, 3)


_PARTS = {"sog": _sog, "sog4d": _sog4d, "splat4d": _splat4d}
"""The palettes of a file: the first coefficient that each is about, and its entries (entries, coefficients, 3)."""
