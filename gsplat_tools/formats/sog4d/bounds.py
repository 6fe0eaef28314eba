"""Largest errors that a written bundle allows, from its own ranges and codebooks."""

from __future__ import annotations

from itertools import permutations
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.sog4d.bundle import Bundle
from gsplat_tools.formats.sog4d.meta import frame_path
from gsplat_tools.formats.sog4d.piece import Piece
from gsplat_tools.formats.sog4d.textures import indices_of, pixels_of
from gsplat_tools.ops.visibility import MAX_TURN, MOST, allowed_error

_ROUNDING = 2.0**-22
"""Relative slack for float32 results: two units in the last place."""

_ARCSINE = float(np.arcsin(MAX_TURN) / MAX_TURN) * (1 + 1e-6)

_LABEL_SLACK = 1e-5

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
        codebook · scales: distance to the nearest entry of theirs, or what a label kept from the frame before allows,
        infinite for an axis that is too thin to show · covariances: what these scales and the rounding of the rotation's
        bytes allow. shN is measured only.

    Raises
    ------
    FormatError
        The bundle cannot be read.
    """
    return bounds_in(Bundle(stream), source, frame)


def bounds_in(bundle: Bundle | Piece, source: GaussianCloud, frame: int) -> Bounds:
    """Return the largest errors of one frame of an opened bundle; see `bounds`."""
    from gsplat_tools.codecs.scalar_codebook import nearest_entry

    meta = bundle.meta
    low, high = meta.range_min[frame].astype(np.float64), meta.range_max[frame].astype(np.float64)
    means = (high - low) / 65535 / 2 + np.maximum(np.abs(low), np.abs(high)) * _ROUNDING
    entries = meta.sh0_codebook[nearest_entry(source.sh0, meta.sh0_codebook)]
    sh0 = np.abs(entries - source.sh0.astype(np.float64)) + np.abs(source.sh0) * _ROUNDING + np.float32(1e-30)
    opacities: Any = 0.5 / 255
    codes = pixels_of(bundle.image(frame_path(meta.rotation_path, frame), frame), len(source))
    indices = indices_of(bundle.image(frame_path(meta.scale_indices_path, frame), frame), len(source))
    axes = source_axes(source.quats, codes)
    turned = extra = None
    if meta.tolerance is not None:
        costs = meta.tolerance.costs(source, source.log_scales)
        shift = np.minimum(allowed_error(costs.position)[:, None], high - low)
        means = np.maximum(means, shift + np.maximum(np.abs(low), np.abs(high)) * _ROUNDING)
        opacities = np.maximum(opacities, allowed_error(costs.opacity))
        sh0 = np.maximum(sh0, allowed_error(costs.color)[:, None] * (1 + _ROUNDING))
        extra = MOST / costs.scale * (1 + _LABEL_SLACK)  # labels are chosen in float32
        turned = turned_share(source.log_scales, costs.rotation)
    least, largest = scale_reach(source.log_scales, meta.scale_codebook, indices, axes, is_first=frame == 0, extra=extra)
    logs = source.log_scales.astype(np.float64)
    covariances = covariance_bound_of_ranges(logs, least, largest, rotation_bound(codes)) + _ROUNDING
    if turned is not None:  # a rotation was rounded, or moved as far as shows no more than it may
        covariances = np.maximum(covariances, covariance_bound_of_ranges(logs, least, largest, 0.0) + turned + _ROUNDING)
    return {
        "means": np.broadcast_to(means, source.means.shape),
        "opacities": np.broadcast_to(opacities + _ROUNDING, len(source)),
        "sh0": sh0,
        # Sorted values lie between the sorted ends of their intervals.
        "scales": _distance(np.sort(logs, axis=1), np.sort(least, axis=1), np.sort(largest, axis=1)),
        "covariances": covariances,
    }


def turned_share(log_scales: NDArray[np.float32], costs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much of its norm a covariance may change by a turn that costs no more than `MOST`, (N,).

    Notes
    -----
    Turning L by the angle vector t moves it by at most sqrt(2 sum_k (l_i - l_j)^2 t_k^2), i and j the axes other than k: its
    derivative along the turn keeps that norm. Encoders hold sum_k cost_k (2 u_k)^2 below `MOST`, u the vector part of the
    turn's quaternion; t is longer than 2 u by the arcsine, at most 1.021 times up to `MAX_TURN`.
    """
    logs = log_scales.astype(np.float64)
    longest = logs.max(axis=1, keepdims=True)
    squares = np.exp(2 * (logs - np.where(np.isfinite(longest), longest, 0.0)))
    norms = np.linalg.norm(squares, axis=1)
    pairs = np.stack([squares[:, 1] - squares[:, 2], squares[:, 0] - squares[:, 2], squares[:, 0] - squares[:, 1]], axis=1)
    share: NDArray[np.float64] = np.sqrt(2 * MOST * (np.square(pairs) / costs).max(axis=1)) * _ARCSINE
    return share / np.where(norms > 0, norms, 1.0)


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


def source_axes(quats: NDArray[np.float32], codes: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return which axis of the source each stored axis is, (N, 3), from the rotations of both.

    Encoders relabel the axes of a splat, which turns its rotation by 90 degrees about some of them; rounding turns it by a
    few degrees at most, so that the largest entry of each column tells.
    """
    from gsplat_tools.attributes.quaternions import to_matrix
    from gsplat_tools.codecs import quaternion_u8

    stored = to_matrix(quaternion_u8.decode(codes).astype(np.float64))
    between: NDArray[np.float64] = to_matrix(quats.astype(np.float64)).transpose(0, 2, 1) @ stored
    return np.asarray(np.argmax(np.abs(between), axis=1), np.intp)


def scale_reach(
    log_scales: NDArray[np.float32],
    codebook: NDArray[np.float32],
    indices: NDArray[np.integer[Any]],
    axes: NDArray[np.intp],
    *,
    is_first: bool,
    extra: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest logarithm that each scale may be decoded as, (N, 3) each, axes as in the source.

    Notes
    -----
    The entry is the one nearest in `scale_coordinates`, y = max(log(s + a m), floor) with m the largest scale; it is known
    from the codebook. Later frames may keep the label of the frame before, at a price of at most the mean squared error:
    such an entry lies within d of the source in every coordinate, so that m lies within a factor e^d, and a scale between
    e^(y-d) - a m e^d and e^(y+d) - a m e^-d. Nothing bounds its logarithm from below once the first of these is not
    positive, or the coordinate is at the floor, where all thinner scales are the same. `extra`, (N,), is the squared
    distance that a visual tolerance allows beyond the nearest entry.
    """
    from gsplat_tools.codecs.palette import nearest_labels
    from gsplat_tools.formats.sog4d.codebooks import MIN_LOG, THIN, points_of, scale_coordinates

    with np.errstate(divide="ignore"):
        logs_of_entries = np.log(codebook.astype(np.float64))
    entries = points_of(codebook)
    points = scale_coordinates(np.take_along_axis(log_scales, axes, axis=1))
    nearest, squares = nearest_labels(points, entries)
    least = largest = logs_of_entries[nearest]
    is_kept = np.zeros(len(points), np.bool_) if is_first and extra is None else nearest != indices
    if is_kept.any():
        prices = np.square(points.astype(np.float64) - entries[indices]).sum(axis=1) - squares
        allowed = 0.0 if is_first else max(0.0, min(float(prices[is_kept].max()), _price_of_keeping(log_scales, entries)))
        prices_allowed = np.full(len(points), allowed) if extra is None else np.maximum(allowed, extra)
        reach = np.sqrt(squares.astype(np.float64) + prices_allowed)[:, None] + 1e-6
        low, high = points - reach, points + reach
        longest = points.max(axis=1, keepdims=True) - np.log1p(THIN)
        # A longest axis at the floor may be stored as any thinner one.
        shortest = np.where(longest - reach > MIN_LOG, np.exp(longest - reach), 0.0)
        with np.errstate(divide="ignore"):
            lower = np.log(np.maximum(np.exp(low) - THIN * np.exp(longest + reach), 0.0))
            upper = np.log(np.exp(high) - THIN * shortest)
        lower[low <= MIN_LOG] = -np.inf
        least = np.where(is_kept[:, None], lower, least)
        largest = np.where(is_kept[:, None], upper, largest)
    # From the axes of the file to those of the source.
    back = np.argsort(axes, axis=1)
    return np.take_along_axis(least, back, axis=1) - _LOG_SLACK, np.take_along_axis(largest, back, axis=1) + _LOG_SLACK


def _price_of_keeping(log_scales: NDArray[np.float32], entries: NDArray[np.float32]) -> float:
    """Return a squared distance that no kept label may add: the mean over the splats, axes in their worst order."""
    from gsplat_tools.codecs.palette import nearest_labels
    from gsplat_tools.formats.sog4d.codebooks import scale_coordinates

    points = scale_coordinates(log_scales)
    candidates = (np.ascontiguousarray(points[:, order]) for order in permutations(range(3)))
    return float(np.max([nearest_labels(rows, entries)[1] for rows in candidates], axis=0).mean(dtype=np.float64))
