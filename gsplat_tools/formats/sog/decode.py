"""Bundle to cloud."""

from __future__ import annotations

import warnings
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, GsplatWarning
from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats.sog.bundle import Bundle, check_indices, open_bundle
from gsplat_tools.formats.sog.lod import parse_lod, read_text
from gsplat_tools.formats.sog.options import SogReadOptions
from gsplat_tools.parallel import map_ordered

Float32 = NDArray[np.float32]


def read(stream: BinaryIO, options: SogReadOptions) -> GaussianCloud:
    """Read a .sog archive, a folder's meta.json, or one level of a lod-meta.json.

    Parameters
    ----------
    stream
        The archive, or the JSON file of a folder, opened by its name.
    options
        Which level of detail.

    Raises
    ------
    FormatError
        A rule of docs/formats/sog.md is broken.
    CapabilityError
        There is no such level.

    Warns
    -----
    GsplatWarning
        Labels beyond the palette, an unknown splat model, or an odd archive.
    """
    bundle, folder = open_bundle(stream)
    if bundle is not None:
        if options.lod > 0:
            raise CapabilityError(f"this scene has no levels of detail but 0, got lod={options.lod}")
        return decode(bundle)
    assert folder is not None
    return parse_lod(read_text(stream), folder).read(options.lod, decode)


def decode(bundle: Bundle) -> GaussianCloud:
    """Return the splats of a bundle.

    Raises
    ------
    FormatError
        An image is missing, of the wrong kind or size, or holds an index without an entry.
    """
    from gsplat_tools.codecs import quaternion_sog

    meta = bundle.meta
    warn(meta.issues)
    streams = ["means_l", "means_u", "scales", "quats", "sh0", *(["shN_labels"] if meta.has_rest else [])]
    codes = dict(zip(streams, map_ordered(bundle.codes, streams), strict=True))
    positions = codes["means_l"][:, :3] | codes["means_u"][:, :3].astype(np.uint16) << np.uint16(8)
    colors = codes["sh0"]
    return GaussianCloud(
        means=_positions(positions, bundle),
        log_scales=_look_up(meta.scales, codes["scales"][:, :3], bundle.path("scales")),
        quats=quaternion_sog.decode(codes["quats"]),
        opacity_logits=meta.opacities[colors[:, 3]],
        sh0=_look_up(meta.sh0, colors[:, :3], bundle.path("sh0")),
        shN=_rest(bundle, codes["shN_labels"]) if meta.has_rest else np.empty((meta.count, 0, 3), np.float32),
        splat_model=meta.splat_model,
    )


def _positions(codes: NDArray[np.integer[Any]], bundle: Bundle) -> Float32:
    """Return sign(n) (exp |n| - 1) of n = min + (max - min) q / 65535."""
    low, high = bundle.meta.means_low, bundle.meta.means_high
    span = np.where(high > low, high - low, 1.0)  # as other readers; a flat axis has q = 0
    logs = low + codes * (span / 65535)
    with np.errstate(over="ignore"):
        means: Float32 = np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32)
    return means


def _look_up(tables: Float32, codes: NDArray[np.uint8], path: str) -> Float32:
    """Return the value of each channel's byte in that channel's table."""
    check_indices(codes, tables.shape[1], path)
    return np.stack([table[codes[:, channel]] for channel, table in enumerate(tables)], axis=1)


def _rest(bundle: Bundle, pixels: NDArray[np.uint8]) -> Float32:
    """Return the SH coefficients of every splat, none where the label is beyond the palette."""
    palette = bundle.palette()
    labels = pixels[:, 0] | pixels[:, 1].astype(np.uint16) << np.uint16(8)
    is_beyond = labels >= len(palette)
    count = int(np.count_nonzero(is_beyond))
    if count == 0:
        return palette[labels]
    path = bundle.path("shN_labels")
    message = f"{count} of {len(labels)} labels lie beyond the {len(palette)} palette entries; those splats get no SH"
    warn([Issue(code="label-range", message=message, field=path, count=count)])
    rest = palette[np.where(is_beyond, 0, labels)]
    rest[is_beyond] = 0
    return rest


def warn(issues: list[Issue]) -> None:
    """Warn of what is less than an error."""
    for issue in issues:
        place = "" if issue.field is None else f"{issue.field}: "
        warnings.warn(GsplatWarning(place + issue.message, code=issue.code), stacklevel=4)
