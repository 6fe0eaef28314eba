"""Motion of 4D splats: position, window gate and temporal weight at a time, and how far motion carries a splat.

Sorting, rendering, baking and bounds all call these functions, so that they cannot disagree.

Source: motion model of raiscui/gsplat-unity (docs/formats/splat4d.md).
"""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.constants import TEMPORAL_CUTOFF

Floating = TypeVar("Floating", np.float32, np.float64)

MIN_SIGMA = 1e-6
"""Smallest duration (standard deviation) of the gaussian model."""

Box = tuple[list[float], list[float]]


def positions_at(
    means: NDArray[Floating], velocities: NDArray[Floating], times: NDArray[Floating], t: float
) -> NDArray[Floating]:
    """Return mean + velocity (t - time) of every splat.

    Parameters
    ----------
    means, velocities
        (N, 3), of one dtype.
    times
        (N,).
    t
        Normalized time.

    Returns
    -------
    NDArray
        (N, 3) of that dtype, computed in float64 and rounded once: where splats are fast, the rounding of t alone would move
        them visibly in float32. Where velocity or time is not finite, neither is the result.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        age = t - times.astype(np.float64)
        return (means + velocities * age[:, None]).astype(means.dtype)


def weights_at(
    times: NDArray[Floating],
    durations: NDArray[Floating],
    t: float,
    time_model: Literal["window", "gaussian"],
    cutoff: float = TEMPORAL_CUTOFF,
) -> NDArray[Floating]:
    """Return the factor of each splat's opacity at a time; 0 exactly where it is hidden.

    Parameters
    ----------
    times, durations
        (N,) window start and length, or center and standard deviation.
    t
        Normalized time.
    time_model
        "window": 1 where time <= t <= time + duration. "gaussian": exp(-((t - time) / duration)^2 / 2).
    cutoff
        Weight below which a splat of the gaussian model is hidden, above 0.

    Returns
    -------
    NDArray
        (N,) in [0, 1], of the dtype of `times`; 0 where a value is NaN.
    """
    moment = times.dtype.type(t)
    weights: NDArray[Floating]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
        if time_model == "window":
            # Not age <= duration: the shaders compare t with the end of the window.
            weights = ((times <= moment) & (moment <= times + durations)).astype(times.dtype)
            return weights
        # In float64: against a short duration the rounding of t is not small.
        weights = np.exp(-0.5 * np.square((t - times.astype(np.float64)) / durations)).astype(times.dtype)
        weights[~(weights >= cutoff)] = 0
        return weights


def half_width(time_model: Literal["window", "gaussian"], cutoff: float = TEMPORAL_CUTOFF) -> float:
    """Return how many durations away from its time a splat can be seen: 1, or sqrt(-2 ln cutoff)."""
    return 1.0 if time_model == "window" else float(np.sqrt(-2.0 * np.log(cutoff)))


def reach(
    max_speed: float, max_duration: float, time_model: Literal["window", "gaussian"], cutoff: float = TEMPORAL_CUTOFF
) -> float:
    """Return how far any splat can leave the box of the stored means while it is visible.

    Parameters
    ----------
    max_speed
        Largest length of a velocity, world units per 1.0 of normalized time.
    max_duration
        Largest duration, or standard deviation, normalized time.
    time_model, cutoff
        As in `weights_at`.

    Returns
    -------
    float
        World units: max_speed * max_duration, times `half_width` for the gaussian model.
    """
    return max_speed * max(max_duration, 0.0) * half_width(time_model, cutoff)


class MotionBox:
    """The box of stored means, and the same grown by what motion adds, gathered over chunks.

    Splats with values that are not finite are left out: they are dropped when a scene is read.

    Parameters
    ----------
    time_model, cutoff
        As in `weights_at`.
    """

    def __init__(self, time_model: Literal["window", "gaussian"], cutoff: float = TEMPORAL_CUTOFF) -> None:
        self._time_model: Literal["window", "gaussian"] = time_model
        self._cutoff = cutoff
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)
        self._speed = 0.0
        self._duration = 0.0

    def add(self, means: NDArray[Any], velocities: NDArray[Any] | None = None, durations: NDArray[Any] | None = None) -> None:
        """Take (N, 3) means, and velocities (N, 3) with durations (N,) where there is motion, into account."""
        is_finite = np.isfinite(means).all(axis=1)
        if velocities is not None and durations is not None:
            is_finite &= np.isfinite(velocities).all(axis=1) & np.isfinite(durations)
        if not is_finite.any():
            return
        kept = means[is_finite].astype(np.float64)
        self._low = np.minimum(self._low, kept.min(axis=0))
        self._high = np.maximum(self._high, kept.max(axis=0))
        if velocities is not None and durations is not None:
            speeds = np.linalg.norm(velocities[is_finite].astype(np.float64), axis=1)
            self._speed = max(self._speed, float(speeds.max()))
            self._duration = max(self._duration, float(durations[is_finite].max()))

    def box(self, origin: NDArray[np.float64] | None = None) -> Box | None:
        """Return (min, max) of the means, moved by an origin; None without splats."""
        return self._grown(0.0, origin)

    def motion_box(self, origin: NDArray[np.float64] | None = None) -> Box | None:
        """Return the box grown on every side by `reach`, moved by an origin; None without splats."""
        return self._grown(reach(self._speed, self._duration, self._time_model, self._cutoff), origin)

    def _grown(self, margin: float, origin: NDArray[np.float64] | None) -> Box | None:
        if not np.isfinite(self._low).all():
            return None
        shift = np.zeros(3) if origin is None else origin
        return (self._low + shift - margin).tolist(), (self._high + shift + margin).tolist()
