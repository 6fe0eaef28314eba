"""What all frames share: scale codebook, sh0 codebook, SH palettes and rotation frames, fitted on a bounded sample."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import CloudError
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.rules import BAND_COEFFICIENTS, SH0_ENTRIES

Float32 = NDArray[np.float32]

SAMPLE_ROWS = 1 << 17
"""Splats, over all frames, that codebooks are fitted on at most."""

THIN = 0.02
"""Share of a splat's largest scale that is added to all three before they are compared (`scale_coordinates`)."""

_MIN_LOG = -27.0
_MAX_LOG = 88.0


@dataclass(frozen=True, slots=True)
class Palette:
    """An SH palette as stored, and the mean squared error that it leaves on its sample."""

    name: str
    first: int
    coefficients: int
    centroids: Float32
    error: float

    def rows(self, cloud: GaussianCloud) -> Float32:
        """Return what the palette stands for in every splat, (N, 3 C)."""
        part = cloud.shN[:, self.first : self.first + self.coefficients]
        return np.ascontiguousarray(part).reshape(len(cloud), 3 * self.coefficients)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shared:
    """Everything that encoding one frame needs besides the frame and the labels before it."""

    options: Sog4dOptions
    width: int
    height: int
    bands: int
    scale_codebook: Float32
    scale_error: float
    sh0_codebook: Float32
    palettes: tuple[Palette, ...] = ()
    rotation_frames: NDArray[np.uint8] | None = None
    scale_points: Float32 = field(init=False)

    def __post_init__(self) -> None:
        with np.errstate(divide="ignore"):
            object.__setattr__(self, "scale_points", scale_coordinates(np.log(self.scale_codebook)))


@dataclass(slots=True)
class Sample:
    """Splats drawn from all frames, with what has to be known of all."""

    log_scales: Float32
    sh0: Float32
    shN: Float32
    weights: Float32
    sh0_range: tuple[float, float]


def draw_sample(frames: Iterable[GaussianCloud], num_frames: int, seed: int) -> Sample:
    """Go through all frames once and keep the same number of splats of each."""
    from gsplat_tools.ops.importance import importance

    quota = max(1, SAMPLE_ROWS // num_frames)
    parts: list[tuple[Float32, ...]] = []
    low, high = np.inf, -np.inf
    for frame_id, cloud in enumerate(frames):
        weights = importance(cloud)
        rows: slice | NDArray[np.int64] = slice(None)
        if len(cloud) > quota:
            rows = np.sort(np.random.default_rng((seed, frame_id)).permutation(len(cloud))[:quota])
        parts.append((cloud.log_scales[rows], cloud.sh0[rows], cloud.shN[rows], weights[rows]))
        low, high = min(low, float(cloud.sh0.min())), max(high, float(cloud.sh0.max()))
    log_scales, sh0, shN, weights = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Sample(log_scales, sh0, shN, weights, (low, high))


def scale_coordinates(log_scales: Float32) -> Float32:
    """Return log(s + THIN max s) of every scale s: differences that show, and hardly any where an axis is thin.

    An axis much thinner than the others does not change a splat's shape; without this a codebook spends its entries on
    telling 1e-6 from 1e-7.
    """
    wide = np.clip(log_scales.astype(np.float64), _MIN_LOG - 10, _MAX_LOG)
    largest = wide.max(axis=-1, keepdims=True)
    coordinates: Float32 = np.maximum(largest + np.log(np.exp(wide - largest) + THIN), _MIN_LOG).astype(np.float32)
    return coordinates


def scales_at(coordinates: Float32) -> Float32:
    """Return the scales whose coordinates these are, the inverse of `scale_coordinates`."""
    wide = np.exp(coordinates.astype(np.float64))
    largest = wide.max(axis=-1, keepdims=True) / (1 + THIN)
    # Rounding alone must not turn a thin axis into a negative one.
    scales: Float32 = np.maximum(wide - THIN * largest, 1e-4 * THIN * largest).astype(np.float32)
    return scales


def fit_shared(
    sample: Sample,
    first: GaussianCloud,
    options: Sog4dOptions,
    layout: tuple[int, int],
) -> Shared:
    """Fit codebooks and palettes.

    Parameters
    ----------
    sample
        Splats of all frames.
    first
        The first frame, which decides the rotation frame of each splat.
    options
        Sizes, types and seed.
    layout
        (width, height) of the images.
    """
    from gsplat_tools.codecs.palette import fit_palette, nearest_labels
    from gsplat_tools.codecs.scalar_codebook import fit_codebook

    frames = _rotation_frames(first, options)
    # The splats of the first frame are relabelled; which axis comes first in a sample hardly matters otherwise.
    log_scales = _turn_sample(sample, first, frames)
    points = scale_coordinates(log_scales)
    size = options.scale_codebook_size or default_scale_size(len(first))
    codebook = scales_at(fit_palette(points, sample.weights, size=size, seed=options.seed, max_rounds=8))
    codebook = _ordered(_rounded(codebook))
    with np.errstate(divide="ignore"):
        _, distances = nearest_labels(points, scale_coordinates(np.log(codebook)))
    sh0_weights = np.repeat(sample.weights, 3)
    if options.sh0_codebook == "fit":
        values = np.concatenate([sample.sh0.ravel(), np.array(sample.sh0_range, np.float32)])
        weights = np.concatenate([sh0_weights, np.full(2, sh0_weights.min(), np.float32)])
        sh0_codebook = fit_codebook(values, weights, size=SH0_ENTRIES)
    else:
        sh0_codebook = BASE_RGB
    return Shared(
        options=options,
        width=layout[0],
        height=layout[1],
        bands=first.sh_degree,
        scale_codebook=codebook,
        scale_error=float(distances.mean(dtype=np.float64)),
        sh0_codebook=sh0_codebook,
        palettes=_fit_palettes(sample, first.sh_degree, len(first), options),
        rotation_frames=frames,
    )


def default_scale_size(num_splats: int) -> int:
    """Return how many scale triples a codebook gets by default."""
    return int(np.clip(num_splats // 12, 256, 16384))


def default_palette_size(num_splats: int) -> int:
    """Return how many entries an SH palette gets by default."""
    return int(np.clip(num_splats // 32, 64, 16384))


def _fit_palettes(sample: Sample, bands: int, num_splats: int, options: Sog4dOptions) -> tuple[Palette, ...]:
    """Fit one palette, or one a band, and round it to its stored type."""
    from gsplat_tools.codecs.palette import fit_palette, nearest_labels

    if bands == 0:
        return ()
    parts = [("shN", 0, sample.shN.shape[1])]
    if options.version == 2:
        starts = np.cumsum([0, *BAND_COEFFICIENTS])
        parts = [(f"sh{i + 1}", int(starts[i]), BAND_COEFFICIENTS[i]) for i in range(bands)]
    size = options.sh_palette_size or default_palette_size(num_splats)
    rows = _training_rows(len(sample.weights), size)
    palettes = []
    for name, first, coefficients in parts:
        points = sample.shN[rows, first : first + coefficients].reshape(-1, 3 * coefficients)
        centroids = fit_palette(points, sample.weights[rows], size=size, seed=options.seed, max_rounds=6)
        stored = np.clip(centroids, -65504, 65504).astype("<f2" if options.centroids == "f16" else "<f4").astype(np.float32)
        probe = points[:: max(1, len(points) // 8192)]
        error = float(nearest_labels(probe, stored)[1].mean(dtype=np.float64))
        palettes.append(Palette(name, first, coefficients, stored, error))
    return tuple(palettes)


def _training_rows(available: int, size: int) -> slice:
    """Return an even choice of rows to fit a palette on."""
    wanted = max(1 << 15, 8 * size)
    return slice(None, None, max(1, available // wanted))


def _rotation_frames(first: GaussianCloud, options: Sog4dOptions) -> NDArray[np.uint8] | None:
    """Return the frame of each splat, chosen once for all frames, or None to leave axes as they are."""
    if options.rotation != "small":
        return None
    from gsplat_tools.kernels.rotation_frames import frames_of_largest_w

    frames = np.empty(len(first), np.uint8)
    frames_of_largest_w(first.quats, frames)
    return frames


def turned(cloud: GaussianCloud, frames: NDArray[np.uint8] | None) -> tuple[Float32, Float32]:
    """Return quaternions and log scales in the chosen frames."""
    if frames is None:
        return cloud.quats, cloud.log_scales
    from gsplat_tools.kernels.rotation_frames import apply_frames

    quats, log_scales = np.empty_like(cloud.quats), np.empty_like(cloud.log_scales)
    apply_frames(cloud.quats, cloud.log_scales, frames, quats, log_scales)
    return quats, log_scales


def _turn_sample(sample: Sample, first: GaussianCloud, frames: NDArray[np.uint8] | None) -> Float32:
    """Return the sample's log scales with axes in the order that frames give them."""
    if frames is None:
        return sample.log_scales
    # All six orders of axes occur in turned splats: give each row of the sample one of them, by its place.
    orders = np.array([(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
    rows = orders[np.arange(len(sample.log_scales)) % 6]
    return np.take_along_axis(sample.log_scales, rows, axis=1)


def _rounded(codebook: Float32) -> Float32:
    """Return scales rounded to three digits, which is finer than the codebook and short as text."""
    with np.errstate(divide="ignore"):
        exponents = np.floor(np.log10(codebook.astype(np.float64)))
    units = 10.0 ** np.where(np.isfinite(exponents), exponents - 2, 0)
    return (np.rint(codebook / units) * units).astype(np.float32)


def _ordered(codebook: Float32) -> Float32:
    """Return distinct entries along a path through them, so that close indices mean close scales."""
    from gsplat_tools.ops.ordering import morton_order

    distinct = np.unique(codebook, axis=0)
    with np.errstate(divide="ignore"):
        logs = np.maximum(np.log(distinct), np.float32(_MIN_LOG))
    return distinct[morton_order(logs)]


def check_finite(cloud: GaussianCloud, frame: int) -> None:
    """Refuse values that no bundle can hold.

    Raises
    ------
    CloudError
        Something is not finite; the first array that is wrong is named.
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


BASE_RGB: Float32 = ((np.arange(SH0_ENTRIES) / 255 - 0.5) / SH_C0).astype(np.float32)
"""The fixed codebook of colors in [0, 1]."""
