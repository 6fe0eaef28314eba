"""compressed.ply, the packed PLY of PlayCanvas: blocks of 256 splats with boxes, 16 bytes a splat and one an SH value.

| element | properties | meaning |
|---|---|---|
| chunk | min and max of x y z, scale_x.., r g b, float | box of 256 splats; in older files without colors |
| vertex | packed_position, packed_scale, uint | 11, 10, 11 bits in the box, x highest; scales are logarithms |
| vertex | packed_rotation, uint | index of the largest of w x y z, then 10 bits of each of the others |
| vertex | packed_color, uint | r g b in the box and opacity, 8 bits each, r highest |
| sh | f_rest_0.., uchar | 8 ((code + 1/2) / 256 - 1/2), exactly -4 and 4 at the ends, channel-major |

Source: playcanvas/splat-transform. See docs/formats/compressed-ply.md.
"""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges
from gsplat_tools.codecs.smallest_three import PACKED_PLY
from gsplat_tools.constants import SH_C0
from gsplat_tools.formats.base import Bounds, FileInfo, Format
from gsplat_tools.formats.compressed_ply.reading import BLOCK, check, open_packed, read, read_chunks
from gsplat_tools.formats.compressed_ply.rules import RULES
from gsplat_tools.formats.compressed_ply.writing import CompressedPlyOptions, write
from gsplat_tools.formats.knobs import Knob, general_knobs

__all__ = ["FORMAT", "CompressedPlyOptions", "bounds", "inspect", "matches", "read", "read_chunks", "write"]

MAX_LOG_SCALE = 20.0
_ROUNDING = 2.0**-22
"""Boxes and decoded values are rounded to float32: relative to the value."""


def matches(head: bytes) -> bool:
    """Whether a file that starts with these bytes is a PLY with chunks."""
    return re.match(rb"ply[ \t]*[\r\n]", head) is not None and b"\nelement chunk " in head


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what the header says, after holding its counts against the size of the file.

    Raises
    ------
    FormatError
        As `read`, as far as the header tells.
    """
    packed = open_packed(stream)
    x, y, z = map(float, packed.comments.origin)
    return FileInfo(
        version="1.0",
        splats=packed.vertex.count,
        sh_degree=packed.sh_degree,
        coordinate_system=packed.comments.coordinate_system,
        origin=(x, y, z),
        splat_model=packed.comments.splat_model,
        encoding={
            "encoding": packed.header.encoding,
            "header_bytes": packed.header.size,
            "chunks": packed.chunk.count,
            "has_color_bounds": packed.has_color_bounds,
            "row_bytes": packed.vertex.min_row_bytes + (packed.sh.min_row_bytes if packed.sh is not None else 0),
            "left_out": packed.left_out(),
            "comments": list(packed.header.comments),
        },
    )


def bounds(source: GaussianCloud, _stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that the encoding allows; the boxes are those of every 256 splats of `source`."""
    log_scales = source.log_scales.astype(np.float64)
    clamped = np.clip(log_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE)
    # Relabelled axes may bring any scale of a block into any column, so that the box of all three counts.
    extents = _extents(clamped).max(axis=1, keepdims=True), _extents(-clamped).max(axis=1, keepdims=True)
    half_scale = (extents[0] + extents[1]) / 2046 + _ROUNDING * MAX_LOG_SCALE
    low, high = np.maximum(clamped - half_scale, -MAX_LOG_SCALE), np.minimum(clamped + half_scale, MAX_LOG_SCALE)
    colors = source.sh0.astype(np.float64) * SH_C0 + 0.5
    sorted_scales = np.sort(log_scales, axis=1)
    limits: Bounds = {
        "means": _half_steps(source.means.astype(np.float64), np.array([2047.0, 1023.0, 2047.0])),
        "scales": half_scale + np.abs(sorted_scales - np.clip(sorted_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE)),
        "covariances": covariance_bound_of_ranges(log_scales, low, high, PACKED_PLY.max_angle + 2.0**-20) * (1 + _ROUNDING)
        + _ROUNDING,
        "opacities": np.array([0.5 / 255 + _ROUNDING]),
        "sh0": _half_steps(colors, np.full(3, 255.0)) / SH_C0 + _ROUNDING * (2 + np.abs(source.sh0)),
    }
    if source.sh_degree:
        sizes = np.abs(source.shN.astype(np.float64))
        # The ends are 1.5 of the usual steps away from their neighbors.
        limits["shN"] = np.where(sizes > 4 - 1.5 / 32, 0.75 / 32, 0.5 / 32) + np.maximum(sizes - 4, 0.0) + _ROUNDING * sizes
    return limits


def _extents(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for every splat the largest value of each column in its block."""
    starts = np.arange(0, len(values), BLOCK)
    if not len(starts):
        return values
    return np.asarray(np.repeat(np.maximum.reduceat(values, starts, axis=0), BLOCK, axis=0)[: len(values)])


def _half_steps(values: NDArray[np.float64], levels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half a step of the box of every splat's block, and the rounding of its ends."""
    return np.asarray((_extents(values) + _extents(-values)) / (2 * levels) + _ROUNDING * _extents(np.abs(values)))


FORMAT = Format(
    id="compressed-ply",
    title="compressed PLY (.compressed.ply)",
    extensions=(".compressed.ply",),
    spec="docs/formats/compressed-ply.md",
    max_sh_degree=3,
    matches=matches,
    inspect=inspect,
    read=read,
    read_chunks=read_chunks,
    write=write,
    bounds=bounds,
    check=check,
    rules=RULES,
    stores_coordinates=True,
    stores_splat_model=True,
    order="morton",
    position_type="fixed",
    write_options=CompressedPlyOptions,
    presets={"fast": {"rotation": "reference"}, "balanced": {}, "best": {}, "exact": {}},
    knobs={**general_knobs(3), "rotation": Knob(values=("small", "best"), stream="rotations")},
    model=("inria", None),
)
