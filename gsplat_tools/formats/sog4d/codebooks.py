"""What all frames share: scale codebook, sh0 codebook, SH palettes and rotation frames, fitted on a bounded sample."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import CloudError
from gsplat_tools.formats._palettes import check_range, stored_entries
from gsplat_tools.formats.sog4d import balancing
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.rules import BAND_COEFFICIENTS, SH0_ENTRIES
from gsplat_tools.formats.sog4d.sampling import Sample
from gsplat_tools.ops.visibility import Tolerance, viewpoint
from gsplat_tools.parallel import run_blocks

Float32 = NDArray[np.float32]

THIN = 0.02
"""Share of a splat's largest scale that is added to all three before they are compared (`scale_coordinates`)."""

LONG_SHARE = 0.02
"""Share of splats whose rotation is stored as exactly as four bytes allow, also where the rest is stored small."""

MIN_LOG = -27.0
"""Floor of `scale_coordinates`: e^-27 world units, 2e-12, below which all scales are the same."""

_MAX_LOG = 88.0

_PROBES = 8192

# Rounding of stored entries relative to the error that the codebook leaves anyway: it adds about 2 percent to the mean
# square, and takes the text of a scale triple from 7 bytes to 5, an SH palette to a third (docs/codebooks.md).
_SCALE_GRID = 0.7
_CENTROID_GRID = 0.5
_FINE_STEP = 0.03

DEFAULT_SH0_ENTRIES, DEFAULT_ROTATION_STEPS = 128, 64
"""Where neither the options nor a visual tolerance say otherwise."""


@dataclass(frozen=True, slots=True)
class Palette:
    """An SH palette as stored, and the mean squared error that it leaves on its sample."""

    name: str
    first: int
    coefficients: int
    centroids: Float32
    error: float

    def rows(self, shN: Float32) -> Float32:
        """Return what the palette stands for in every splat, (N, 3 C)."""
        part = shN[:, self.first : self.first + self.coefficients]
        return np.ascontiguousarray(part).reshape(len(shN), 3 * self.coefficients)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shared:
    """Everything that encoding one frame needs besides the frame and the labels before it.

    Parameters
    ----------
    options
        Of the bundle.
    width, height
        Of the images.
    bands
        Highest SH band.
    scale_codebook, sh0_codebook, palettes
        As stored.
    scale_error
        Mean squared error that the scale codebook leaves.
    rotation_frames, is_long
        (N,) of each splat, from the first frame: `falling_frames` and `long_splats`, where the options ask for them.
    tolerance
        What may show, or None.
    pilot
        (P, K - 1, 3) SH of the splats on which searches are tried, where a frame is encoded in pieces; None where the
        frame's own are.
    """

    options: Sog4dOptions
    width: int
    height: int
    bands: int
    scale_codebook: Float32
    scale_error: float
    sh0_codebook: Float32
    palettes: tuple[Palette, ...] = ()
    rotation_frames: NDArray[np.uint8] | None = None
    is_long: NDArray[np.bool_] | None = None
    tolerance: Tolerance | None = None
    pilot: Float32 | None = None
    scale_points: Float32 = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale_points", points_of(self.scale_codebook))


def scale_coordinates(log_scales: Float32) -> Float32:
    """Return log(s + THIN max s) of every scale s: differences that show, and hardly any where an axis is thin.

    An axis much thinner than the others does not change a splat's shape; without this a codebook spends its entries on
    telling 1e-6 from 1e-7.
    """
    wide = np.clip(log_scales.astype(np.float64), MIN_LOG - 10, _MAX_LOG)
    largest = wide.max(axis=-1, keepdims=True)
    coordinates: Float32 = np.maximum(largest + np.log(np.exp(wide - largest) + THIN), MIN_LOG).astype(np.float32)
    return coordinates


def points_of(scale_codebook: Float32) -> Float32:
    """Return the coordinates of stored entries, in which labels are chosen and, with the same bits, bounds derived."""
    with np.errstate(divide="ignore"):
        return scale_coordinates(np.log(scale_codebook))


def scales_at(coordinates: Float32) -> Float32:
    """Return the scales whose coordinates these are, the inverse of `scale_coordinates`."""
    wide = np.exp(coordinates.astype(np.float64))
    largest = wide.max(axis=-1, keepdims=True) / (1 + THIN)
    # Rounding alone must not turn a thin axis into a negative one.
    scales: Float32 = np.maximum(wide - THIN * largest, 1e-4 * THIN * largest).astype(np.float32)
    return scales


def fit_shared(sample: Sample, first: GaussianCloud, options: Sog4dOptions, layout: tuple[int, int]) -> Shared:
    """Fit codebooks and palettes, and decide what the first frame decides.

    Parameters
    ----------
    sample
        Splats of all frames.
    first
        The first frame, which decides the rotation frame of each splat.
    options
        Sizes and types.
    layout
        (width, height) of the images.
    """
    shared = fit_codebooks(sample, len(first), options, layout)
    shared = for_splats(shared, first, long_splats(first) if options.rotation == "small" else None)
    return _balanced(shared, sample, first, options) if options.visual_tolerance > 0 else shared


def _balanced(shared: Shared, sample: Sample, first: GaussianCloud, options: Sog4dOptions) -> Shared:
    """Return codebooks and steps as fine as what they show is worth, where the options leave that open."""
    tolerance = Tolerance(options.visual_tolerance, viewpoint(first))
    quats, log_scales = turned(first, shared.rotation_frames)
    costs = tolerance.costs(first, log_scales)
    shared = replace(shared, tolerance=tolerance)
    if options.scale_codebook_size is None:
        size = balancing.scale_size(shared.scale_points, scale_coordinates(log_scales), costs)
        codebook, error = _fit_scales(sample, options, size)
        shared = replace(shared, scale_codebook=codebook, scale_error=error)
    if options.sh0_entries is None and options.sh0_codebook == "fit":
        entries = balancing.color_entries(lambda count: _fit_sh0(sample, count), first.sh0, costs)
        codebook = _fit_sh0(sample, entries)
        shared = replace(shared, sh0_codebook=codebook, options=replace(shared.options, sh0_entries=entries))
    if options.rotation_steps is None and options.rotation == "small":
        steps = balancing.rotation_steps(quats, costs)
        shared = replace(shared, options=replace(shared.options, rotation_steps=steps))
    return shared


def fit_codebooks(sample: Sample, num_splats: int, options: Sog4dOptions, layout: tuple[int, int]) -> Shared:
    """Fit codebooks and palettes for frames of `num_splats`; nothing about single splats is decided."""
    bands = REST_COEFFICIENTS.index(sample.shN.shape[1])
    size = sizes(num_splats, options)["scale_codebook_size"]
    codebook, error = _fit_scales(sample, options, size)
    entries, steps = options.sh0_entries or DEFAULT_SH0_ENTRIES, options.rotation_steps or DEFAULT_ROTATION_STEPS
    return Shared(
        options=replace(options, sh0_entries=entries, rotation_steps=steps),
        width=layout[0],
        height=layout[1],
        bands=bands,
        scale_codebook=codebook,
        scale_error=error,
        sh0_codebook=BASE_RGB if options.sh0_codebook == "base-rgb" else _fit_sh0(sample, entries),
        palettes=_fit_palettes(sample, bands, num_splats, options),
    )


def for_splats(shared: Shared, first: GaussianCloud, is_long: NDArray[np.bool_] | None) -> Shared:
    """Return the same for these splats of the first frame; `is_long` is their part of `long_splats` of all."""
    frames = None if shared.options.rotation == "reference" else falling_frames(first)
    return replace(shared, rotation_frames=frames, is_long=is_long)


def sizes(num_splats: int, options: Sog4dOptions) -> dict[str, int]:
    """Return the entries of codebook and palettes by option; a visual tolerance may enlarge a codebook that is not given."""
    return {
        "scale_codebook_size": options.scale_codebook_size or int(options.detail * default_scale_size(num_splats)),
        "sh_palette_size": options.sh_palette_size or int(options.detail * default_palette_size(num_splats)),
    }


def default_scale_size(num_splats: int) -> int:
    """Return how many scale triples a codebook gets by default."""
    return int(np.clip(num_splats // 20, 1024, 16384))


def default_palette_size(num_splats: int) -> int:
    """Return how many entries an SH palette gets by default."""
    return int(np.clip(num_splats // 12, 512, 8192))


def falling_frames(cloud: GaussianCloud) -> NDArray[np.uint8]:
    """Return for every splat the frame in which its scales fall and its quaternion has the largest w.

    Codebooks of triples then hold one order of axes instead of six, and w is the largest of the four bytes.
    """
    from gsplat_tools.kernels.sorted_frames import frames_of_falling_scales

    frames = np.empty(len(cloud), np.uint8)
    run_blocks(
        lambda start, stop: frames_of_falling_scales(cloud.quats[start:stop], cloud.log_scales[start:stop], frames[start:stop]),
        len(cloud),
    )
    return frames


def long_splats(cloud: GaussianCloud) -> NDArray[np.bool_]:
    """Return which splats are so long and opaque that a small turn shows: a share of LONG_SHARE of all."""
    return longest(visible_lengths(cloud))


def visible_lengths(cloud: GaussianCloud) -> NDArray[np.float64]:
    """Return the logarithm of how long each splat shows, (N,): its largest scale times the root of its opacity."""
    lengths: NDArray[np.float64] = cloud.log_scales.max(axis=1).astype(np.float64) - 0.5 * np.logaddexp(
        0, -cloud.opacity_logits.astype(np.float64)
    )
    return lengths


def longest(lengths: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which are the LONG_SHARE largest of all; the first come first where some are equal."""
    count = int(np.ceil(LONG_SHARE * len(lengths)))
    least = np.partition(lengths, len(lengths) - count)[len(lengths) - count]
    is_long: NDArray[np.bool_] = lengths > least
    is_long[np.flatnonzero(lengths == least)[: count - np.count_nonzero(is_long)]] = True
    return is_long


def turned(cloud: GaussianCloud, frames: NDArray[np.uint8] | None) -> tuple[Float32, Float32]:
    """Return quaternions and log scales in the chosen frames."""
    if frames is None:
        return cloud.quats, cloud.log_scales
    from gsplat_tools.kernels.rotation_frames import apply_frames

    quats, log_scales = np.empty_like(cloud.quats), np.empty_like(cloud.log_scales)
    apply_frames(cloud.quats, cloud.log_scales, frames, quats, log_scales)
    return quats, log_scales


def _fit_scales(sample: Sample, options: Sog4dOptions, size: int) -> tuple[Float32, float]:
    """Return the scale codebook as stored, and the mean squared error that it leaves."""
    from gsplat_tools.codecs.palette import fit_palette, nearest_labels

    # Axes in the order in which frames put them: hardly any splat changes that order later in a sequence.
    log_scales = sample.log_scales if options.rotation == "reference" else -np.sort(-sample.log_scales, axis=1)
    points = scale_coordinates(log_scales)
    centroids = fit_palette(points, np.sqrt(sample.weights), size=size, max_rounds=2)
    error = float(nearest_labels(points, centroids)[1].mean(dtype=np.float64))
    codebook = _on_grid(scales_at(centroids), _SCALE_GRID * np.sqrt(error / 3))
    return codebook, float(nearest_labels(points, points_of(codebook))[1].mean(dtype=np.float64))


def _on_grid(codebook: Float32, step: float) -> Float32:
    """Return distinct scales in rising order, their logarithms on a grid of `step`, with three digits.

    The text of a number that occurs again costs next to nothing; the grid is finer than the cells of the codebook.
    """
    wide = codebook.astype(np.float64)
    if step > 0:
        with np.errstate(divide="ignore"):
            wide = np.exp(np.rint(np.log(wide) / step) * step)
    digits = 2 if step < _FINE_STEP else 1
    with np.errstate(divide="ignore"):
        exponents = np.floor(np.log10(wide))
    units = 10.0 ** np.where(np.isfinite(exponents), exponents - digits, 0)
    rounded = (np.rint(wide / units) * units).astype(np.float32) if step > 0 else codebook
    return np.unique(np.where(rounded > 0, rounded, codebook), axis=0)


def _fit_sh0(sample: Sample, entries: int) -> Float32:
    """Return the sh0 codebook: the optimum for the sample, from the smallest to the largest value of all frames."""
    from gsplat_tools.codecs.scalar_codebook import fit_codebook

    weights = np.repeat(np.sqrt(sample.weights), 3)
    values = np.concatenate([sample.sh0.ravel(), np.array(sample.sh0_range, np.float32)])
    codebook = fit_codebook(values, np.concatenate([weights, np.full(2, weights.min(), np.float32)]), size=entries)
    return np.concatenate([codebook, np.full(SH0_ENTRIES - entries, codebook[-1], np.float32)])


def _fit_palettes(sample: Sample, bands: int, num_splats: int, options: Sog4dOptions) -> tuple[Palette, ...]:
    """Fit one palette, or one a band, and round it to its stored type."""
    from gsplat_tools.codecs.palette import fit_palette, nearest_labels

    if bands == 0:
        return ()
    parts = [("shN", 0, sample.shN.shape[1])]
    if options.version == 2:
        starts = np.cumsum([0, *BAND_COEFFICIENTS])
        parts = [(f"sh{i + 1}", int(starts[i]), BAND_COEFFICIENTS[i]) for i in range(bands)]
    size = sizes(num_splats, options)["sh_palette_size"]
    weights = np.sqrt(sample.weights)
    palettes = []
    for name, first, coefficients in parts:
        points = sample.shN[:, first : first + coefficients].reshape(-1, 3 * coefficients)
        centroids = fit_palette(points, weights, size=size, max_rounds=options.palette_rounds)
        probe = points[:: max(1, len(points) // _PROBES)]
        step = _grid_step(float(nearest_labels(probe, centroids)[1].mean(dtype=np.float64)) / points.shape[1])
        stored = _stored_centroids(centroids, step, options, name)
        error = float(nearest_labels(probe, stored)[1].mean(dtype=np.float64))
        palettes.append(Palette(name, first, coefficients, stored, error))
    return tuple(palettes)


def _grid_step(error: float) -> float:
    """Return a power of two of at most half the root mean square error of a coefficient, 0 where there is none."""
    return 2.0 ** np.floor(np.log2(_CENTROID_GRID * np.sqrt(error))) if error > 0 else 0.0


def _stored_centroids(centroids: Float32, step: float, options: Sog4dOptions, name: str) -> Float32:
    """Return centroids as the file holds them: distinct, short vectors first, on a grid that deflates well."""
    on_grid = np.rint(centroids / np.float32(step)) * np.float32(step) if step > 0 else centroids
    distinct = np.unique(stored_entries(on_grid, options.centroids, name).astype(np.float32), axis=0)
    return distinct[np.argsort(np.einsum("kd,kd->k", distinct, distinct), kind="stable")]


def check_finite(cloud: GaussianCloud, frame: int) -> None:
    """Refuse values that no bundle can hold.

    Raises
    ------
    CloudError
        Something is not finite; the first array that is wrong is named.
    CapabilityError
        SH are too large for a palette.
    """
    for name in ("means", "quats", "sh0", "shN"):
        is_bad = ~np.isfinite(getattr(cloud, name))
        if is_bad.any():
            count = int(is_bad.reshape(len(cloud), -1).any(axis=1).sum())
            raise CloudError(f"{count} of {len(cloud)} splats are not finite; drop them first", field=name, frame=frame)
    for name, is_bad in (
        ("log_scales", np.isnan(cloud.log_scales).any(axis=1) | (cloud.log_scales > _MAX_LOG).any(axis=1)),
        ("opacity_logits", np.isnan(cloud.opacity_logits)),
    ):
        if is_bad.any():
            message = f"{int(is_bad.sum())} of {len(cloud)} splats hold NaN or a scale beyond float32; drop them first"
            raise CloudError(message, field=name, frame=frame)
    check_range(cloud.shN, frame)


BASE_RGB: Float32 = ((np.arange(SH0_ENTRIES) / 255 - 0.5) / SH_C0).astype(np.float32)
"""The fixed codebook of colors in [0, 1]."""
