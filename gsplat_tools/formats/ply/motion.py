"""Bounds of a PLY whose splats move, from the columns of position and motion alone."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.motion import Box, MotionBox
from gsplat_tools.formats._ply_comments import SplatComments
from gsplat_tools.formats._ply_header import PlyHeader
from gsplat_tools.formats.ply.layout import MEANS, MOTION_DEFAULTS, SplatLayout
from gsplat_tools.formats.ply.rows import open_rows
from gsplat_tools.parallel import blocks


def motion_boxes(
    stream: BinaryIO, header: PlyHeader, layout: SplatLayout, comments: SplatComments
) -> tuple[Box | None, Box | None]:
    """Return the box of the positions, and the same grown by motion; (None, None) for a PLY without motion.

    Parameters
    ----------
    stream
        Can seek.
    header, layout, comments
        What the header says.

    Raises
    ------
    TruncatedDataError, CorruptDataError
        As `open_rows`.
    """
    if not layout.motion:
        return None, None
    time_model = comments.time_model or "window"
    tally = MotionBox(time_model, comments.temporal_cutoff)
    rows = open_rows(stream, header, layout.vertex)
    for start, stop in blocks(layout.vertex.count, rows.block_size):
        records = rows.block(start, stop)
        velocities = [_column(records, name, "velocities") for name in layout.motion["velocities"]]
        durations = _column(records, layout.motion["durations"][0], "durations")
        if time_model == "window":
            durations = np.clip(durations, 0, 1)
        means = np.stack([records[name].astype(np.float64) for name in MEANS], axis=1)
        tally.add(means, np.stack(velocities, axis=1), durations)
    return tally.box(comments.origin), tally.motion_box(comments.origin)


def _column(records: NDArray[Any], name: str | None, attribute: str) -> NDArray[np.float64]:
    """Return a column as float64, or its default where the file lacks it."""
    if name is None:
        return np.full(len(records), MOTION_DEFAULTS[attribute])
    return np.asarray(records[name], np.float64)
