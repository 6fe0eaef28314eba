"""The bounded sample that codebooks are fitted on: the same for the same frames, wherever each was drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud

Float32 = NDArray[np.float32]

SAMPLE_ROWS = 1 << 17
"""Splats, over all frames, that codebooks are fitted on at most."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Splats drawn from one frame or from all, with their weights, and the range of all colors, drawn or not."""

    log_scales: Float32
    sh0: Float32
    shN: Float32
    weights: Float32
    sh0_range: tuple[float, float]


def draw_frame(cloud: GaussianCloud, frame_id: int, num_frames: int, seed: int) -> Sample:
    """Draw the splats of one frame: the same for the same frame, whatever was drawn elsewhere before."""
    from gsplat_tools.ops.importance import importance

    rows = drawn_rows(len(cloud), frame_id, num_frames, seed)
    weights = importance(cloud)
    ends = float(cloud.sh0.min()), float(cloud.sh0.max())
    return Sample(cloud.log_scales[rows], cloud.sh0[rows], cloud.shN[rows], weights[rows], ends)


def drawn_rows(num_splats: int, frame_id: int, num_frames: int, seed: int) -> NDArray[np.int64]:
    """Return which splats of a frame are drawn, in their order."""
    quota = max(1, SAMPLE_ROWS // num_frames)
    if num_splats <= quota:
        return np.arange(num_splats)
    return np.sort(np.random.default_rng((seed, frame_id)).permutation(num_splats)[:quota])


def merge_samples(parts: Sequence[Sample]) -> Sample:
    """Return the samples of all frames as one; they must come in the order of the frames."""
    names = ("log_scales", "sh0", "shN", "weights")
    log_scales, sh0, shN, weights = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    lows, highs = zip(*(part.sh0_range for part in parts), strict=True)
    return Sample(log_scales, sh0, shN, weights, (min(lows), max(highs)))


def draw_sample(frames: Iterable[GaussianCloud], num_frames: int, seed: int) -> Sample:
    """Go through all frames once and keep the same number of splats of each."""
    return merge_samples([draw_frame(cloud, frame_id, num_frames, seed) for frame_id, cloud in enumerate(frames)])
