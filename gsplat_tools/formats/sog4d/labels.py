"""Labels of a segment as changes: the delta-v1 file, under the magic of this format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from gsplat_tools.formats import _label_delta
from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats._label_delta import UPDATE, DeltaSegment, Labels, changes
from gsplat_tools.formats.sog4d.meta import Segment

MAGIC = b"SOG4DLB1"

__all__ = ["MAGIC", "Labels", "changes", "most_bytes", "moved_delta", "read_delta", "write_delta"]


def write_delta(segment: tuple[int, int], splat_count: int, label_count: int, blocks: Sequence[NDArray[Any]]) -> bytes:
    """Return the delta file of a segment (start, number of frames)."""
    described = DeltaSegment(
        field="", start_frame=segment[0], frame_count=segment[1], splat_count=splat_count, label_count=label_count
    )
    return _label_delta.write_delta(described, blocks, magic=MAGIC)


def moved_delta(data: bytes, start: int) -> bytes:
    """Return a delta file of ours as if its segment started at another frame."""
    return data[:12] + start.to_bytes(4, "little") + data[16:]


def most_bytes(segment: Segment, splat_count: int) -> int:
    """Return the largest size of a delta file: every splat changes in every frame; and some, to say what follows."""
    return 1024 + segment.frame_count * (4 + splat_count * UPDATE.itemsize)


def read_delta(data: bytes, segment: Segment, splat_count: int, label_count: int) -> tuple[list[NDArray[Any]], list[Issue]]:
    """Return the blocks of a delta file as far as they can be told apart, and everything that is wrong with it."""
    field = segment.delta_path
    if not data.startswith(MAGIC) and not MAGIC.startswith(data):
        return [], [Issue(code="delta-magic", message=f"expected {MAGIC!r}, found {data[:8]!r}", field=field, offset=0)]
    described = DeltaSegment(
        field=field,
        start_frame=segment.start_frame,
        frame_count=segment.frame_count,
        splat_count=splat_count,
        label_count=label_count,
    )
    return _label_delta.read_delta(data, described)
