"""Which moments of a 4D asset to keep as keyframes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.activations import sigmoid
from gsplat_tools.attributes.motion import weights_at
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import VISIBLE_OPACITY
from gsplat_tools.errors import CloudError
from gsplat_tools.ops.importance import importance

SAMPLE_SPLATS = 8192
"""Splats that errors are estimated on: an even choice of a larger cloud."""

RESOLUTION = 512
"""Steps of time that keyframes are chosen among; errors are also measured halfway between them."""

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameChoice:
    """Keyframes, and how well linear interpolation between them follows the asset.

    Parameters
    ----------
    times
        (F,) float64 in [0, 1], rising, first 0 and last 1.
    error
        Largest error at any moment that was looked at.
    uniform_frames
        Evenly spaced frames that do no worse, or None where not even one a step is enough.
    """

    times: NDArray[np.float64]
    error: float
    uniform_frames: int | None


def choose_frames(cloud: GaussianCloud, tolerance: float) -> FrameChoice:
    """Choose keyframes of a 4D asset, close together where linear interpolation errs most.

    Parameters
    ----------
    cloud
        N splats with motion.
    tolerance
        Largest error at any moment, in (0, 1): the mean over the splats of the difference between interpolated and true
        opacity, weighted by the area and opacity of the splats (`ops.importance`). 0.01 is a picture that is off by 1 %
        of what the splats show.

    Returns
    -------
    FrameChoice
        As few keyframes as hold the tolerance among RESOLUTION + 1 moments. Where splats come and go faster than that, the
        frames are as close as the steps and `error` says what is left.

    Raises
    ------
    CloudError
        The cloud has no motion or no splats.
    ValueError
        The tolerance is not in (0, 1).

    Notes
    -----
    Paths are lines, which interpolation follows exactly, so all of the error is opacity: windows open between keyframes
    but interpolation fades them in. From each keyframe the farthest next one is taken whose interval holds the tolerance,
    which gives the fewest where longer intervals err more.
    """
    if cloud.times is None or cloud.durations is None or len(cloud) == 0:
        raise CloudError("the cloud has no motion to choose frames for", field="velocities")
    if not 0 < tolerance < 1:
        raise ValueError(f"the tolerance must be between 0 and 1, got {tolerance}")
    sample, opacities, weights = _sampled(cloud)
    keyframes = [0]
    while keyframes[-1] < RESOLUTION:
        keyframes.append(_farthest(opacities, weights, keyframes[-1], tolerance))
    error = _worst(opacities, weights, keyframes)
    return FrameChoice(
        times=np.array(keyframes, np.float64) / RESOLUTION,
        error=error,
        uniform_frames=_uniform_frames(sample, opacities, weights, error),
    )


def interpolation_error(cloud: GaussianCloud, frame_times: NDArray[np.float64]) -> float:
    """Return the largest error, as `choose_frames` measures it, of keyframes at any times from 0 to 1."""
    sample, opacities, weights = _sampled(cloud)
    return _error_of(sample, opacities, weights, np.asarray(frame_times, np.float64))


def _sampled(cloud: GaussianCloud) -> tuple[GaussianCloud, Float32, Float32]:
    """Return a sample, its opacities (n, 2 RESOLUTION + 1) over time, and its weights, which sum to 1."""
    sample = cloud.take(slice(None, None, -(-len(cloud) // SAMPLE_SPLATS)))
    weights = importance(sample)
    return sample, _opacities(sample, np.linspace(0, 1, 2 * RESOLUTION + 1)), weights / weights.sum()


def _error_of(sample: GaussianCloud, opacities: Float32, weights: Float32, frame_times: NDArray[np.float64]) -> float:
    """Return the largest error of keyframes at any times."""
    moments = np.linspace(0, 1, opacities.shape[1])
    stored = _opacities(sample, frame_times)
    worst = 0.0
    for index, (first, second) in enumerate(pairwise(frame_times)):
        inside = slice(*np.searchsorted(moments, [first, second], side="right"))
        if second > first:
            fractions = (moments[inside] - first) / (second - first)
            worst = max(worst, _errors(opacities[:, inside], stored[:, index : index + 2], fractions, weights))
    return worst


def _opacities(cloud: GaussianCloud, moments: NDArray[np.float64]) -> Float32:
    """Return what each splat shows at each moment, the 1/255 gate applied."""
    assert cloud.times is not None
    assert cloud.durations is not None
    stored = sigmoid(cloud.opacity_logits)
    shown = np.empty((len(cloud), len(moments)), np.float32)
    for column, t in enumerate(moments):
        shown[:, column] = stored * weights_at(cloud.times, cloud.durations, t, cloud.time_model, cloud.temporal_cutoff)
    shown[shown < np.float32(VISIBLE_OPACITY)] = 0
    return shown


def _errors(true: Float32, ends: Float32, fractions: NDArray[np.float64], weights: Float32) -> float:
    """Return the largest weighted mean error over moments between two keyframes."""
    if true.shape[1] == 0:
        return 0.0
    between = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * fractions.astype(np.float32)
    return float((weights @ np.abs(between - true)).max())


def _interval_error(opacities: Float32, weights: Float32, first: int, second: int) -> float:
    """Return the error between two steps."""
    columns = slice(2 * first + 1, 2 * second)
    count = 2 * (second - first)
    ends = opacities[:, [2 * first, 2 * second]]
    return _errors(opacities[:, columns], ends, np.arange(1, count) / count, weights)


def _farthest(opacities: Float32, weights: Float32, first: int, tolerance: float) -> int:
    """Return the last step that interpolation from `first` reaches within the tolerance, at least the next."""
    good, step = first + 1, 1
    while good < RESOLUTION and _interval_error(opacities, weights, first, min(first + 2 * step, RESOLUTION)) <= tolerance:
        step *= 2
        good = min(first + step, RESOLUTION)
    bad = min(first + 2 * step, RESOLUTION + 1)
    while bad - good > 1:
        middle = (good + bad) // 2
        if _interval_error(opacities, weights, first, middle) <= tolerance:
            good = middle
        else:
            bad = middle
    return good


def _worst(opacities: Float32, weights: Float32, keyframes: list[int]) -> float:
    """Return the largest error over all intervals."""
    return max(_interval_error(opacities, weights, first, second) for first, second in pairwise(keyframes))


def _uniform_frames(sample: GaussianCloud, opacities: Float32, weights: Float32, error: float) -> int | None:
    """Return how many evenly spaced frames do no worse, found by halving, which takes more frames for better."""

    def is_enough(count: int) -> bool:
        return _error_of(sample, opacities, weights, np.linspace(0, 1, count)) <= error

    few, many = 1, 2
    while not is_enough(many):
        few, many = many, 2 * many
        if few > RESOLUTION:
            return None
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if is_enough(middle) else (middle, many)
    return many
