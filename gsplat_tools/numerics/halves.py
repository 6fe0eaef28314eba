"""What half-precision covariances do to thin splats: the share of those whose minor axis vanishes."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsplat_tools.attributes.covariance import covariance_triangles, to_matrices
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.visionary_buffers import half_covariance_losses, half_error
from gsplat_tools.numerics.conditions import Condition
from gsplat_tools.numerics.measuring import Row

FORMAT = "visionary-f16"
ATTRIBUTE = "vanished minor axes (share)"

_LARGEST_LOG_SCALE = 40.0
"""Covariances of larger scales overflow float32, whatever becomes of halves."""


def vanishing_row(point: Condition) -> Row:
    """Return the row of one point of a sweep."""
    return half_row(point.cloud, point.sweep, point.label, point.x)


def half_row(cloud: GaussianCloud, sweep: str, label: str, x: float | None = None) -> Row:
    """Return the share of splats whose smallest eigenvalue is gone once the covariance is stored in halves.

    Notes
    -----
    Bound: the share of splats whose smallest eigenvalue is at most the Frobenius norm of the rounding errors (Weyl's
    inequality: no eigenvalue moves further than the norm of what is added).
    """
    sizes = cloud.log_scales.max(axis=1, initial=-np.inf)
    cloud = cloud.take(np.isfinite(cloud.log_scales).all(axis=1) & (sizes < _LARGEST_LOG_SCALE))
    facts: dict[str, Any] = {
        "format": FORMAT,
        "attribute": ATTRIBUTE,
        "condition": f"{sweep} {label}".strip(),
        "sweep": sweep,
        "x": x,
    }
    if len(cloud) == 0:
        return Row(**facts, note="no splats to judge")
    covariances = covariance_triangles(cloud.quats, cloud.log_scales, dtype=np.float64)
    losses = half_covariance_losses(covariances)
    moved = np.linalg.norm(to_matrices(half_error(covariances)), axis=(1, 2))
    least = np.exp(2 * cloud.log_scales.astype(np.float64).min(axis=1))
    bound = float(np.count_nonzero(least <= moved)) / len(cloud)
    share = losses.vanished / len(cloud)
    return Row(
        **facts,
        bound=bound,
        measured_max=share,
        measured_rms=share,
        within=share <= bound,
        tightness=share / bound if bound else None,
        note=f"{losses.halved} of {len(cloud)} minor axes off by a factor of two or gone, {losses.overflowed} overflowed",
    )
