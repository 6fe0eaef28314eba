"""Far splats that hardly show: a few of them stretch the box in whose steps all positions are stored."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.ops.visibility import lit_pixels, viewpoint

FAR = 1.5
"""Distance from which a splat counts as far, in radii of the bulk of the scene."""

MOST_SHOWN = 3.0
"""Energy that a splat may show to be left out, px^2 over three channels: a pixel turned from black to white."""

WORTHWHILE_BITS = 1.0
"""What the box must shrink by, bits of position a splat over the three axes."""


def find_outliers(cloud: GaussianCloud) -> NDArray[np.bool_]:
    """Find far splats that hardly show and without which the box of the scene is worth much less.

    Parameters
    ----------
    cloud
        N valid splats.

    Returns
    -------
    ndarray
        (N,) bool; all false where leaving out such splats saves less than `WORTHWHILE_BITS`. Splats inside the box of
        those that stay are never among them.

    Notes
    -----
    Seen from as far away as makes the bulk of the scene span 1,000 px (`ops.visibility`), and a splat beyond it from as
    much farther, a splat of opacity o whose trace has the half axes a and b draws o exp(-r^2 / 2). Leaving it out changes
    each channel by at most that: by pi a b o^2 in energy, three times for three channels. No picture is drawn.
    """
    none = np.zeros(len(cloud), np.bool_)
    if len(cloud) < 2:
        return none
    view = viewpoint(cloud)
    means = cloud.means.astype(np.float64)
    far = np.linalg.norm(means - np.asarray(view.center), axis=1) > FAR * view.radius
    if not far.any():
        return none
    candidates = far & (3 * lit_pixels(cloud, view) <= MOST_SHOWN)
    if not candidates.any() or candidates.all():
        return none
    low, high = means[~candidates].min(axis=0), means[~candidates].max(axis=0)
    outliers: NDArray[np.bool_] = candidates & ((means < low) | (means > high)).any(axis=1)
    before, after = np.ptp(means, axis=0), high - low
    measurable = (after > 0) & (before > 0)
    saved = float(np.log2(before[measurable] / after[measurable]).sum())
    return outliers if saved >= WORTHWHILE_BITS else none
