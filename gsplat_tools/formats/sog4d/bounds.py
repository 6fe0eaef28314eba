"""Largest errors that a written bundle allows, from its own ranges and codebooks."""

from __future__ import annotations

from itertools import permutations
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.sog4d.bundle import read_meta

_ROUNDING = 2.0**-22
"""Relative slack for float32 results: two units in the last place."""


def bounds(source: GaussianCloud, stream: BinaryIO, frame: int) -> Bounds:
    """Return the largest errors of one frame.

    Parameters
    ----------
    source
        The frame as it was given to `write`.
    stream
        The bundle.
    frame
        Index of the frame.

    Returns
    -------
    Bounds
        means: half of range / 65535 an axis · opacities: half of 1 / 255 · sh0: distance to the nearest entry of the
        codebook · scales: what the distance to the nearest codebook entry allows, infinite for an axis that is too thin
        to show. Covariances and shN follow from them and from the palette, and are measured only.

    Raises
    ------
    FormatError
        The bundle cannot be read.
    """
    from gsplat_tools.codecs.scalar_codebook import nearest_entry

    meta, _ = read_meta(ZipReader(stream))
    low, high = meta.range_min[frame].astype(np.float64), meta.range_max[frame].astype(np.float64)
    means = (high - low) / 65535 / 2 + np.maximum(np.abs(low), np.abs(high)) * _ROUNDING
    entries = meta.sh0_codebook[nearest_entry(source.sh0, meta.sh0_codebook)]
    sh0 = np.abs(entries - source.sh0.astype(np.float64)) + np.abs(source.sh0) * _ROUNDING + np.float32(1e-30)
    return {
        "means": np.broadcast_to(means, source.means.shape),
        "opacities": np.full(len(source), 0.5 / 255 + _ROUNDING),
        "sh0": sh0,
        "scales": scale_bounds(source.log_scales, meta.scale_codebook),
    }


def scale_bounds(log_scales: NDArray[np.float32], codebook: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far each sorted log scale may lie from the one that is decoded, (N, 3).

    Notes
    -----
    Entries are chosen by `scale_coordinates` y = log(s + a m), m the largest scale. With every coordinate within d of the
    source's, m lies within a factor e^d, and a scale between e^(y-d) - a m e^d / and e^(y+d) - a m e^-d: nothing bounds its
    logarithm from below once the first of these is not positive. The order of axes that the encoder chose is not known
    here, so d is the largest over all six.
    """
    from gsplat_tools.codecs.palette import nearest_labels
    from gsplat_tools.formats.sog4d.codebooks import THIN, scale_coordinates

    with np.errstate(divide="ignore"):
        entries = scale_coordinates(np.log(codebook))
    points = scale_coordinates(log_scales)
    squares = np.max(
        [nearest_labels(np.ascontiguousarray(points[:, order]), entries)[1] for order in permutations(range(3))], axis=0
    )
    # Labels may be kept from the frame before at a price that the file does not tell; the default is far below this.
    reach = np.sqrt(squares + squares.mean()).astype(np.float64)[:, None] + 1e-6
    scales = np.exp(np.sort(log_scales.astype(np.float64), axis=1))
    added = THIN * scales[:, 2:]
    upper = (scales + added) * np.exp(reach) - added * np.exp(-reach)
    lower = (scales + added) * np.exp(-reach) - added * np.exp(reach)
    with np.errstate(divide="ignore", invalid="ignore"):
        above, below = np.log(upper / scales), np.log(scales / np.maximum(lower, 0.0))
    reached: NDArray[np.float64] = np.nan_to_num(np.maximum(above, below), nan=np.inf, posinf=np.inf)
    return reached + 1e-5
