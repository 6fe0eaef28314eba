"""Motion and visibility at a time: the one evaluation that sorting, rendering and bounds share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.sequence import GaussianSequence

Scene = GaussianCloud | GaussianSequence

TEMPORAL_GAUSSIAN_CUTOFF = 0.01
"""Weight below which a splat of the gaussian time model is invisible (default of the .splat4d version 2 META section)."""


@dataclass(frozen=True, slots=True)
class SceneState:
    """A scene at one time.

    Parameters
    ----------
    cloud
        The splats; their means and opacities are those that are stored.
    means
        (N, 3) centers at the time, relative to the origin of the cloud.
    is_visible
        (N,) whether each splat shows at the time; None: all do.
    weights
        (N,) factor of the opacity at the time, 0 where hidden; None: 1 for all.
    """

    cloud: GaussianCloud
    means: NDArray[Any]
    is_visible: NDArray[np.bool_] | None
    weights: NDArray[Any] | None


def evaluate_scene(
    scene: Scene,
    t: float | None,
    *,
    dtype: DTypeLike = np.float32,
    temporal_cutoff: float = TEMPORAL_GAUSSIAN_CUTOFF,
) -> SceneState:
    """Return a scene at a time.

    Parameters
    ----------
    scene
        A cloud, or a sequence, which is interpolated at `t` (at 0 where `t` is None).
    t
        Normalized time; None takes a cloud as it is stored, with every splat visible.
    dtype
        Type that means and weights are computed in.
    temporal_cutoff
        Weight below which a splat of the gaussian time model is hidden.

    Returns
    -------
    SceneState
        position(t) = mean + velocity (t - time). Window model: visible where time <= t <= time + duration. Gaussian
        model: weight exp(-((t - time) / duration)^2 / 2).

    Raises
    ------
    ValueError
        The time is not finite.

    Source
    ------
    Motion model of raiscui/gsplat-unity (docs/formats/splat4d.md).
    """
    if t is not None and not np.isfinite(t):
        raise ValueError(f"time must be finite, got {t}")
    if isinstance(scene, GaussianSequence):
        return SceneState(cloud := scene.at(0.0 if t is None else t), cloud.means.astype(dtype, copy=False), None, None)
    if t is None or scene.velocities is None or scene.times is None or scene.durations is None:
        return SceneState(scene, scene.means.astype(dtype, copy=False), None, None)
    times, durations = scene.times.astype(dtype, copy=False), scene.durations.astype(dtype, copy=False)
    age = np.asarray(t, dtype) - times
    means = scene.means.astype(dtype, copy=False) + scene.velocities.astype(dtype, copy=False) * age[:, None]
    if scene.time_model == "window":
        # Not age <= duration: the shaders compare t with the end of the window.
        is_visible = (times <= np.asarray(t, dtype)) & (np.asarray(t, dtype) <= times + durations)
        return SceneState(scene, means, is_visible, is_visible.astype(dtype))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        weights = np.exp(-0.5 * np.square(age / durations)).astype(dtype)
    is_visible = weights >= temporal_cutoff
    return SceneState(scene, means, is_visible, np.where(is_visible, weights, np.asarray(0, dtype)))


def motion_bounds(
    cloud: GaussianCloud, *, temporal_cutoff: float = TEMPORAL_GAUSSIAN_CUTOFF
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return (min, max) in world units, (3,) float64, that no splat leaves while it is visible.

    Parameters
    ----------
    cloud
        A cloud, with or without motion.
    temporal_cutoff
        As in `evaluate_scene`.

    Returns
    -------
    tuple or None
        The static box, grown on every side by the largest speed times the longest duration; None for an empty cloud.

    Source
    ------
    4DGS bounds expansion of raiscui/gsplat-unity; for the gaussian model the duration is sqrt(-2 ln cutoff) sigma.
    """
    box = cloud.bounds()
    if box is None or cloud.velocities is None or cloud.durations is None:
        return box
    speed = float(np.linalg.norm(cloud.velocities.astype(np.float64), axis=1).max())
    duration = float(cloud.durations.max())
    if cloud.time_model == "gaussian":
        duration *= float(np.sqrt(-2 * np.log(temporal_cutoff)))
    padding = speed * max(duration, 0.0)
    return box[0] - padding, box[1] + padding
