"""What a conversion does about time: pick a moment, bake a 4D asset to keyframes, fit keyframes to a 4D asset."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud, TimeModel
from gsplat_tools.errors import CapabilityError, CloudError, GsplatWarning
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.sequence import GaussianSequence, Interpolation

DEFAULT_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How a 4D asset becomes keyframes, or a sequence a 4D asset.

    Parameters
    ----------
    frames
        Keyframes to bake a 4D asset to: a number, spaced evenly, or "auto" (`ops.keyframes.choose_frames`).
    tolerance
        Largest error of "auto".
    fit
        Time model to fit a sequence with, "auto" for the better one. By default sequences are fitted, with "auto", where
        the target is a 4D format.
    fit_report
        Folder for the residuals of the fit: motion_residuals.npz, a row a splat, and a picture of them.
    """

    frames: int | Literal["auto"] | None = None
    tolerance: float = DEFAULT_TOLERANCE
    fit: TimeModel | Literal["auto"] | None = None
    fit_report: Path | None = None


DEFAULT_MOTION = Motion()
"""Nothing asked for."""


@dataclass(slots=True)
class Retimed:
    """What was done: splats left out by cause, and facts for the report."""

    dropped: dict[str, int] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)


def retime(
    scene: Scene,
    target: Format,
    motion: Motion,
    time_at: float | None,
    frame: int | None,
    interpolation: Interpolation,
    options: dict[str, Any],
) -> tuple[Scene, Retimed]:
    """Return the scene as the target is to have it in time.

    Parameters
    ----------
    scene
        As it was opened, invalid splats included.
    target
        Format that will be written.
    motion
        How to bake or fit.
    time_at, frame, interpolation
        One moment or one stored frame.
    options
        Options of the conversion; `frame_times` is taken out where a 4D asset is baked at these times.

    Raises
    ------
    CapabilityError
        What was asked for makes no sense for this source.
    CloudError
        Invalid splats were to be refused.
    """
    if time_at is not None and frame is not None:
        raise CapabilityError("give a time or a frame, not both")
    if isinstance(scene, GaussianSequence):
        if motion.frames is not None:
            raise CapabilityError("the source is a sequence already; leave out --frames, which bakes the motion of a 4D asset")
        if frame is not None:
            return scene.frame(frame), Retimed()
        if time_at is not None:
            return scene.at(time_at, interpolation), Retimed()
        fits = motion.fit is not None or (target.fits_sequences and len(scene) > 1)
        return _fit(scene, target, motion) if fits else (scene, Retimed())
    if motion.fit is not None:
        raise CapabilityError("the source is not a sequence; leave out --fit-motion")
    has_motion = (scene.template if isinstance(scene, CloudChunks) else scene).has_motion
    is_baked = motion.frames is not None or (has_motion and target.holds_sequences and "frame_times" in options)
    if frame is not None or ((time_at is not None or is_baked) and not has_motion):
        raise CapabilityError("the source is not a sequence and has no motion; leave out --time, --frame and --frames")
    if time_at is None and not is_baked:
        return scene, Retimed()
    cloud = scene.read() if isinstance(scene, CloudChunks) else scene
    return _bake(cloud, target, motion, time_at, options)


def _bake(
    cloud: GaussianCloud, target: Format, motion: Motion, time_at: float | None, options: dict[str, Any]
) -> tuple[Scene, Retimed]:
    """Return keyframes of a 4D asset, or the still cloud of one moment."""
    from gsplat_tools.formats.loading import drop_or_refuse
    from gsplat_tools.ops.filtering import classify_invalid
    from gsplat_tools.ops.keyframes import choose_frames
    from gsplat_tools.ops.motion import bake

    # Invalid splats are told apart from those that never show.
    done = Retimed(dropped=classify_invalid(cloud)[1])
    cloud = drop_or_refuse(cloud, strict=bool(options.get("strict")))
    if time_at is not None:
        return _moment(cloud, time_at, done), done
    times: Any = motion.frames
    if not target.holds_sequences:
        raise CapabilityError(f"{target.title} holds no sequence; leave out --frames, or take one moment with --time")
    if "frame_times" in options:
        times = options.pop("frame_times")
        if motion.frames not in (None, len(times)):
            raise CapabilityError(f"--frames is {motion.frames} and --frame-times names {len(times)}; give one of them")
    elif times == "auto":
        choice = choose_frames(cloud, motion.tolerance)
        times = choice.times
        done.facts = {"baked_frames": len(times), "baking_error": choice.error, "uniform_frames": choice.uniform_frames}
        if choice.error > motion.tolerance:
            message = (
                f"splats come and go faster than keyframes can follow: opacity is off by up to {choice.error:.3g} of what "
                f"shows, more than the tolerance of {motion.tolerance:g}"
            )
            warnings.warn(GsplatWarning(message, code="baking-tolerance"), stacklevel=3)
    count = len(cloud)
    sequence = bake(cloud, times)
    if count > sequence.num_splats:
        done.dropped["never-visible"] = count - sequence.num_splats
    if sequence.num_splats == 0:
        raise CloudError("no frame shows any splat; check the times and durations", field="times")
    return sequence, done


def _moment(cloud: GaussianCloud, time_at: float, done: Retimed) -> GaussianCloud:
    """Return what one moment shows; what it does not show is counted."""
    from gsplat_tools.ops.motion import at_time, visible_splats

    if not np.isfinite(time_at):
        raise CapabilityError(f"a time must be finite, got {time_at}")
    shown = visible_splats(cloud, [time_at])
    if not shown.all():
        done.dropped["not-visible-then"] = int(np.count_nonzero(~shown))
    return at_time(cloud.take(shown), time_at)


def _fit(sequence: GaussianSequence, target: Format, motion: Motion) -> tuple[Scene, Retimed]:
    """Return the 4D asset that is nearest to a sequence, saying how near."""
    from gsplat_tools.ops.motion_fitting import fit_motion

    if not target.holds_motion:
        raise CapabilityError(f"{target.title} holds no motion; leave out --fit-motion")
    cloud, residuals = fit_motion(sequence, time_model=motion.fit or "auto")
    done = Retimed(facts={"fitted_model": cloud.time_model})
    if len(cloud) < sequence.num_splats:
        done.dropped["never-visible"] = sequence.num_splats - len(cloud)
    warnings.warn(
        GsplatWarning(
            f"fitted {len(sequence)} frames to lines and {cloud.time_model} visibility, {residuals.summary()}",
            code="fitted-motion",
        ),
        stacklevel=3,
    )
    if motion.fit_report is not None:
        from gsplat_tools.comparison.motion import residual_picture
        from gsplat_tools.formats._atomic import replacing

        motion.fit_report.mkdir(parents=True, exist_ok=True)
        with replacing(motion.fit_report / "motion_residuals.npz", overwrite=True) as stream:
            np.savez_compressed(stream, **asdict(residuals))
        if len(cloud):
            from PIL import Image

            with replacing(motion.fit_report / "motion_residuals.png", overwrite=True) as stream:
                Image.fromarray(residual_picture(cloud, residuals)).save(stream, format="PNG", optimize=True)
    return cloud, done
