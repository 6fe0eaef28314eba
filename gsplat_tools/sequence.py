"""GaussianSequence: lazy frames of one cloud, and their evaluation at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.activations import mixed_logits, sigmoid
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import VISIBLE_OPACITY
from gsplat_tools.errors import CloudError

Interpolation = Literal["linear", "nearest"]
Bounds = tuple[NDArray[np.float64], NDArray[np.float64]]

# Scales are interpolated in the log domain from this floor up, and quaternions below it fall back to the
# identity (evaluation rules of the .sog4d specification).
_MIN_SCALE = 1e-8
_MIN_QUAT_NORM = 1e-8


class GaussianSequence:
    """Keyframes of one cloud: splat i is the same splat in every frame; frames are loaded one at a time.

    Parameters
    ----------
    load_frame
        Returns the stored values of frame i as a cloud.
    num_splats
        Splats in every frame.
    sh_degree
        Highest SH band, 0 to 4.
    frame_times
        (F,) normalized times in [0, 1], non-decreasing; None spaces the frames evenly.
    num_frames
        Number of frames where `frame_times` is None.
    load_bounds
        Returns (min, max) of all frames; by default every frame is loaded.

    Raises
    ------
    CloudError
        There is no frame, or the times leave [0, 1], decrease or are not finite.
    """

    def __init__(
        self,
        load_frame: Callable[[int], GaussianCloud],
        *,
        num_splats: int,
        sh_degree: int,
        frame_times: Sequence[float] | NDArray[np.float64] | None = None,
        num_frames: int | None = None,
        load_bounds: Callable[[], Bounds | None] | None = None,
    ) -> None:
        self.is_uniform = frame_times is None
        if frame_times is None:
            if num_frames is None:
                raise CloudError("needs num_frames or frame_times")
            frame_times = np.linspace(0.0, 1.0, num_frames) if num_frames > 1 else np.zeros(max(num_frames, 0))
        times = np.array(frame_times, np.float64)
        if times.ndim != 1 or times.size == 0:
            raise CloudError(f"a sequence needs at least one frame, found times of shape {times.shape}", field="frame_times")
        if not np.isfinite(times).all() or times.min() < 0 or times.max() > 1 or (np.diff(times) < 0).any():
            raise CloudError("expected non-decreasing finite times in [0, 1]", field="frame_times")
        self._load_frame = load_frame
        self._load_bounds = load_bounds
        self.frame_times: NDArray[np.float64] = times
        self.num_splats = num_splats
        self.sh_degree = sh_degree

    def __len__(self) -> int:
        return len(self.frame_times)

    def frame(self, frame_id: int) -> GaussianCloud:
        """Return the stored values of one frame.

        Raises
        ------
        CloudError
            There is no such frame.
        """
        if not 0 <= frame_id < len(self):
            raise CloudError(f"expected a frame in 0..{len(self) - 1}, found {frame_id}", frame=frame_id)
        return self._load_frame(frame_id)

    def map(self, function: Callable[[GaussianCloud], GaussianCloud]) -> GaussianSequence:
        """Return these frames with `function`, which keeps count and degree, applied to each as it is loaded."""
        return GaussianSequence(
            lambda frame_id: function(self.frame(frame_id)),
            num_splats=self.num_splats,
            sh_degree=self.sh_degree,
            frame_times=None if self.is_uniform else self.frame_times,
            num_frames=len(self),
            load_bounds=self._load_bounds,
        )

    def within(self, context: Callable[[], AbstractContextManager[None]]) -> GaussianSequence:
        """Return these frames, each loaded inside what `context` returns, such as one that names the file in errors."""
        load_bounds = self._load_bounds

        def frame(frame_id: int) -> GaussianCloud:
            with context():
                return self.frame(frame_id)

        def bounds() -> Bounds | None:
            assert load_bounds is not None
            with context():
                return load_bounds()

        return GaussianSequence(
            frame,
            num_splats=self.num_splats,
            sh_degree=self.sh_degree,
            frame_times=None if self.is_uniform else self.frame_times,
            num_frames=len(self),
            load_bounds=None if load_bounds is None else bounds,
        )

    def bracket(self, t: float) -> tuple[int, int, float]:
        """Return (i0, i1, a): the keyframes around normalized time `t` and the fraction of the second.

        Notes
        -----
        Uniform: u = clamp01(t) (F - 1), i0 = floor u, i1 = min(i0 + 1, F - 1), a = u - i0. Explicit: the bracketing
        pair by binary search; a = 0 for equal times; clamped outside.
        """
        if not np.isfinite(t):
            raise ValueError(f"time must be finite, got {t}")
        last = len(self) - 1
        if last == 0:
            return 0, 0, 0.0
        if self.is_uniform:
            u = min(max(float(t), 0.0), 1.0) * last
            first = min(int(u), last)
            return first, min(first + 1, last), u - first
        times = self.frame_times
        if t <= times[0]:
            return 0, min(1, last), 0.0
        if t >= times[-1]:
            return last, last, 0.0
        second = int(np.searchsorted(times, t, side="right"))
        first = second - 1
        span = times[second] - times[first]
        return first, second, float((t - times[first]) / span) if span > 0 else 0.0

    def at(self, t: float, interpolation: Interpolation = "linear") -> GaussianCloud:
        """Return the cloud that is drawn at normalized time `t`.

        Parameters
        ----------
        t
            Normalized time; clamped to the sequence.
        interpolation
            "nearest" shows the earlier keyframe of the bracketing pair; "linear" interpolates means, sh0, shN and
            opacities linearly, scales in the log domain and quaternions by normalized lerp on one hemisphere.

        Returns
        -------
        GaussianCloud
            Opacities below 1/255 are 0 (logit -inf), in both modes.

        Source
        ------
        Evaluation rules of the .sog4d format (docs/formats/sog4d.md).
        """
        if interpolation not in ("linear", "nearest"):
            raise ValueError(f"interpolation must be 'linear' or 'nearest', got {interpolation!r}")
        first, second, fraction = self.bracket(t)
        cloud = self.frame(first)
        if interpolation == "linear" and fraction > 0 and second != first:
            cloud = _interpolate(cloud, self.frame(second), fraction)
        return _gate_opacity(cloud)

    def bounds(self) -> Bounds | None:
        """Return (min, max) of the means over all frames, (3,) float64 each; None without splats."""
        if self._load_bounds is not None:
            return self._load_bounds()
        boxes = [box for box in (self.frame(i).bounds() for i in range(len(self))) if box is not None]
        if not boxes:
            return None
        return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def _gate_opacity(cloud: GaussianCloud) -> GaussianCloud:
    """Turn opacities below 1/255 into 0."""
    # A stored byte of 1 must pass although sigmoid(logit(1/255)) rounds either way.
    hidden = sigmoid(cloud.opacity_logits.astype(np.float64)) < VISIBLE_OPACITY * (1 - 1e-6)
    logits = np.where(hidden, np.float32(-np.inf), cloud.opacity_logits)
    return cloud.replace(opacity_logits=logits)


def _interpolate(a: GaussianCloud, b: GaussianCloud, fraction: float) -> GaussianCloud:
    """Evaluate between two keyframes: in float64, rounded once, so that what is equal in both stays as it is."""
    first_logs, second_logs = (np.maximum(frame.log_scales.astype(np.float64), np.log(_MIN_SCALE)) for frame in (a, b))
    quats, others = a.quats.astype(np.float64), b.quats.astype(np.float64)
    flips = np.where(np.sum(quats * others, axis=1, keepdims=True) < 0, -1.0, 1.0)
    quats = _mix(quats, others * flips, fraction)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    is_null = norms < _MIN_QUAT_NORM
    quats = np.where(is_null, np.array([1.0, 0.0, 0.0, 0.0]), quats / np.where(is_null, 1.0, norms))
    return a.replace(
        # The frames may have been recentered apart.
        means=_mix(a.means.astype(np.float64), b.means + (b.origin - a.origin), fraction),
        log_scales=_mix(first_logs, second_logs, fraction),
        quats=quats,
        opacity_logits=mixed_logits(a.opacity_logits, b.opacity_logits, fraction),
        sh0=_mix(a.sh0.astype(np.float64), b.sh0.astype(np.float64), fraction),
        shN=_mix(a.shN.astype(np.float64), b.shN.astype(np.float64), fraction),
    )


def _mix(a: NDArray[np.float64], b: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Return a + (b - a) fraction, which keeps equal values as they are."""
    return a + (b - a) * fraction
