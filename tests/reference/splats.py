"""Scenes of one or a few splats whose pictures can be worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.reference.camera import Camera

FOCAL = 100.0


def camera(width: int = 64, height: int = 48, **planes: Any) -> Camera:
    """Camera at the origin that looks along +z, focal length 100 px."""
    K = np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]])
    return Camera(np.eye(4), K, width, height, **planes)


def logit(opacity: float) -> float:
    """Logit whose sigmoid is the opacity."""
    with np.errstate(divide="ignore"):
        return float(np.log(opacity) - np.log1p(-opacity))


def splats(
    means: Any,
    *,
    scales: Any = 0.05,
    opacities: Any = 0.5,
    colors: Any = (0.8, 0.4, 0.2),
    quats: Any = (1, 0, 0, 0),
    **extra: Any,
) -> GaussianCloud:
    """Splats with linear scales, opacities and colors; one value serves all."""
    means = np.atleast_2d(np.asarray(means, np.float32))
    count = len(means)
    scales = np.broadcast_to(np.asarray(scales, np.float64).reshape(-1, 1) if np.ndim(scales) == 1 else scales, (count, 3))
    with np.errstate(divide="ignore"):
        return GaussianCloud(
            means=means,
            log_scales=np.log(scales).astype(np.float32),
            quats=np.broadcast_to(np.asarray(quats, np.float32), (count, 4)),
            opacity_logits=np.array([logit(o) for o in np.broadcast_to(opacities, count)], np.float32),
            sh0=((np.broadcast_to(colors, (count, 3)) - 0.5) / SH_C0).astype(np.float32),
            shN=extra.pop("shN", np.zeros((count, 0, 3), np.float32)),
            **extra,
        )


def pixel_offsets(view: Camera, x: float, y: float) -> tuple[Any, Any]:
    """Offsets (H, W) of the pixel centers from a point, px."""
    j, i = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    return j - x, i - y
