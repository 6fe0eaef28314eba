"""Cloud to bundle."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats import _webp
from gsplat_tools.formats._palettes import check_range
from gsplat_tools.formats._webp import MAX_SIDE, Image
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.sog.codebooks import FLAT_STEP, Palette, fit_colors, fit_palette, fit_scales, sample_rows
from gsplat_tools.formats.sog.meta import META_NAME
from gsplat_tools.formats.sog.options import SogOptions
from gsplat_tools.formats.sog.rules import PALETTE_COLUMNS
from gsplat_tools.ops.visibility import Tolerance, viewpoint
from gsplat_tools.parallel import map_ordered, run_blocks
from gsplat_tools.progress import stage

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

GENERATOR = "gsplat_tools"
MAX_SPLATS = 4 * (MAX_SIDE // 4) * 4 * (MAX_SIDE // 4)
_MAX_LOG_SCALE = 88.0


@dataclass(frozen=True, slots=True)
class Encoded:
    """A cloud as images and the fields of meta.json, before compression.

    Parameters
    ----------
    images
        RGBA by stream name, in the order of the archive.
    meta
        meta.json.
    """

    images: dict[str, Image]
    meta: dict[str, Any]


def write(cloud: GaussianCloud, stream: BinaryIO, options: SogOptions) -> None:
    """Write a version 2 bundle; the same cloud and options give the same bytes.

    Parameters
    ----------
    cloud
        The splats, in the order of the file.
    stream
        Open for writing.
    options
        Palette size, rotation frames and effort.

    Raises
    ------
    CapabilityError
        No splat, too many, or a band above 3.
    CloudError
        Values are not finite.

    Warns
    -----
    LossyConversionWarning
        Flat axes, which the format can only make very thin.
    """
    encoded = encode(cloud, options)

    def compress(name: str) -> bytes:
        # Low position bytes are noise, which more effort hardly shrinks.
        is_noise = name == "means_l" and options.visual_tolerance == 0 and 1 <= options.webp_effort <= _webp.DEFAULT_EFFORT
        return _webp.encode_rgba(encoded.images[name], 1 if is_noise else options.webp_effort)

    archive = ZipWriter(stream)
    # The largest first, so that the threads end together; entries keep the order of the format.
    names = list(encoded.images)
    by_size = sorted(names, key=lambda name: (-encoded.images[name].size, name))
    with stage("compressing", len(names), "images") as progress:
        files = {}
        for name, data in zip(by_size, map_ordered(compress, by_size), strict=True):
            files[name] = data
            progress.advance(1)
    for name in names:
        archive.add(f"{name}.webp", files[name], "stored")
    archive.add(META_NAME, meta_text(encoded.meta), "stored")
    archive.close()


def encode(cloud: GaussianCloud, options: SogOptions) -> Encoded:
    """Quantize a cloud.

    Parameters
    ----------
    cloud
        The splats, in the order of the file.
    options
        Palette size and rotation frames.

    Raises
    ------
    CapabilityError, CloudError
        As for `write`.
    """
    from gsplat_tools import __version__
    from gsplat_tools.codecs import quaternion_sog
    from gsplat_tools.codecs.scalar_codebook import nearest_entry
    from gsplat_tools.codecs.smallest_three import choose_frames, in_frames
    from gsplat_tools.ops.importance import importance

    _check(cloud)
    width, height = layout(len(cloud))
    rows = sample_rows(cloud, options.seed)
    weights = np.sqrt(importance(cloud))
    if options.rotation == "best":
        rotations, frames = quaternion_sog.encode_covariances(cloud.quats, cloud.log_scales)
        _, log_scales = in_frames(cloud.quats, cloud.log_scales, frames)
    else:
        frames = choose_frames(cloud.quats, cloud.log_scales, quaternion_sog.GRID, options.rotation)
        quats, log_scales = in_frames(cloud.quats, cloud.log_scales, frames)
        rotations = quaternion_sog.encode(quats)
    low, high = (signed_log(cloud.means.min(axis=0)), signed_log(cloud.means.max(axis=0)))
    scales = fit_scales(log_scales, weights, rows)
    colors = fit_colors(cloud.sh0, weights, rows)
    images = {name: np.zeros((height, width, 4), np.uint8) for name in ("means_l", "means_u", "quats", "scales", "sh0")}
    pixels = {name: image.reshape(-1, 4) for name, image in images.items()}
    for name in ("means_l", "means_u", "scales"):
        pixels[name][: len(cloud), 3] = 255

    def fill(start: int, stop: int) -> None:
        part = slice(start, stop)
        codes = position_codes(cloud.means[part], low, high)
        pixels["means_l"][part, :3] = codes & 0xFF
        pixels["means_u"][part, :3] = codes >> 8
        pixels["quats"][part] = rotations[part]
        pixels["scales"][part, :3] = nearest_entry(log_scales[part], scales)
        pixels["sh0"][part, :3] = nearest_entry(cloud.sh0[part], colors)
        pixels["sh0"][part, 3] = opacity_bytes(cloud.opacity_logits[part])

    run_blocks(fill, len(cloud))
    tolerance = Tolerance(options.visual_tolerance, viewpoint(cloud)) if options.visual_tolerance > 0 else None
    costs = None if tolerance is None else tolerance.costs(cloud, log_scales)
    if costs is not None:
        from gsplat_tools.formats.sog.relaxing import relax

        relax(images, cloud, log_scales, costs, (scales, colors), (low, high), signed_log(cloud.means))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"{GENERATOR} {__version__}" + (f" from {cloud.source_format}" if cloud.source_format else "")},
        **({} if tolerance is None else {"visualTolerance": tolerance.to_json()}),
        "count": len(cloud),
        # The specification says `antialias`, the writers in use say `model`.
        **({"model": cloud.splat_model} if cloud.splat_model != "default" else {}),
        **({"antialias": True} if cloud.splat_model == "antialiased" else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": shortest(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": shortest(colors), "files": ["sh0.webp"]},
    }
    if cloud.sh_degree:
        palette = fit_palette(cloud.shN, weights, rows, options, None if costs is None else costs.harmonics)
        images |= palette_images(palette, width, height)
        meta["shN"] = {
            "count": len(palette.indices),
            "bands": cloud.sh_degree,
            "codebook": shortest(palette.codebook),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    num_flat = int(np.isneginf(cloud.log_scales).any(axis=1).sum())
    if num_flat:
        message = f"{num_flat} flat splats were given a thickness, exp(-{FLAT_STEP:g}) of the thinnest that is not flat"
        warnings.warn(LossyConversionWarning(message, code="flat-scales"), stacklevel=4)
    return Encoded(images, meta)


def layout(count: int) -> tuple[int, int]:
    """Return (width, height) of the images: multiples of four, nearly square."""
    width = 4 * math.ceil(math.sqrt(count) / 4)
    return width, 4 * math.ceil(count / width / 4)


def signed_log(means: Float32) -> Float64:
    """Return sign(x) ln(1 + |x|)."""
    wide = means.astype(np.float64)
    return np.copysign(np.log1p(np.abs(wide)), wide)


def position_codes(means: Float32, low: Float64, high: Float64) -> NDArray[np.uint16]:
    """Return round(65535 (n - min) / (max - min)) of n = sign(x) ln(1 + |x|), 0 on a flat axis."""
    steps = 65535 / np.where(high > low, high - low, 1.0)
    return np.rint((signed_log(means) - low) * steps).astype(np.uint16)


def opacity_bytes(logits: Float32) -> NDArray[np.uint8]:
    """Return the opacity in 255ths, rounded."""
    from gsplat_tools.attributes.activations import sigmoid

    return np.rint(sigmoid(logits.astype(np.float64)) * 255).astype(np.uint8)


def palette_images(palette: Palette, width: int, height: int) -> dict[str, Image]:
    """Return the images of centroids, 64 entries a row, and of labels."""
    count, coefficients, _ = palette.indices.shape
    centroids = np.zeros((math.ceil(count / PALETTE_COLUMNS), PALETTE_COLUMNS * coefficients, 4), np.uint8)
    centroids.reshape(-1, 4)[: count * coefficients] = _opaque(palette.indices.reshape(-1, 3))
    labels = np.zeros((height, width, 4), np.uint8)
    halves = np.stack([palette.labels & 0xFF, palette.labels >> 8, np.zeros_like(palette.labels)], axis=1)
    labels.reshape(-1, 4)[: len(halves)] = _opaque(halves)
    return {"shN_centroids": centroids, "shN_labels": labels}


def meta_text(meta: Mapping[str, Any]) -> bytes:
    """Return meta.json."""
    return json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()


def shortest(values: Float32) -> list[float]:
    """Return numbers whose text is as short as float32 allows."""
    return [float(str(value)) for value in values]


def _opaque(codes: NDArray[Any]) -> NDArray[np.uint8]:
    """Return (N, 3) bytes with a fourth, 255."""
    return np.concatenate([codes.astype(np.uint8), np.full((len(codes), 1), 255, np.uint8)], axis=1)


def _check(cloud: GaussianCloud) -> None:
    """Refuse what no bundle can hold."""
    if not 1 <= len(cloud) <= MAX_SPLATS:
        raise CapabilityError(f"a SOG bundle holds 1 to {MAX_SPLATS} splats, the scene has {len(cloud)}")
    if cloud.sh_degree > 3:
        raise CapabilityError(f"a SOG bundle holds SH bands up to 3, the scene has {cloud.sh_degree}")
    for name in ("means", "quats", "sh0", "shN"):
        is_finite = np.isfinite(getattr(cloud, name))
        if not is_finite.all():
            is_bad = ~is_finite.reshape(len(cloud), -1).all(axis=1)
            raise CloudError(f"{int(is_bad.sum())} of {len(cloud)} splats are not finite; drop them first", field=name)
    for name, is_bad in (
        ("log_scales", np.isnan(cloud.log_scales).any(axis=1) | (cloud.log_scales > _MAX_LOG_SCALE).any(axis=1)),
        ("opacity_logits", np.isnan(cloud.opacity_logits)),
    ):
        if is_bad.any():
            message = f"{int(is_bad.sum())} of {len(cloud)} splats hold NaN or a scale beyond float32; drop them first"
            raise CloudError(message, field=name)
    check_range(cloud.shN)
