"""How much of the picture a splat makes up, as a weight for clustering."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud

WEIGHT_RANGE = 1e4
"""Weights below the largest by more than this factor are raised: no splat is worth nothing."""


def importance(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return opacity times projected area of every splat, relative to the largest.

    Parameters
    ----------
    cloud
        N splats.

    Returns
    -------
    NDArray[np.float32]
        (N,) weights in [1 / WEIGHT_RANGE, 1]; the area seen from all sides is taken as the product of the two largest
        scales. The top 0.1 % count alike: a backdrop must not own the palette.

    Source
    ------
    Opacity x area weights in palette clustering: nerfstudio-project/gsplat, pull request 1063.
    """
    if len(cloud) == 0:
        return np.ones(0, np.float32)
    logs = np.sort(cloud.log_scales, axis=1)[:, 1:].astype(np.float64)
    with np.errstate(over="ignore"):
        log_opacities = -np.log1p(np.exp(-cloud.opacity_logits.astype(np.float64)))
    log_weights = np.nan_to_num(logs.sum(axis=1) + log_opacities, nan=-np.inf, posinf=np.inf)
    top = np.quantile(log_weights, 0.999, method="lower") if np.isfinite(log_weights).any() else 0.0
    if not np.isfinite(top):
        top = log_weights[np.isfinite(log_weights)].max(initial=0.0)
    floor = -np.log(WEIGHT_RANGE)
    weights: NDArray[np.float32] = np.exp(np.clip(log_weights - top, floor, 0.0)).astype(np.float32)
    return weights
