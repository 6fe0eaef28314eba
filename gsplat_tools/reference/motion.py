"""Motion and visibility at a time: the one evaluation that sorting, rendering and bounds share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gsplat_tools.attributes.motion import positions_at, weights_at
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.ops.motion import motion_bounds
from gsplat_tools.sequence import GaussianSequence

__all__ = ["Scene", "SceneState", "evaluate_scene", "motion_bounds"]

Scene = GaussianCloud | GaussianSequence


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
    temporal_cutoff: float | None = None,
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
        Weight below which a splat of the gaussian time model is hidden; by default the cloud's own.

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
    arrays = (scene.means, scene.velocities, scene.times, scene.durations)
    means, velocities, times, durations = (values.astype(dtype, copy=False) for values in arrays)
    cutoff = scene.temporal_cutoff if temporal_cutoff is None else temporal_cutoff
    weights = weights_at(times, durations, t, scene.time_model, cutoff)
    return SceneState(scene, positions_at(means, velocities, times, t), weights > 0, weights)
