"""3DGS PLY: the vertex element holds a splat a row, in any dialect of PLY; written binary little-endian.

| property | attribute |
|---|---|
| x y z | means, world units, relative to `comment origin` |
| nx ny nz | nothing; zero in every 3DGS file, else kept as extras |
| f_dc_0..2 | sh0 |
| f_rest_0..n-1 | shN, channel-major: all red, all green, all blue; n = 0, 9, 24, 45, 72 for degree 0 to 4 |
| opacity | opacity_logits |
| scale_0..2 | log_scales; without scale_2 the splats are flat ("2dgs") |
| rot_0..3 | quats, w x y z |
| vx vy vz, time, duration | velocities, times, durations |

Source: Kerbl et al. 2023, `save_ply` of the 3DGS reference code; Turk 1994 for PLY. See docs/formats/ply.md.
"""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats._motion_repair import MotionRepair
from gsplat_tools.formats._ply_comments import splat_comments
from gsplat_tools.formats._ply_header import read_header
from gsplat_tools.formats.base import Bounds, FileInfo, Format, NoOptions
from gsplat_tools.formats.ply.layout import splat_layout
from gsplat_tools.formats.ply.motion import motion_boxes
from gsplat_tools.formats.ply.reading import ReadOptions, read, read_chunks
from gsplat_tools.formats.ply.rows import check_rows
from gsplat_tools.formats.ply.writing import write

__all__ = ["FORMAT", "ReadOptions", "inspect", "read", "read_chunks", "write"]


def matches(head: bytes) -> bool:
    """Whether a file that starts with these bytes is a PLY, and not the packed kind."""
    return re.match(rb"ply[ \t]*[\r\n]", head) is not None and b"\nelement chunk " not in head


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what the header says, after holding its counts against the size of the file.

    Where splats move, their positions and motion are read as well, for the bounds.

    Raises
    ------
    FormatError, TruncatedDataError, CorruptDataError
        As `read`, as far as the header tells.
    """
    header = read_header(stream)
    layout = splat_layout(header)
    check_rows(stream, header)
    comments = splat_comments(header, is_flat=layout.splat_columns[5] is None)
    x, y, z = map(float, comments.origin)
    box, motion_box = motion_boxes(stream, header, layout, comments)
    return FileInfo(
        version="1.0",
        splats=layout.vertex.count,
        sh_degree=layout.sh_degree,
        coordinate_system=comments.coordinate_system,
        origin=(x, y, z),
        splat_model=comments.splat_model,
        bounds=box,
        motion_bounds=motion_box,
        encoding={
            "encoding": header.encoding,
            "header_bytes": header.size,
            "row_bytes": None if header.encoding == "ascii" or layout.lists else layout.vertex.min_row_bytes,
            "properties": {
                prop.name: prop.dtype.name if prop.count_dtype is None else f"list {prop.dtype.name}"
                for prop in layout.vertex.properties
            },
            "has_motion": bool(layout.motion),
            "extras": list(layout.extras),
            "other_elements": {element.name: element.count for element in header.elements if element.name != "vertex"},
            "comments": list(header.comments),
        },
    )


def bounds(source: GaussianCloud, _stream: BinaryIO, _frame: int) -> Bounds:
    """Return zero for every attribute, since each float32 comes back with the same bits, but for times out of range.

    Those are brought into the range of their time model when the file is read.
    """
    limits: Bounds = {
        "means": np.zeros((1, 3)),
        "scales": np.zeros((1, 3)),
        "covariances": np.zeros(1),
        "opacities": np.zeros(1),
        "sh0": np.zeros((1, 3)),
        "shN": np.zeros((1, 1, 3)),
    }
    if source.has_motion:
        repaired = MotionRepair(source.time_model, len(source)).apply(source)
        limits["velocities"] = np.zeros((1, 3))
        limits |= {name: np.abs(getattr(source, name).astype(np.float64) - values) for name, values in repaired.items()}
    return limits


FORMAT = Format(
    id="ply",
    title="3DGS PLY",
    extensions=(".ply",),
    spec="docs/formats/ply.md",
    max_sh_degree=4,
    matches=matches,
    inspect=inspect,
    read=read,
    read_chunks=read_chunks,
    write=write,
    bounds=bounds,
    lossless=True,
    holds_motion=True,
    holds_extra=True,
    stores_origin=True,
    stores_coordinates=True,
    stores_splat_model=True,
    streams=True,
    read_options=ReadOptions,
    write_options=NoOptions,
)
