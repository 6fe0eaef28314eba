"""A picture of how far a fitted 4D asset is from its keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.ops.motion_fitting import MotionResiduals

_LOW = np.array([0.15, 0.25, 0.55])
_MIDDLE = np.array([0.95, 0.85, 0.3])
_HIGH = np.array([0.85, 0.1, 0.1])


def residual_picture(
    cloud: GaussianCloud, residuals: MotionResiduals, *, views: int = 3, size: tuple[int, int] = (480, 270)
) -> NDArray[np.uint8]:
    """Draw a fitted asset in the colors of its residuals.

    Parameters
    ----------
    cloud, residuals
        What `fit_motion` returned, at least one splat.
    views, size
        Automatic views and their size, px.

    Returns
    -------
    NDArray[np.uint8]
        A contact sheet of two rows: the residual of positions relative to each splat's own size, and that of opacity. Blue
        is none; yellow half and red all of the splat's largest scale, or of full opacity.
    """
    from gsplat_tools.reference.auto_cameras import auto_cameras
    from gsplat_tools.reference.pictures import contact_sheet
    from gsplat_tools.reference.rasterizer import render

    sizes = np.exp(np.clip(cloud.log_scales.max(axis=1).astype(np.float64), -80, 80))
    still = cloud.replace(shN=cloud.shN[:, :0], velocities=None, times=None, durations=None, time_model="window")
    cameras = auto_cameras(still, views=views, size=size)
    pictures = []
    for shares in (residuals.position_rms / sizes, residuals.opacity_rms):
        colored = still.replace(sh0=(_colors(shares) - 0.5) / SH_C0)
        pictures += [render(colored, camera).image for camera in cameras]
    return contact_sheet(pictures, columns=len(cameras))


def _colors(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return RGB (N, 3) of shares from 0 (blue) over 0.5 (yellow) to 1 (red)."""
    x = np.clip(np.nan_to_num(shares, nan=1.0), 0, 1)[:, None]
    rising = _LOW + (_MIDDLE - _LOW) * np.minimum(2 * x, 1)
    return np.asarray(rising + (_HIGH - _MIDDLE) * np.maximum(2 * x - 1, 0))
