"""Parts of a scene that stand for the whole: a piece of it, or short runs from everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.ops.ordering import morton_order

RUN = 64
"""Splats of a run: long enough that neighbours predict each other as in the whole scene."""


def crop(cloud: GaussianCloud, count: int, *, keeps_box: bool = False) -> GaussianCloud:
    """Return the splats nearest to the middle of the scene, in their order.

    Parameters
    ----------
    cloud
        Valid splats.
    count
        Splats to keep; all where there are no more.
    keeps_box
        Keep the outermost splats too, up to six, so that positions have the range of the whole.

    Returns
    -------
    GaussianCloud
        A ball around the median position.
    """
    if count >= len(cloud):
        return cloud
    distances = np.square(cloud.means - np.median(cloud.means, axis=0)).sum(axis=1)
    chosen = np.argpartition(distances, count - 1)[:count]
    if keeps_box:
        chosen = np.concatenate([chosen, cloud.means.argmin(axis=0), cloud.means.argmax(axis=0)])
    return cloud.take(np.unique(chosen))


def spread_runs(cloud: GaussianCloud, count: int) -> NDArray[np.intp]:
    """Return indices of about `count` splats: evenly spaced runs along a Morton curve, and the ends of every range.

    Parameters
    ----------
    cloud
        Valid splats.
    count
        Splats to choose; all where there are no more.

    Returns
    -------
    ndarray
        Ascending indices. With the smallest and the largest value of every position and scale axis among them, ranges
        and steps are those of the whole; within a run, neighbours are those of the whole.
    """
    if count >= len(cloud):
        return np.arange(len(cloud))
    order = morton_order(cloud.means)
    runs = max(1, count // RUN)
    starts = np.linspace(0, len(cloud) - min(RUN, len(cloud)), runs).astype(np.intp)
    chosen = order[(starts[:, None] + np.arange(min(RUN, len(cloud)))).ravel()]
    ends = [index for values in (cloud.means, cloud.log_scales) for index in (*values.argmin(axis=0), *values.argmax(axis=0))]
    return np.unique(np.concatenate([chosen.astype(np.intp), np.array(ends, np.intp)]))
