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
    logs = log_weights(cloud)
    return weights_of(logs, top_weight(logs))


def log_weights(cloud: GaussianCloud) -> NDArray[np.float64]:
    """Return the logarithm of opacity times area of every splat, (N,); what is not finite is -inf."""
    logs = np.sort(cloud.log_scales, axis=1)[:, 1:].astype(np.float64)
    with np.errstate(over="ignore"):
        log_opacities = -np.log1p(np.exp(-cloud.opacity_logits.astype(np.float64)))
    weights: NDArray[np.float64] = np.nan_to_num(logs.sum(axis=1) + log_opacities, nan=-np.inf, posinf=np.inf)
    return weights


def top_weight(logs: NDArray[np.float64]) -> float:
    """Return the `log_weights` of a whole scene above which all count alike; the order of the splats does not matter."""
    top = np.quantile(logs, 0.999, method="lower") if np.isfinite(logs).any() else 0.0
    if not np.isfinite(top):
        top = logs[np.isfinite(logs)].max(initial=0.0)
    return float(top)


def weights_of(logs: NDArray[np.float64], top: float) -> NDArray[np.float32]:
    """Return the weights of some splats from their `log_weights` and the `top_weight` of the whole scene."""
    weights: NDArray[np.float32] = np.exp(np.clip(logs - top, -np.log(WEIGHT_RANGE), 0.0)).astype(np.float32)
    return weights
