"""What two scenes look like, drawn by the same reference model from the same cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison.attributes import AttributeTally, match_splats, paired
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

if TYPE_CHECKING:
    from gsplat_tools.reference.camera import Camera

MAX_RENDERED = 250_000
"""Splats of a scene in chunks that are rendered: every k-th of a larger one, so that memory stays bounded."""

Picture = NDArray[np.floating[Any]]
See = Callable[[str, Picture, Picture], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewReport:
    """How one view differs."""

    name: str
    psnr: float | None
    ssim: float | None
    max_abs: float
    mean_abs: float
    share_above_1: float
    share_above_8: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonReport:
    """How far a candidate is from its reference.

    Parameters
    ----------
    psnr_min, psnr_mean
        Over the views, dB; None where every view is identical (identical views are left out of both).
    ssim_mean
        Mean over the views, 1 for identical pictures; None for pictures smaller than 11x11.
    max_abs
        Largest difference of a channel, 0..1.
    identical
        Whether every picture is the same to the bit.
    worst_view
        Name of the view with the lowest PSNR.
    attributes
        Errors per attribute, as `AttributeStatistics.to_json` gives them; empty where the splats cannot be matched.
    views
        One report a view.
    model
        Rendering model and variant that drew both sides.
    rendered_splats
        Splats that were drawn on each side; fewer than there are where the scene was sampled.
    """

    psnr_min: float | None
    psnr_mean: float | None
    ssim_mean: float | None
    max_abs: float
    identical: bool
    worst_view: str
    attributes: Mapping[str, Mapping[str, float | int | None]]
    views: Sequence[ViewReport]
    model: str
    rendered_splats: int


def sample(scene: GaussianCloud | CloudChunks, limit: int = MAX_RENDERED) -> GaussianCloud:
    """Return the cloud, or every k-th splat of chunks that hold more than `limit`."""
    if isinstance(scene, GaussianCloud):
        return scene
    step = -(-len(scene) // limit)
    if step <= 1:
        return scene.read()
    start = 0

    def every_kth(chunk: GaussianCloud) -> GaussianCloud:
        nonlocal start
        first, start = -start % step, start + len(chunk)
        return chunk.take(slice(first, None, step))

    pieces = [every_kth(chunk) for chunk in scene]
    thinned = iter(pieces)
    return CloudChunks(sum(map(len, pieces)), scene.template, lambda: thinned).read()


def compare_rendered(
    pairs: Iterable[tuple[str, GaussianCloud, GaussianCloud]],
    cameras: Sequence[Camera],
    model: tuple[str, str | None],
    *,
    num_pairs: int = 1,
    t: float | None = None,
    see: See | None = None,
) -> ComparisonReport:
    """Draw both sides from every camera and measure the difference.

    Parameters
    ----------
    pairs
        (label, reference, candidate); one pair for a still scene, one a frame for sequences; gone through once.
    cameras
        Views of each pair.
    model
        Rendering model and variant, the same for both sides.
    num_pairs
        Number of pairs, for the progress shown.
    t
        Time at which motion is evaluated.
    see
        Called with the name of each view and both pictures.

    Returns
    -------
    ComparisonReport
        Without attributes.
    """
    from gsplat_tools.reference import image_metrics
    from gsplat_tools.reference.rasterizer import render

    name, variant = model
    views: list[ViewReport] = []
    rendered = 0
    with stage("rendering", 2 * num_pairs * len(cameras), "views") as progress:
        for label, reference, candidate in pairs:
            rendered = max(rendered, len(reference))
            for index, camera in enumerate(cameras):
                images = []
                for cloud in (reference, candidate):
                    images.append(render(cloud, camera, model=name, variant=variant, t=t).image)
                    progress.advance(1)
                metrics = image_metrics.compare_images(images[0], images[1])
                views.append(
                    ViewReport(
                        name=f"{label}view {index}",
                        psnr=metrics.psnr,
                        ssim=metrics.ssim,
                        max_abs=metrics.max_abs,
                        mean_abs=metrics.mean_abs,
                        share_above_1=metrics.share_above_1,
                        share_above_8=metrics.share_above_8,
                    )
                )
                if see is not None:
                    see(views[-1].name, images[0], images[1])
    return summarize_views(views, name if variant is None else f"{name} {variant}", rendered)


def summarize_views(views: Sequence[ViewReport], model: str, rendered_splats: int) -> ComparisonReport:
    """Return what single views, at least one, say together."""
    levels = [view.psnr for view in views if view.psnr is not None]
    similarities = [view.ssim for view in views if view.ssim is not None]
    worst = min(views, key=lambda view: np.inf if view.psnr is None else view.psnr)
    return ComparisonReport(
        psnr_min=min(levels) if levels else None,
        psnr_mean=float(np.mean(levels)) if levels else None,
        ssim_mean=float(np.mean(similarities)) if similarities else None,
        max_abs=max(view.max_abs for view in views),
        identical=not levels,
        worst_view=worst.name,
        attributes={},
        views=views,
        model=model,
        rendered_splats=rendered_splats,
    )


def still(scene: GaussianCloud | GaussianSequence, t: float | None, frame_id: int = 0) -> GaussianCloud:
    """Return the cloud of a scene at a time; a sequence without a time gives one frame as stored."""
    if isinstance(scene, GaussianCloud):
        return scene
    return scene.frame(frame_id) if t is None else scene.at(t)


def compare(
    reference: GaussianCloud | GaussianSequence,
    candidate: GaussianCloud | GaussianSequence,
    *,
    views: int = 8,
    size: tuple[int, int] = (640, 360),
    model: str | None = None,
    variant: str | None = None,
    t: float | None = None,
    cameras: Sequence[Camera] | None = None,
    see: See | None = None,
) -> ComparisonReport:
    """Compare two scenes by their attributes and by what a target would show.

    Parameters
    ----------
    reference, candidate
        Scenes; attributes are compared where both have the same splats (matched by position if their order differs).
        Two sequences of the same length are compared frame by frame. Where both say what their axes are, the candidate is
        brought into those of the reference.
    views
        Number of automatic views of the reference, of each frame.
    size
        Width and height of the pictures, px.
    model, variant
        Rendering model; "inria" by default.
    t
        Normalized time at which sequences and motion are evaluated, instead of all frames.
    cameras
        Views to use instead of automatic ones.
    see
        Called with the name of each view and both pictures.

    Returns
    -------
    ComparisonReport
        PSNR of both pictures clamped to [0, 1], peak 1, on black.
    """
    from gsplat_tools.reference.auto_cameras import auto_cameras

    count = common_frames(reference, candidate) if t is None else 1
    tally = AttributeTally()

    def pairs() -> Iterator[tuple[str, GaussianCloud, GaussianCloud]]:
        matched: slice | NDArray[np.intp] | None = None
        for frame_id in range(count):
            first, second = still(reference, t, frame_id), still(candidate, t, frame_id)
            second = _in_axes_of(first, second)
            if frame_id == 0:
                matched = match_splats(first, second)
            if matched is not None:
                for a, b in paired(first, second if isinstance(matched, slice) else second.take(matched)):
                    tally.add(a, b)
            yield f"frame {frame_id} " if count > 1 else "", first, second

    chosen = list(cameras) if cameras is not None else auto_cameras(still(reference, t), views=views, size=size)
    report = compare_rendered(pairs(), chosen, (model or "inria", variant), num_pairs=count, t=t, see=see)
    return replace(report, attributes=tally.to_json())


def _in_axes_of(reference: GaussianCloud, candidate: GaussianCloud) -> GaussianCloud:
    """Return the candidate in the axes of the reference, where both say what theirs are."""
    from gsplat_tools.ops.coordinates import convert_coordinates

    systems = {reference.coordinate_system, candidate.coordinate_system}
    if "unknown" in systems or len(systems) == 1:
        return candidate
    return convert_coordinates(candidate, reference.coordinate_system)


def common_frames(reference: GaussianCloud | GaussianSequence, candidate: GaussianCloud | GaussianSequence) -> int:
    """Return the number of frames that are compared: all of two sequences of one length, else the first."""
    if isinstance(reference, GaussianSequence) and isinstance(candidate, GaussianSequence):
        return len(reference) if len(reference) == len(candidate) else 1
    return 1


def frame_levels(report: ComparisonReport, frames: int) -> list[dict[str, float | int | None]]:
    """Return the lowest and the mean PSNR of every frame; None where a frame is identical in every view."""
    per_frame = len(report.views) // frames
    levels: list[dict[str, float | int | None]] = []
    for frame_id in range(frames):
        found = [view.psnr for view in report.views[frame_id * per_frame : (frame_id + 1) * per_frame]]
        known = [level for level in found if level is not None]
        levels.append(
            {
                "frame": frame_id,
                "psnr_min": min(known) if known else None,
                "psnr_mean": float(np.mean(known)) if known else None,
            }
        )
    return levels
