"""How far one scene is from another: errors per attribute against derived bounds, and rendered pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations, quaternions
from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.formats.base import Bounds
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

if TYPE_CHECKING:
    from gsplat_tools.reference.camera import Camera

MAX_RENDERED = 250_000
"""Splats of a scene in chunks that are rendered: every k-th of a larger one, so that memory stays bounded."""

_FLOAT32_SLACK = 4e-7
"""Decoders compute in float32: a few roundings of 2^-24 relative to the value come on top of a bound."""


@dataclass(slots=True)
class AttributeStatistics:
    """Errors of one attribute, gathered over chunks.

    Parameters
    ----------
    count, max, sum, sum_squares
        Number of values, largest error, and sums for mean and rms.
    bound
        Largest bound that the encoding allows, or None where none is known beforehand.
    exceeded
        Values that are further off than their own bound.
    """

    count: int = 0
    max: float = 0.0
    sum: float = 0.0
    sum_squares: float = 0.0
    bound: float | None = None
    exceeded: int = 0

    def add(self, errors: NDArray[np.float64], bound: NDArray[Any] | None) -> None:
        """Take the errors of one more chunk into account."""
        if errors.size == 0:
            return
        self.count += errors.size
        self.max = max(self.max, float(errors.max()))
        self.sum += float(errors.sum())
        self.sum_squares += float(np.square(errors).sum())
        if bound is not None:
            self.bound = max(self.bound or 0.0, float(bound.max(initial=0.0)))
            self.exceeded += int(np.count_nonzero(~(errors <= bound)))

    def to_json(self) -> dict[str, float | int | None]:
        """Return max, mean, rms, bound and exceeded; numbers that are not finite become None."""
        count = max(self.count, 1)
        numbers = {
            "max": self.max,
            "mean": self.sum / count,
            "rms": float(np.sqrt(self.sum_squares / count)),
            "bound": self.bound,
        }
        finite = {name: None if value is None or not np.isfinite(value) else value for name, value in numbers.items()}
        return {**finite, "exceeded": self.exceeded if self.bound is not None else None}


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewReport:
    """How one view differs."""

    name: str
    psnr: float | None
    ssim: float
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
        Mean over the views, 1 for identical pictures.
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
    ssim_mean: float
    max_abs: float
    identical: bool
    worst_view: str
    attributes: Mapping[str, Mapping[str, float | int | None]]
    views: Sequence[ViewReport]
    model: str
    rendered_splats: int


def attribute_errors(reference: GaussianCloud, candidate: GaussianCloud) -> dict[str, NDArray[np.float64]]:
    """Return the distance of every value, in spaces where two encodings of the same splat agree.

    Parameters
    ----------
    reference, candidate
        Clouds of the same length and order.

    Returns
    -------
    dict
        means (N, 3) world units · scales (N, 3), each splat's log scales sorted, because relabeling the axes does not
        change a Gaussian · covariances (N,), Frobenius norm of the difference relative to the reference ·
        opacities (N,) · sh0 (N, 3) · shN (N, K - 1, 3), missing bands count as zero · and motion where both have it.

    Raises
    ------
    CloudError
        The lengths differ.
    """
    if len(reference) != len(candidate):
        raise CloudError(f"the reference has {len(reference)} splats, the candidate {len(candidate)}")
    shift = reference.origin - candidate.origin
    means = np.abs(reference.means.astype(np.float64) + shift - candidate.means)
    sorted_a, sorted_b = np.sort(reference.log_scales, axis=1), np.sort(candidate.log_scales, axis=1)
    with np.errstate(invalid="ignore"):
        scales = np.where(sorted_a == sorted_b, 0.0, np.abs(sorted_a.astype(np.float64) - sorted_b))
    opacities = np.abs(
        activations.sigmoid(reference.opacity_logits).astype(np.float64) - activations.sigmoid(candidate.opacity_logits)
    )
    errors = {
        "means": means,
        "scales": scales,
        "covariances": _covariance_errors(reference, candidate),
        "opacities": opacities,
        "sh0": np.abs(reference.sh0.astype(np.float64) - candidate.sh0),
    }
    num_rest = max(reference.shN.shape[1], candidate.shN.shape[1])
    if num_rest:
        difference = np.zeros((len(reference), num_rest, 3))
        difference[:, : reference.shN.shape[1]] += reference.shN
        difference[:, : candidate.shN.shape[1]] -= candidate.shN
        errors["shN"] = np.abs(difference)
    if reference.has_motion and candidate.has_motion:
        for name in ("velocities", "times", "durations"):
            errors[name] = np.abs(getattr(reference, name).astype(np.float64) - getattr(candidate, name))
    return errors


def _covariance_errors(reference: GaussianCloud, candidate: GaussianCloud) -> NDArray[np.float64]:
    """Return ||Sigma' - Sigma|| / ||Sigma||, both scaled by the reference's longest axis so that nothing overflows."""
    longest = reference.log_scales.max(axis=1, initial=-np.inf, keepdims=True).astype(np.float64)
    longest = np.where(np.isfinite(longest), longest, 0.0)

    def covariances(cloud: GaussianCloud) -> NDArray[np.float64]:
        axes = quaternions.to_matrix(cloud.quats.astype(np.float64)) * np.exp(cloud.log_scales - longest)[:, None, :]
        return np.asarray(axes @ axes.transpose(0, 2, 1))

    first = covariances(reference)
    difference = np.linalg.norm(covariances(candidate) - first, axis=(1, 2))
    norms = np.linalg.norm(first, axis=(1, 2))
    return np.asarray(np.divide(difference, norms, out=np.where(difference > 0, np.inf, 0.0), where=norms > 0))


class AttributeTally:
    """Errors of all attributes, gathered chunk by chunk."""

    def __init__(self) -> None:
        self.attributes: dict[str, AttributeStatistics] = {}

    def add(self, reference: GaussianCloud, candidate: GaussianCloud, bounds: Bounds | None = None) -> None:
        """Take one more pair of chunks into account."""
        bounds = bounds or {}
        for name, errors in attribute_errors(reference, candidate).items():
            bound = bounds.get(name)
            if bound is not None:
                widened = np.broadcast_to(np.asarray(bound, np.float64), errors.shape)
                bound = widened + _slack(name, reference, widened)
            self.attributes.setdefault(name, AttributeStatistics()).add(errors, bound)

    def exceeded(self) -> list[str]:
        """Return one phrase for every attribute that leaves its bound."""
        return [
            f"{name}: {tally.exceeded} of {tally.count} values beyond their bound (largest error {tally.max:.6g}, "
            f"largest bound {tally.bound:.6g})"
            for name, tally in self.attributes.items()
            if tally.exceeded
        ]

    def to_json(self) -> dict[str, dict[str, float | int | None]]:
        """Return every attribute's errors."""
        return {name: tally.to_json() for name, tally in self.attributes.items()}


def _slack(name: str, reference: GaussianCloud, bound: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what float32 arithmetic in a decoder may add to a bound."""
    slack = np.asarray(bound * 1e-5)
    if name == "means":
        return slack + _FLOAT32_SLACK * (np.abs(reference.means) + np.abs(reference.origin))
    if name in {"sh0", "shN"} and getattr(reference, name).shape == bound.shape:
        return slack + _FLOAT32_SLACK * np.abs(getattr(reference, name))
    if name == "scales":
        return slack + 2 * _FLOAT32_SLACK * np.abs(np.nan_to_num(np.sort(reference.log_scales, axis=1), neginf=0.0))
    if name == "covariances":
        longest = np.abs(np.nan_to_num(reference.log_scales.max(axis=1, initial=-np.inf), neginf=0.0))
        return slack + 16 * _FLOAT32_SLACK * (1 + longest)
    return slack + _FLOAT32_SLACK


def paired(
    reference: GaussianCloud | CloudChunks, candidate: GaussianCloud | CloudChunks
) -> Iterator[tuple[GaussianCloud, GaussianCloud]]:
    """Yield pieces of both scenes that cover the same splats, however each is cut."""
    streams = iter(as_chunks(reference)), iter(as_chunks(candidate))
    left = next(streams[0], None), next(streams[1], None)
    a, b = left
    while a is not None and b is not None:
        count = min(len(a), len(b))
        yield a.take(slice(0, count)), b.take(slice(0, count))
        a = a.take(slice(count, None)) if count < len(a) else next(streams[0], None)
        b = b.take(slice(count, None)) if count < len(b) else next(streams[1], None)


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
    pairs: Sequence[tuple[str, GaussianCloud, GaussianCloud]],
    cameras: Sequence[Camera],
    model: tuple[str, str | None],
    *,
    t: float | None = None,
    attributes: Mapping[str, Mapping[str, float | int | None]] | None = None,
) -> tuple[ComparisonReport, list[tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]]]:
    """Draw both sides from every camera and measure the difference.

    Parameters
    ----------
    pairs
        (label, reference, candidate); one pair for a still scene, one a frame for sequences.
    cameras
        Views of each pair.
    model
        Rendering model and variant, the same for both sides.
    t
        Time at which motion is evaluated.
    attributes
        Attribute errors to put into the report.

    Returns
    -------
    tuple
        The report, and the pictures of reference and candidate per view.
    """
    from gsplat_tools.reference import image_metrics
    from gsplat_tools.reference.rasterizer import render

    name, variant = model
    views: list[ViewReport] = []
    pictures = []
    with stage("rendering", 2 * len(pairs) * len(cameras), "views") as progress:
        for label, reference, candidate in pairs:
            for index, camera in enumerate(cameras):
                images = []
                for cloud in (reference, candidate):
                    images.append(render(cloud, camera, model=name, variant=variant, t=t).image)  # type: ignore[arg-type]
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
                pictures.append((images[0], images[1]))
    levels = [view.psnr for view in views if view.psnr is not None]
    worst = min(views, key=lambda view: np.inf if view.psnr is None else view.psnr)
    report = ComparisonReport(
        psnr_min=min(levels) if levels else None,
        psnr_mean=float(np.mean(levels)) if levels else None,
        ssim_mean=float(np.mean([view.ssim for view in views])),
        max_abs=max(view.max_abs for view in views),
        identical=not levels,
        worst_view=worst.name,
        attributes=attributes or {},
        views=views,
        model=name if variant is None else f"{name} {variant}",
        rendered_splats=len(pairs[0][1]),
    )
    return report, pictures


def still(scene: GaussianCloud | GaussianSequence, t: float | None) -> GaussianCloud:
    """Return the cloud of a scene at a time; a sequence without a time gives its first frame as stored."""
    if isinstance(scene, GaussianCloud):
        return scene
    return scene.frame(0) if t is None else scene.at(t)


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
) -> ComparisonReport:
    """Compare two scenes by their attributes and by what a target would show.

    Parameters
    ----------
    reference, candidate
        Scenes; attributes are compared where both have the same splats (matched by position if their order differs).
    views
        Number of automatic views of the reference.
    size
        Width and height of the pictures, px.
    model, variant
        Rendering model; "inria" by default.
    t
        Normalized time at which sequences and motion are evaluated.
    cameras
        Views to use instead of automatic ones.

    Returns
    -------
    ComparisonReport
        PSNR of both pictures clamped to [0, 1], peak 1, on black.
    """
    return compare_with_pictures(
        reference, candidate, views=views, size=size, model=model, variant=variant, t=t, cameras=cameras
    )[0]


def compare_with_pictures(
    reference: GaussianCloud | GaussianSequence,
    candidate: GaussianCloud | GaussianSequence,
    *,
    views: int = 8,
    size: tuple[int, int] = (640, 360),
    model: str | None = None,
    variant: str | None = None,
    t: float | None = None,
    cameras: Sequence[Camera] | None = None,
) -> tuple[ComparisonReport, list[tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]]]:
    """Return what `compare` returns and the pairs of pictures it is about."""
    from gsplat_tools.reference.auto_cameras import auto_cameras

    first, second = still(reference, t), still(candidate, t)
    chosen = list(cameras) if cameras is not None else auto_cameras(first, views=views, size=size)
    attributes = {}
    matched = match_splats(first, second)
    if matched is not None:
        tally = AttributeTally()
        for a, b in paired(first, second if isinstance(matched, slice) else second.take(matched)):
            tally.add(a, b)
        attributes = tally.to_json()
    return compare_rendered([("", first, second)], chosen, (model or "inria", variant), t=t, attributes=attributes)


def match_splats(reference: GaussianCloud, candidate: GaussianCloud) -> NDArray[np.intp] | slice | None:
    """Return which splat of the candidate stands for each of the reference, or None where that cannot be told.

    Notes
    -----
    Two orders are tried: that of the reference, and the Morton order that encoders give their splats. None where the
    counts differ or neither brings most splats near their counterparts.
    """
    from gsplat_tools.ops.ordering import splat_order

    if len(reference) != len(candidate) or len(reference) == 0:
        return None
    world = reference.means + (reference.origin - candidate.origin)
    tolerance = 1e-3 * (float(np.ptp(world, axis=0).max()) or 1.0)

    def is_near(order: slice | NDArray[Any]) -> bool:
        return bool(np.median(np.abs(world[order] - candidate.means).max(axis=1)) <= tolerance)

    if is_near(slice(None)):
        return slice(None)
    order = splat_order(reference, "morton")
    if is_near(order):
        matched = np.empty(len(order), np.intp)
        matched[order] = np.arange(len(order))
        return matched
    return None
