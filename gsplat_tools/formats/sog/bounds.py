"""Largest errors that a written bundle allows, from its own ranges, codebooks and rotations."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.sog.bundle import open_bundle
from gsplat_tools.ops.visibility import allowed_error

_HALF_STEP, _SMALLEST = 2.0**-24 * (1 + 1e-6), 2.0**-150
"""Rounding to float32: relative, with what float64 arithmetic adds, and half of the smallest subnormal."""


def bounds(source: GaussianCloud, stream: BinaryIO) -> Bounds:
    """Return the largest errors of a bundle.

    Parameters
    ----------
    source
        The cloud as it was given to `write`.
    stream
        The bundle.

    Returns
    -------
    Bounds
        means: half a step d of n = sign(x) ln(1 + |x|) is (1 + |x|) (exp(d / 2) - 1), because |n| may grow by d / 2 and no
        other change of n moves x further, and the rounding of the result to float32 · opacities: half of 1 / 255 · sh0 and
        scales: distance to the nearest entry of the codebook, infinite for flat axes · covariances: those distances and the
        turn that the rotation codes allow.
        shN is measured only: it depends on the palette.

    Raises
    ------
    FormatError
        The bundle cannot be read.
    """
    from gsplat_tools.codecs import quaternion_sog
    from gsplat_tools.codecs.rotation_bounds import relative_covariance_bound

    bundle, _ = open_bundle(stream)
    assert bundle is not None
    meta = bundle.meta
    sizes = np.abs(source.means.astype(np.float64))
    moved = (1 + sizes) * np.expm1((meta.means_high - meta.means_low) / 65535 / 2)
    angle = quaternion_sog.max_angle(bundle.codes("quats"))
    covariances = relative_covariance_bound(source.log_scales, _distances(source.log_scales, meta.scales[0]), angle)
    # A splat without any extent gets one, so that no relative error is left.
    has_extent = np.isfinite(source.log_scales).any(axis=1)
    opacities = np.full(len(source), 0.5 / 255)
    colors, scales = _distances(source.sh0, meta.sh0[0]), _distances(np.sort(source.log_scales, axis=1), meta.scales[0])
    if meta.tolerance is not None:
        costs = meta.tolerance.costs(source, source.log_scales)
        # d of n moves x by at most (1 + |x|) (exp(d) - 1), and costs are of (1 + |x|) d.
        logs = np.minimum(allowed_error(costs.position)[:, None] / (1 + sizes), meta.means_high - meta.means_low)
        moved = np.maximum(moved, (1 + sizes) * np.expm1(logs))
        opacities = np.maximum(opacities, allowed_error(costs.opacity))
        colors = np.maximum(colors, allowed_error(costs.color)[:, None])
        # Sorted values move by no more than the values.
        stretched = np.maximum(_distances(source.log_scales, meta.scales[0]), allowed_error(costs.scale)[:, None])
        scales = np.maximum(scales, np.max(stretched, axis=1, keepdims=True))
        covariances = np.maximum(covariances, relative_covariance_bound(source.log_scales, stretched, angle))
    return {
        "means": moved + (sizes + moved) * _HALF_STEP + _SMALLEST,
        "opacities": opacities + 1e-6,  # the ends are read as 1e-6 and 1 - 1e-6
        "sh0": colors,
        "scales": scales,
        "covariances": np.where(has_extent, covariances, np.inf),
    }


def _distances(values: NDArray[np.float32], codebook: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far each value lies from the nearest entry of an ascending codebook."""
    from gsplat_tools.codecs.scalar_codebook import nearest_entry

    ascending = np.sort(codebook)
    return np.abs(ascending[nearest_entry(values, ascending)].astype(np.float64) - values)
