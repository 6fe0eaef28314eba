"""Codebooks and SH palette of a bundle, fitted on a bounded sample and weighted by what shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.sog.options import SogOptions
from gsplat_tools.formats.sog.rules import CODEBOOK_SIZE
from gsplat_tools.ops.visibility import MOST

Float32 = NDArray[np.float32]
Labels = NDArray[np.int64]

SAMPLE_ROWS = 1 << 17
"""Splats that codebooks are fitted on at most."""

FLAT_STEP = 20.0
"""How far below all others the entry for flat axes lies, as other writers have it: a factor of 5e8."""

MAX_DEFAULT_PALETTE = 16384
"""Most entries that are chosen without being asked for: four times as many take four times as long."""

TARGET_ERROR = 0.75 / 255
"""Color error of the SH palette that its default size aims for: what a picture of 8 bits does not show."""

_PROBES = 8192

# An SH palette is fitted on so many rows at least, and so many for each entry.
_MIN_TRAINING = 1 << 15
_TRAINING_PER_ENTRY = 4

_THIN = 0.05
"""Weight that an axis keeps beside a much longer one of the same splat, which is all that shows."""


@dataclass(frozen=True, slots=True)
class Palette:
    """An SH palette as it is stored.

    Parameters
    ----------
    codebook
        (256,) ascending coefficients.
    indices
        (K, C, 3) into the codebook.
    labels
        (N,) entry of every splat.
    """

    codebook: Float32
    indices: NDArray[np.uint8]
    labels: Labels


def sample_rows(cloud: GaussianCloud, seed: int) -> slice | NDArray[np.int64]:
    """Return which splats codebooks are fitted on."""
    if len(cloud) <= SAMPLE_ROWS:
        return slice(None)
    return np.sort(np.random.default_rng(seed).permutation(len(cloud))[:SAMPLE_ROWS])


def fit_scales(log_scales: Float32, weights: Float32, rows: slice | NDArray[np.int64]) -> Float32:
    """Return the codebook of log scales, its lowest entry for flat axes where there are any.

    Parameters
    ----------
    log_scales
        (N, 3) of all splats, so that the codebook spans them.
    weights
        (N,) of the splats.
    rows
        Which of them it is fitted on.
    """
    from gsplat_tools.codecs.scalar_codebook import fit_codebook

    chosen = log_scales[rows]
    is_flat = np.isneginf(log_scales)
    has_flat = bool(is_flat.any())
    finite = np.isfinite(chosen)
    longest = chosen.max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        relative = np.exp(np.where(finite, chosen - longest, 0.0))
    axis_weights = (weights[rows][:, None] * (relative + np.float32(_THIN))).astype(np.float32)
    ends = log_scales[~is_flat]
    if ends.size == 0:
        return np.full(CODEBOOK_SIZE, -FLAT_STEP, np.float32)
    values = np.concatenate([chosen[finite], [ends.min(), ends.max()]]).astype(np.float32)
    value_weights = np.concatenate([axis_weights[finite], np.full(2, axis_weights.min(), np.float32)])
    codebook = fit_codebook(values, value_weights, size=CODEBOOK_SIZE - has_flat)
    return np.concatenate([[codebook[0] - np.float32(FLAT_STEP)], codebook]).astype(np.float32) if has_flat else codebook


def fit_colors(sh0: Float32, weights: Float32, rows: slice | NDArray[np.int64]) -> Float32:
    """Return the codebook of sh0, spanning all splats; parameters as for `fit_scales`."""
    from gsplat_tools.codecs.scalar_codebook import fit_codebook

    values = np.concatenate([sh0[rows].ravel(), [sh0.min(), sh0.max()]]).astype(np.float32)
    repeated = np.repeat(weights[rows], 3)
    return fit_codebook(values, np.concatenate([repeated, np.full(2, repeated.min())]).astype(np.float32), size=CODEBOOK_SIZE)


def largest_palette_size(num_splats: int) -> int:
    """Return the size that the existing writer takes, at most `MAX_DEFAULT_PALETTE`: defaults stay below it."""
    rule = min(64, 1 << (num_splats // 1024).bit_length() - 1) * 1024 if num_splats >= 1024 else 512
    return min(rule, MAX_DEFAULT_PALETTE)


def chosen_palette_size(cloud: GaussianCloud, options: SogOptions) -> int:
    """Return the entries that the SH palette of a cloud with bands above 0 is fitted with."""
    from gsplat_tools.ops.importance import importance

    if options.sh_palette_size is not None:
        return options.sh_palette_size
    rows = sample_rows(cloud, options.seed)
    return choose_palette_size(cloud.shN.reshape(len(cloud), -1)[rows], np.sqrt(importance(cloud))[rows])


def choose_palette_size(points: Float32, weights: Float32) -> int:
    """Return the number of entries from which the mean color error falls below `TARGET_ERROR`, or the largest.

    Three palettes of rising size, cut without k-means, give the error as a power of the size between them.

    Parameters
    ----------
    points
        (N, 3 C) the sample.
    weights
        (N,) of its splats.
    """
    from gsplat_tools.codecs import palette

    largest = largest_palette_size(len(points))
    probe = slice(None, None, max(1, len(points) // _PROBES))
    size, error = 0, np.inf
    for larger in (largest // 64, largest // 16, largest // 4):
        centroids = palette.fit_palette(points, weights, size=max(larger, 8), max_rounds=0)
        _, squares = palette.nearest_labels(points[probe], centroids)
        before, smaller = error, size
        size, error = max(larger, 8), _color_error(squares, weights[probe])
        if error <= TARGET_ERROR:
            break
    if smaller == 0 or error <= 0:
        return size
    slope = math.log(before / error) / math.log(size / smaller)
    if slope <= 0:
        return largest
    wanted = size * (error / TARGET_ERROR) ** (1 / slope) if error / TARGET_ERROR < 1e3 else largest
    return int(min(max(wanted, 64), largest))


def _color_error(squares: Float32, weights: Float32) -> float:
    """Return the root mean square error of a color channel over all directions.

    Source
    ------
    Orthonormality of the basis: the mean square of a sum of harmonics is that of its coefficients over 4 pi.
    """
    mean = float(np.dot(squares.astype(np.float64), weights) / weights.sum(dtype=np.float64))
    return math.sqrt(mean / 3 / (4 * math.pi))


def fit_palette(
    shn: Float32,
    weights: Float32,
    rows: slice | NDArray[np.int64],
    options: SogOptions,
    costs: NDArray[np.float64] | None = None,
) -> Palette:
    """Return the SH palette and the entry of every splat that is nearest to what is stored.

    Parameters
    ----------
    shn
        (N, C, 3) of all splats.
    weights
        (N,) of the splats.
    rows
        Which of them it is fitted on.
    options
        Size and effort.
    costs
        (N,) what a squared distance shows; labels then move to frequent entries where that costs little.
    """
    from gsplat_tools.codecs import palette
    from gsplat_tools.codecs.scalar_codebook import fit_codebook, nearest_entry

    points = shn.reshape(len(shn), -1)
    sample, sample_weights = points[rows], weights[rows]
    size = options.sh_palette_size or choose_palette_size(sample, sample_weights)
    step = max(1, len(sample) // max(_MIN_TRAINING, _TRAINING_PER_ENTRY * size))
    centroids = palette.fit_palette(sample[::step], sample_weights[::step], size=size, max_rounds=options.palette_rounds)
    codebook = fit_codebook(centroids.ravel(), size=CODEBOOK_SIZE)
    indices = np.unique(nearest_entry(centroids, codebook).astype(np.uint8), axis=0)
    labels, _ = palette.nearest_labels(points, codebook[indices])
    if costs is not None:
        from gsplat_tools.codecs.relaxation import relax_labels

        labels = relax_labels(points, costs, codebook[indices], labels, most=MOST)
    used, labels = np.unique(labels, return_inverse=True)
    return Palette(codebook, indices[used].reshape(len(used), -1, 3), labels)
