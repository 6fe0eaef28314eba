"""Keyframes back to one 4D asset: a line and a window, or a temporal Gaussian, for every splat, and how far that is off."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.activations import logit, sigmoid
from gsplat_tools.attributes.motion import MIN_SIGMA, positions_at, weights_at
from gsplat_tools.cloud import GaussianCloud, TimeModel
from gsplat_tools.errors import CloudError, LossyConversionWarning
from gsplat_tools.ops.motion import SHOWN, SIGMA_OF_ALWAYS, nearest_gaussians
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionResiduals:
    """How far the frames are from the asset that was fitted to them, splat by splat.

    Parameters
    ----------
    splats
        (N,) index of each splat of the asset in the frames.
    visible_frames
        (N,) frames that show it.
    position_rms, position_max
        (N,) world units, over the frames that show it.
    opacity_rms, opacity_max
        (N,) opacity, over all frames.
    log_scale_rms
        (N,) natural logarithm, over the frames that show it; inf where an axis is flat in some of them only.
    rotation_max
        (N,) radians, over the frames that show it.
    sh0_rms, shN_rms
        (N,) SH coefficients, over the frames that show it.
    """

    splats: NDArray[np.intp]
    visible_frames: NDArray[np.int64]
    position_rms: Float64
    position_max: Float64
    opacity_rms: Float64
    opacity_max: Float64
    log_scale_rms: Float64
    rotation_max: Float64
    sh0_rms: Float64
    shN_rms: Float64

    def summary(self) -> str:
        """Return the residuals in one line for people."""
        if len(self.splats) == 0:
            return "no splat to fit"
        parts = []
        for name, values in (
            ("position", self.position_rms),
            ("opacity", self.opacity_rms),
            ("log scale", self.log_scale_rms),
            ("SH", self.shN_rms),
        ):
            middle, high = np.quantile(values, [0.5, 0.99], method="nearest")
            parts.append(f"{name} {middle:.3g} (99 %: {high:.3g})")
        turn = np.degrees(np.quantile(self.rotation_max, 0.99, method="nearest"))
        return f"median residual: {', '.join(parts)}, largest turn of 99 % {turn:.2g} degrees"


def fit_motion(
    sequence: GaussianSequence, *, time_model: TimeModel | Literal["auto"] = "window"
) -> tuple[GaussianCloud, MotionResiduals]:
    """Fit one 4D asset to the frames of a sequence whose splat i is the same splat in every frame.

    Parameters
    ----------
    sequence
        F frames, one in memory at a time; they are gone through twice.
    time_model
        "window", "gaussian", or "auto": the one whose opacities are nearer in the mean square.

    Returns
    -------
    tuple
        The asset, with the splats that any frame shows, in their order · the residual of each.

    Raises
    ------
    CloudError
        The frames differ in count or degree.

    Warns
    -----
    LossyConversionWarning
        Splats that no frame shows were dropped, with their number.

    Notes
    -----
    Positions: the least-squares line over the frames that show the splat. Window: from halfway to the frame before the
    first of them (time 0 where there is none) to halfway to the frame after the last; frames between that do not show it
    count as residual. Gaussian: least squares of log opacity weighted by its square (Guo 2011). Opacity: the mean over
    the frames that show the splat, or the peak of the Gaussian; scale, rotation and SH: means weighted by opacity.

    Source
    ------
    Welford 1962, Note on a method for calculating corrected sums of squares and products.
    """
    sums = _Sums(sequence.frame(0))
    times = sequence.frame_times
    with stage("fitting motion", 2 * len(sequence), "frames") as progress, np.errstate(invalid="ignore", over="ignore"):
        for frame_id in range(len(sequence)):
            # A splat that is not finite somewhere ends up not finite, and is dropped like any other when it is saved.
            sums.add(frame_id, float(times[frame_id]), _checked(sequence, frame_id))
            progress.advance(1)
        splats = np.flatnonzero(sums.visible > 0)
        hidden = len(sums.visible) - len(splats)
        if hidden:
            message = f"dropped {hidden} of {len(sums.visible)} splats that none of the {len(sequence)} frames shows"
            warnings.warn(LossyConversionWarning(message, code="never-visible"), stacklevel=2)
        models: tuple[TimeModel, ...] = ("window", "gaussian") if time_model == "auto" else (time_model,)
        candidates = [_Residuals(sums.cloud(model, times, splats)) for model in models]
        for frame_id in range(len(sequence)):
            frame = sequence.frame(frame_id).take(splats)
            for candidate in candidates:
                candidate.add(float(times[frame_id]), frame)
            progress.advance(1)
    best = min(candidates, key=lambda candidate: float(candidate.opacity_squares.sum()))
    return best.cloud, best.finish(splats, sums.visible[splats], len(sequence))


def _checked(sequence: GaussianSequence, frame_id: int) -> GaussianCloud:
    """Return a frame that has the splats and the degree of the sequence."""
    frame = sequence.frame(frame_id)
    if len(frame) != sequence.num_splats or frame.sh_degree != sequence.sh_degree:
        raise CloudError(
            f"expected {sequence.num_splats} splats of SH degree {sequence.sh_degree}, found {len(frame)} of {frame.sh_degree}",
            frame=frame_id,
        )
    return frame


class _Sums:
    """What the first pass gathers: moments of times, positions and log opacities, and weighted attributes."""

    def __init__(self, first: GaussianCloud) -> None:
        count = len(first)
        self._first = first
        self.visible = np.zeros(count, np.int64)
        self._from, self._to = np.zeros(count, np.int64), np.zeros(count, np.int64)
        # Running means, and sums of products of differences from them: sums of squares would cancel where times cluster.
        self._time, self._square = np.zeros(count), np.zeros(count)
        self._position, self._moment = np.zeros((count, 3)), np.zeros((count, 3))
        self._opacity = np.zeros(count)
        self._powers, self._logs = np.zeros((5, count)), np.zeros((3, count))
        self._log_scales, self._quats = np.zeros((count, 3)), np.zeros((count, 4))
        self._sh0, self._shN = np.zeros((count, 3)), np.zeros(first.shN.shape)

    def add(self, frame_id: int, t: float, frame: GaussianCloud) -> None:
        """Take one more frame into account."""
        opacities = sigmoid(frame.opacity_logits.astype(np.float64))
        rows = np.flatnonzero(opacities >= SHOWN)
        shown = opacities[rows]
        is_new = self.visible[rows] == 0
        self._from[rows[is_new]] = frame_id
        self._to[rows] = frame_id
        self.visible[rows] += 1
        later = t - self._time[rows]
        self._time[rows] += later / self.visible[rows]
        self._square[rows] += later * (t - self._time[rows])
        farther = frame.means[rows] - self._position[rows]
        self._position[rows] += farther / self.visible[rows][:, None]
        self._moment[rows] += (t - self._time[rows])[:, None] * farther
        self._opacity[rows] += shown
        for power in range(5):
            self._powers[power, rows] += shown**2 * (t - 0.5) ** power
        for power in range(3):
            self._logs[power, rows] += shown**2 * np.log(shown) * (t - 0.5) ** power
        self._log_scales[rows] += shown[:, None] * frame.log_scales[rows]
        self._sh0[rows] += shown[:, None] * frame.sh0[rows]
        self._shN[rows] += shown[:, None, None] * frame.shN[rows]
        quats = frame.quats[rows].astype(np.float64)
        quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
        flips = np.where(np.sum(quats * self._quats[rows], axis=1, keepdims=True) < 0, -1.0, 1.0)
        self._quats[rows] += shown[:, None] * quats * flips

    def cloud(self, time_model: TimeModel, frame_times: Float64, splats: NDArray[np.intp]) -> GaussianCloud:
        """Return the asset of the splats that are named, each of which some frame shows."""
        starts, ends = self._windows(frame_times, splats)
        count, weight = self.visible[splats], self._opacity[splats]
        opacities = weight / count
        times, durations = starts, ends - starts
        if time_model == "gaussian":
            times, durations, opacities = self._gaussians(splats, starts, ends, opacities)
        moments = times.astype(np.float32)
        middle, center = self._time[splats], self._position[splats]
        spread, covariance = self._square[splats], self._moment[splats]
        moves = spread > 1e-12 * count
        velocities = np.where(moves[:, None], covariance / np.where(moves, spread, 1.0)[:, None], 0.0).astype(np.float32)
        share = weight[:, None]
        return GaussianCloud(
            means=(center + velocities * (moments - middle)[:, None]).astype(np.float32),
            log_scales=(self._log_scales[splats] / share).astype(np.float32),
            quats=(self._quats[splats] / share).astype(np.float32),
            opacity_logits=logit(np.clip(opacities, 0.0, 1.0)).astype(np.float32),
            sh0=(self._sh0[splats] / share).astype(np.float32),
            shN=(self._shN[splats] / share[:, :, None]).astype(np.float32),
            velocities=velocities,
            times=moments,
            durations=durations.astype(np.float32),
            time_model=time_model,
            coordinate_system=self._first.coordinate_system,
            origin=self._first.origin,
            splat_model=self._first.splat_model,
        )

    def _windows(self, frame_times: Float64, splats: NDArray[np.intp]) -> tuple[Float64, Float64]:
        """Return starts and ends, halfway between the frames that show a splat and those beside them that do not."""
        halfway = np.concatenate([[0.0], (frame_times[1:] + frame_times[:-1]) / 2, [1.0]])
        return halfway[self._from[splats]], halfway[self._to[splats] + 1]

    def _gaussians(
        self, splats: NDArray[np.intp], starts: Float64, ends: Float64, mean_opacities: Float64
    ) -> tuple[Float64, Float64, Float64]:
        """Return center, sigma and peak; the Gaussian nearest to the window where too few frames show a splat."""
        centers, sigmas, _ = nearest_gaussians(starts, ends)
        peaks = mean_opacities
        powers, logs = self._powers[:, splats], self._logs[:, splats]
        matrices = np.stack([powers[0:3], powers[1:4], powers[2:5]]).transpose(2, 0, 1)
        traces = np.trace(matrices, axis1=1, axis2=2)
        is_told = (self.visible[splats] >= 3) & (np.linalg.det(matrices) > 1e-12 * traces**3)
        a, b, c = np.linalg.solve(matrices[is_told], logs[:, is_told].T[:, :, None])[:, :, 0].T
        is_peak = c < -0.5 / SIGMA_OF_ALWAYS**2
        squares = -0.5 / np.where(is_peak, c, -1.0)
        shifts = b * squares
        with np.errstate(over="ignore"):
            heights = np.exp(a + 0.5 * shifts * shifts / squares)
        # What rises or falls all the time has a peak far outside, and an opacity there that no splat has.
        is_peak &= heights <= 1.0 + 1e-3
        rows = np.flatnonzero(is_told)[is_peak]
        centers[rows], sigmas[rows] = 0.5 + shifts[is_peak], np.sqrt(squares[is_peak])
        peaks = mean_opacities.copy()
        peaks[rows] = np.minimum(heights[is_peak], 1.0)
        return centers, np.maximum(sigmas, MIN_SIGMA), peaks


@dataclass(slots=True)
class _Residuals:
    """What the second pass gathers about one asset."""

    cloud: GaussianCloud
    sums: dict[str, Float64] = field(default_factory=dict)
    opacity_squares: Float64 = field(init=False)

    def __post_init__(self) -> None:
        names = ("position", "position_max", "opacity_max", "log_scale", "rotation", "sh0", "shN")
        self.sums = {name: np.zeros(len(self.cloud)) for name in names}
        self.opacity_squares = np.zeros(len(self.cloud))

    def add(self, t: float, frame: GaussianCloud) -> None:
        """Take the difference to one more frame into account."""
        cloud, sums = self.cloud, self.sums
        assert cloud.velocities is not None
        assert cloud.times is not None
        assert cloud.durations is not None
        weights = weights_at(cloud.times, cloud.durations, t, cloud.time_model, cloud.temporal_cutoff)
        fitted = sigmoid(cloud.opacity_logits.astype(np.float64)) * weights
        given = sigmoid(frame.opacity_logits.astype(np.float64))
        gap = np.where(fitted >= SHOWN, fitted, 0.0) - np.where(given >= SHOWN, given, 0.0)
        self.opacity_squares += gap**2
        np.maximum(sums["opacity_max"], np.abs(gap), out=sums["opacity_max"])
        shown = given >= SHOWN
        means = positions_at(cloud.means, cloud.velocities, cloud.times, t)
        squares = np.square(means.astype(np.float64) - frame.means).sum(axis=1) * shown
        sums["position"] += squares
        np.maximum(sums["position_max"], np.sqrt(squares), out=sums["position_max"])
        with np.errstate(invalid="ignore"):
            same = cloud.log_scales == frame.log_scales
            stretch = np.where(same, 0.0, cloud.log_scales.astype(np.float64) - frame.log_scales)
            sums["log_scale"] += np.where(shown, np.square(stretch).sum(axis=1), 0.0)
        sums["sh0"] += np.square(cloud.sh0.astype(np.float64) - frame.sh0).sum(axis=1) * shown
        sums["shN"] += np.square(cloud.shN.astype(np.float64) - frame.shN).sum(axis=(1, 2)) * shown
        np.maximum(sums["rotation"], _angles(cloud.quats, frame.quats) * shown, out=sums["rotation"])

    def finish(self, splats: NDArray[np.intp], visible: NDArray[np.int64], num_frames: int) -> MotionResiduals:
        """Return the residuals."""
        return MotionResiduals(
            splats=splats,
            visible_frames=visible,
            position_rms=np.sqrt(self.sums["position"] / visible),
            position_max=self.sums["position_max"],
            opacity_rms=np.sqrt(self.opacity_squares / num_frames),
            opacity_max=self.sums["opacity_max"],
            log_scale_rms=np.sqrt(self.sums["log_scale"] / visible / 3),
            rotation_max=self.sums["rotation"],
            sh0_rms=np.sqrt(self.sums["sh0"] / visible / 3),
            shN_rms=np.sqrt(self.sums["shN"] / visible / max(3 * self.cloud.shN.shape[1], 1)),
        )


def _angles(a: NDArray[Any], b: NDArray[Any]) -> Float64:
    """Return the angle of the turn between two rotations, radians; from the chord, which is exact for small angles."""
    first, second = (
        q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12) for q in (a.astype(float), b.astype(float))
    )
    chords = np.minimum(np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1))
    return np.asarray(4 * np.arcsin(np.minimum(chords / 2, 1.0)))
