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
from gsplat_tools.formats._webp import MAX_SIDE, Image
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.sog.codebooks import FLAT_STEP, Palette, fit_colors, fit_palette, fit_scales, sample_rows
from gsplat_tools.formats.sog.meta import META_NAME
from gsplat_tools.formats.sog.options import SogOptions
from gsplat_tools.formats.sog.rules import PALETTE_COLUMNS
from gsplat_tools.parallel import map_ordered
from gsplat_tools.progress import stage

Float32 = NDArray[np.float32]

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
        return _webp.encode_rgba(encoded.images[name], options.webp_effort)

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
    frames = choose_frames(cloud.quats, cloud.log_scales, quaternion_sog.GRID, options.rotation)
    quats, log_scales = in_frames(cloud.quats, cloud.log_scales, frames)
    codes, low, high = position_codes(cloud.means)
    scales = fit_scales(log_scales, weights, rows)
    colors = fit_colors(cloud.sh0, weights, rows)
    color_codes = np.empty((len(cloud), 4), np.uint8)
    color_codes[:, :3] = nearest_entry(cloud.sh0, colors)
    color_codes[:, 3] = opacity_bytes(cloud.opacity_logits)
    images = {
        "means_l": _image(codes & 0xFF, width, height),
        "means_u": _image(codes >> 8, width, height),
        "quats": _image(quaternion_sog.encode(quats), width, height),
        "scales": _image(nearest_entry(log_scales, scales), width, height),
        "sh0": _image(color_codes, width, height),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"{GENERATOR} {__version__}"},
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
        palette = fit_palette(cloud.shN, weights, rows, options)
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


def position_codes(means: Float32) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.float64]]:
    """Return round(65535 (n - min) / (max - min)) of n = sign(x) ln(1 + |x|), and the range (3,) of n."""
    wide = means.astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(wide)), wide)
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = 65535 / np.where(high > low, high - low, 1.0)
    return np.rint((logs - low) * steps).astype(np.uint16), low, high


def opacity_bytes(logits: Float32) -> NDArray[np.uint8]:
    """Return the opacity in 255ths, rounded."""
    from gsplat_tools.attributes.activations import sigmoid

    return np.rint(sigmoid(logits.astype(np.float64)) * 255).astype(np.uint8)


def palette_images(palette: Palette, width: int, height: int) -> dict[str, Image]:
    """Return the images of centroids, 64 entries a row, and of labels."""
    count, coefficients, _ = palette.indices.shape
    centroids = _image(palette.indices.reshape(-1, 3), PALETTE_COLUMNS * coefficients, math.ceil(count / PALETTE_COLUMNS))
    labels = np.zeros((len(palette.labels), 3), np.uint8)
    labels[:, 0] = palette.labels & 0xFF
    labels[:, 1] = palette.labels >> 8
    return {"shN_centroids": centroids, "shN_labels": _image(labels, width, height)}


def meta_text(meta: Mapping[str, Any]) -> bytes:
    """Return meta.json."""
    return json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()


def shortest(values: Float32) -> list[float]:
    """Return numbers whose text is as short as float32 allows."""
    return [float(str(value)) for value in values]


def _image(codes: NDArray[Any], width: int, height: int) -> Image:
    """Return an image of (N, 3) or (N, 4) bytes, opaque where they are three; what is left over is 0."""
    image = np.zeros((height * width, 4), np.uint8)
    image[: len(codes), : codes.shape[1]] = codes
    if codes.shape[1] == 3:
        image[: len(codes), 3] = 255
    return image.reshape(height, width, 4)


def _check(cloud: GaussianCloud) -> None:
    """Refuse what no bundle can hold."""
    if not 1 <= len(cloud) <= MAX_SPLATS:
        raise CapabilityError(f"a SOG bundle holds 1 to {MAX_SPLATS} splats, the scene has {len(cloud)}")
    if cloud.sh_degree > 3:
        raise CapabilityError(f"a SOG bundle holds SH bands up to 3, the scene has {cloud.sh_degree}")
    for name in ("means", "quats", "sh0", "shN"):
        is_bad = ~np.isfinite(getattr(cloud, name)).reshape(len(cloud), -1).all(axis=1)
        if is_bad.any():
            raise CloudError(f"{int(is_bad.sum())} of {len(cloud)} splats are not finite; drop them first", field=name)
    for name, is_bad in (
        ("log_scales", np.isnan(cloud.log_scales).any(axis=1) | (cloud.log_scales > _MAX_LOG_SCALE).any(axis=1)),
        ("opacity_logits", np.isnan(cloud.opacity_logits)),
    ):
        if is_bad.any():
            message = f"{int(is_bad.sum())} of {len(cloud)} splats hold NaN or a scale beyond float32; drop them first"
            raise CloudError(message, field=name)
