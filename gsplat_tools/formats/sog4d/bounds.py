"""Largest errors that a written bundle allows, from its own ranges and codebooks."""

from __future__ import annotations

from itertools import permutations
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.sog4d.bundle import Bundle
from gsplat_tools.formats.sog4d.meta import frame_path
from gsplat_tools.formats.sog4d.textures import pixels_of

_ROUNDING = 2.0**-22
"""Relative slack for float32 results: two units in the last place."""

_LOG_SLACK = 1e-5
"""Slack for logarithms in float32, of scales that are text with a few digits."""


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
        to show · covariances: what these scales and the rounding of the rotation's bytes allow. shN is measured only.

    Raises
    ------
    FormatError
        The bundle cannot be read.
    """
    from gsplat_tools.codecs.scalar_codebook import nearest_entry

    bundle = Bundle(stream)
    meta = bundle.meta
    low, high = meta.range_min[frame].astype(np.float64), meta.range_max[frame].astype(np.float64)
    means = (high - low) / 65535 / 2 + np.maximum(np.abs(low), np.abs(high)) * _ROUNDING
    entries = meta.sh0_codebook[nearest_entry(source.sh0, meta.sh0_codebook)]
    sh0 = np.abs(entries - source.sh0.astype(np.float64)) + np.abs(source.sh0) * _ROUNDING + np.float32(1e-30)
    least, largest = scale_reach(source.log_scales, meta.scale_codebook, is_first=frame == 0)
    logs = source.log_scales.astype(np.float64)
    codes = pixels_of(bundle.image(frame_path(meta.rotation_path, frame), frame), len(source))
    return {
        "means": np.broadcast_to(means, source.means.shape),
        "opacities": np.full(len(source), 0.5 / 255 + _ROUNDING),
        "sh0": sh0,
        # Sorted values lie between the sorted ends of their intervals.
        "scales": _distance(np.sort(logs, axis=1), np.sort(least, axis=1), np.sort(largest, axis=1)),
        "covariances": covariance_bound_of_ranges(logs, least, largest, rotation_bound(codes)) + _ROUNDING,
    }


def _distance(values: NDArray[np.float64], least: NDArray[np.float64], largest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far the farther end of each interval is, infinite where it has no end."""
    with np.errstate(invalid="ignore"):
        farther: NDArray[np.float64] = np.maximum(largest - values, values - least)
    return np.nan_to_num(farther, nan=np.inf, posinf=np.inf)


def rotation_bound(codes: NDArray[np.uint8]) -> float:
    """Return the largest angle in radians between a rotation and the bytes that it was rounded to.

    Notes
    -----
    Rounding moves each of four components by at most half a step, one step in all, and clamping 128 to 127 adds at most
    a tenth across the ray (see `codecs.quaternion_u8.MAX_ANGLE`); a rotation turns by twice the angle of its quaternion.
    """
    lengths = np.linalg.norm(codes.astype(np.float64) - 128, axis=1)
    return float(2 * np.arcsin(min(1.0, 1.1 / max(float(lengths.min(initial=127.0)), 1.1))))


def scale_reach(
    log_scales: NDArray[np.float32], codebook: NDArray[np.float32], *, is_first: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest logarithm that each scale may be decoded as, (N, 3) each, axes as in the source.

    Notes
    -----
    Entries are chosen by `scale_coordinates` y = log(s + a m), m the largest scale. With every coordinate within d of the
    source's, m lies within a factor e^d, and a scale between e^(y-d) - a m e^d and e^(y+d) - a m e^-d: nothing bounds its
    logarithm from below once the first of these is not positive. Axes are named by the first frame: there they fall where
    those of the codebook do, and are the source's else. Later frames may have another order, and labels kept from the
    frame before at a price of at most the mean squared error, so that d is the largest over all six orders.
    """
    from gsplat_tools.codecs.palette import nearest_labels
    from gsplat_tools.formats.sog4d.codebooks import THIN, scale_coordinates

    with np.errstate(divide="ignore"):
        entries = scale_coordinates(np.log(codebook))
    points = scale_coordinates(log_scales)
    if not is_first:
        candidates = [points[:, order] for order in permutations(range(3))]
    elif (np.diff(codebook, axis=1) <= 0).all():
        candidates = [-np.sort(-points, axis=1)]
    else:
        candidates = [points]
    squares = np.max([nearest_labels(np.ascontiguousarray(rows), entries)[1] for rows in candidates], axis=0).astype(np.float64)
    kept = 0.0 if is_first else squares.mean()
    reach = np.sqrt(squares + kept)[:, None] + 1e-6
    scales = np.exp(log_scales.astype(np.float64))
    added = THIN * scales.max(axis=1, keepdims=True)
    upper = (scales + added) * np.exp(reach) - added * np.exp(-reach)
    lower = (scales + added) * np.exp(-reach) - added * np.exp(reach)
    with np.errstate(divide="ignore"):
        return np.log(np.maximum(lower, 0.0)) - _LOG_SLACK, np.log(upper) + _LOG_SLACK
