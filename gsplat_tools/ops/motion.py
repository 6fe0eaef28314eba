"""4D splats over time: freeze a moment, bake keyframes, bound what moves, change the time model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.activations import sigmoid, weighted_logits
from gsplat_tools.attributes.motion import MIN_SIGMA, MotionBox, positions_at, weights_at
from gsplat_tools.cloud import GaussianCloud, TimeModel
from gsplat_tools.constants import VISIBLE_OPACITY
from gsplat_tools.errors import CloudError, LossyConversionWarning
from gsplat_tools.sequence import GaussianSequence

SHOWN = VISIBLE_OPACITY * (1 - 1e-6)
"""Opacity from which a splat shows: a stored byte of 1 passes, as in the evaluation of sequences."""

HALF_MAXIMUM = math.sqrt(2 * math.log(2))
"""Where a temporal Gaussian falls to half, in sigmas: the window that differs least from it, in the mean square."""

# Gaussians that differ least from a window of length 1 in the mean square, found numerically: of a window that opens and
# closes, sigma and rms 0.356; of one that was open before time began, center and sigma (rms 0.290).
_SIGMA_OF_WINDOW = 0.38838
_CENTER_OF_HALF_WINDOW, _SIGMA_OF_HALF_WINDOW = 0.39833, 0.48148
SIGMA_OF_ALWAYS = 8.0
"""Sigma of a splat that always shows: from the middle of time to its ends it falls by less than half of 1/255."""


def motion_bounds(
    cloud: GaussianCloud, *, temporal_cutoff: float | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return (min, max) in world units, (3,) float64, that no center leaves while its splat is visible.

    Parameters
    ----------
    cloud
        A cloud, with or without motion.
    temporal_cutoff
        Weight below which a splat of the gaussian time model is hidden; by default the cloud's own.

    Returns
    -------
    tuple or None
        The static box, grown on every side by the largest speed times the longest duration; None for an empty cloud.

    Source
    ------
    4DGS bounds expansion of raiscui/gsplat-unity; for the gaussian model the duration is sqrt(-2 ln cutoff) sigma.
    """
    tally = MotionBox(cloud.time_model, cloud.temporal_cutoff if temporal_cutoff is None else temporal_cutoff)
    tally.add(cloud.means, cloud.velocities, cloud.durations)
    box = tally.motion_box(cloud.origin)
    return None if box is None else (np.array(box[0]), np.array(box[1]))


def at_time(cloud: GaussianCloud, t: float) -> GaussianCloud:
    """Return the still cloud that a 4D asset shows at a time, every splat kept.

    Parameters
    ----------
    cloud
        N splats; without motion only the opacity gate is applied.
    t
        Normalized time.

    Returns
    -------
    GaussianCloud
        Means at the time; opacities times the temporal weight, and 0 (logit -inf) below 1/255; no motion.

    Raises
    ------
    ValueError
        The time is not finite.
    """
    if not np.isfinite(t):
        raise ValueError(f"time must be finite, got {t}")
    weights = _weights(cloud, t)
    logits = weighted_logits(cloud.opacity_logits, weights)
    logits[~(sigmoid(cloud.opacity_logits.astype(np.float64)) * weights >= SHOWN)] = -np.inf
    means = cloud.means
    if cloud.velocities is not None and cloud.times is not None:
        means = positions_at(means, cloud.velocities, cloud.times, t)
    return cloud.replace(means=means, opacity_logits=logits, velocities=None, times=None, durations=None, time_model="window")


def visible_splats(cloud: GaussianCloud, frame_times: Sequence[float] | NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (N,) whether each splat shows (opacity times weight at least 1/255) in any of the frames."""
    opacities = sigmoid(cloud.opacity_logits.astype(np.float64))
    shown = np.zeros(len(cloud), np.bool_)
    for t in frame_times:
        shown |= opacities * _weights(cloud, float(t)) >= SHOWN
    return shown


def bake(cloud: GaussianCloud, frame_times: int | Sequence[float] | NDArray[np.float64]) -> GaussianSequence:
    """Turn a 4D asset into keyframes.

    Parameters
    ----------
    cloud
        N splats with motion.
    frame_times
        Number of frames, spaced evenly over [0, 1]; or their times, non-decreasing, in [0, 1].

    Returns
    -------
    GaussianSequence
        Frames of the splats that any frame shows, in the order of the cloud (`visible_splats` tells which); each frame is
        computed when it is asked for. Scale, rotation and SH are those of the cloud.

    Raises
    ------
    CloudError
        The cloud has no motion, there is no frame, or the times are not as a sequence needs them.

    Warns
    -----
    LossyConversionWarning
        Splats that no frame shows were dropped, with their number.

    Source
    ------
    Baking rules of the .sog4d exporter of raiscui/gsplat-unity (docs/motion.md).
    """
    if not cloud.has_motion:
        raise CloudError("the cloud has no motion to bake; use it as it is", field="velocities")
    count, explicit = (frame_times, None) if isinstance(frame_times, int) else (None, frame_times)
    # Built first, because it checks the times.
    planned = GaussianSequence(lambda _: cloud, num_splats=0, sh_degree=0, num_frames=count, frame_times=explicit)
    times = planned.frame_times
    shown = visible_splats(cloud, times)
    hidden = int(np.count_nonzero(~shown))
    if hidden:
        warnings.warn(
            LossyConversionWarning(
                f"dropped {hidden} of {len(cloud)} splats that none of the {len(times)} frames shows", code="never-visible"
            ),
            stacklevel=2,
        )
    kept = cloud.take(shown) if hidden else cloud
    return GaussianSequence(
        lambda frame_id: at_time(kept, times[frame_id]),
        num_splats=len(kept),
        sh_degree=kept.sh_degree,
        num_frames=count,
        frame_times=explicit,
    )


def with_time_model(cloud: GaussianCloud, time_model: TimeModel) -> tuple[GaussianCloud, NDArray[np.float64]]:
    """Convert the time model of a 4D asset; the paths of the splats stay the same lines.

    Parameters
    ----------
    cloud
        N splats with motion.
    time_model
        "window" or "gaussian".

    Returns
    -------
    tuple
        The cloud in that model · errors (N,) float64: root of the mean over [0, 1] of the squared difference of the
        temporal weights, 0 where nothing changed.

    Raises
    ------
    CloudError
        The cloud has no motion.

    Notes
    -----
    Each splat takes the member of the other model that is nearest in the mean square at full weight 1. A Gaussian becomes
    the window in which its weight is at least one half, 2.355 sigma long, cut to [0, 1]; where that is empty the splat's
    opacity becomes 0, because a window always shows something. A window becomes a Gaussian of sigma 0.388 of its length in
    its middle; one that reaches an end of time, where nobody sees it open or close, the better of that and the fit to
    an edge alone; one that is always open becomes a Gaussian so wide that it never falls by half of 1/255. Windows are hard
    and Gaussians are not: a window seen as a whole keeps an error of 0.356 times the root of its length.
    """
    if cloud.velocities is None or cloud.times is None or cloud.durations is None:
        raise CloudError("the cloud has no motion; there is no time model to convert", field="velocities")
    if cloud.time_model == time_model:
        return cloud, np.zeros(len(cloud))
    times, durations = cloud.times.astype(np.float64), cloud.durations.astype(np.float64)
    changes: dict[str, Any] = {"time_model": time_model}
    if time_model == "window":
        sigmas = np.maximum(durations, MIN_SIGMA)
        starts = np.clip(times - HALF_MAXIMUM * sigmas, 0.0, 1.0)
        ends = np.clip(times + HALF_MAXIMUM * sigmas, 0.0, 1.0)
        is_empty = ends <= starts
        new_times, new_durations = starts, ends - starts
        errors = _mean_square(starts, ends, times, sigmas)
        changes["opacity_logits"] = np.where(is_empty, np.float32(-np.inf), cloud.opacity_logits)
    else:
        starts, ends = np.clip(times, 0.0, 1.0), np.clip(times + durations, 0.0, 1.0)
        new_times, new_durations, errors = nearest_gaussians(starts, ends)
    # Rounded first, so that the line goes through the mean at the time that is stored.
    new_times = new_times.astype(np.float32)
    shift = (new_times.astype(np.float64) - times)[:, None] * cloud.velocities
    changes |= {"means": cloud.means + shift, "times": new_times, "durations": new_durations}
    return cloud.replace(**changes), np.sqrt(errors)


def _weights(cloud: GaussianCloud, t: float) -> NDArray[np.float32]:
    """Return the temporal weight of every splat, 1 without motion."""
    if cloud.times is None or cloud.durations is None:
        return np.ones(len(cloud), np.float32)
    return weights_at(cloud.times, cloud.durations, t, cloud.time_model, cloud.temporal_cutoff)


def nearest_gaussians(
    starts: NDArray[np.float64], ends: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return center, sigma and mean squared error of the best of four Gaussians for every window inside [0, 1]."""
    lengths = np.maximum(ends - starts, MIN_SIGMA)
    middle = (starts + ends) / 2
    ahead, behind = np.maximum(ends, MIN_SIGMA), np.maximum(1 - starts, MIN_SIGMA)
    candidates = [
        (middle, _SIGMA_OF_WINDOW * lengths),
        (_CENTER_OF_HALF_WINDOW * ahead, _SIGMA_OF_HALF_WINDOW * ahead),
        (1 - _CENTER_OF_HALF_WINDOW * behind, _SIGMA_OF_HALF_WINDOW * behind),
        (np.full_like(middle, 0.5), np.full_like(middle, SIGMA_OF_ALWAYS)),
    ]
    candidates = [(centers, np.maximum(sigmas, MIN_SIGMA)) for centers, sigmas in candidates]
    errors = np.array([_mean_square(starts, ends, centers, sigmas) for centers, sigmas in candidates])
    best = errors.argmin(axis=0)
    rows = np.arange(len(starts))
    chosen = [np.array([candidate[i] for candidate in candidates])[best, rows] for i in range(2)]
    return chosen[0], chosen[1], errors[best, rows]


def _mean_square(
    starts: NDArray[np.float64], ends: NDArray[np.float64], centers: NDArray[np.float64], sigmas: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the integral over [0, 1] of (window - Gaussian)^2; the cutoff, below which both are 0, is left out."""
    inside = np.maximum(ends - starts, 0.0) - 2 * _area(starts, np.maximum(starts, ends), centers, sigmas)
    square = _area(np.zeros_like(centers), np.ones_like(centers), centers, sigmas / math.sqrt(2))
    return np.maximum(inside + square, 0.0)


_erf = np.frompyfunc(math.erf, 1, 1)


def _area(
    low: NDArray[np.float64], high: NDArray[np.float64], centers: NDArray[np.float64], sigmas: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the integral of exp(-((t - center) / sigma)^2 / 2) from low to high."""
    span = [np.asarray(_erf((edge - centers) / (sigmas * math.sqrt(2))), np.float64) for edge in (low, high)]
    return np.asarray(math.sqrt(math.pi / 2) * sigmas * (span[1] - span[0]))
