"""Labels as images and as changes: 16-bit numbers in two channels, and the delta-v1 file."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats.sog4d.meta import Segment

Labels = NDArray[np.uint16]

MAGIC = b"SOG4DLB1"
_HEADER = struct.Struct("<8s5I")
UPDATE = np.dtype([("splat", "<u4"), ("label", "<u2"), ("reserved", "<u2")])
"""One change of a label."""

_HEADER_FIELDS = ("segmentStartFrame", "segmentFrameCount", "splatCount", "labelCount")


def changes(before: Labels, after: Labels) -> NDArray[Any]:
    """Return the updates that turn the labels of one frame into those of the next, by rising splat."""
    splats = np.flatnonzero(before != after)
    updates = np.zeros(len(splats), UPDATE)
    updates["splat"] = splats
    updates["label"] = after[splats]
    return updates


def write_delta(segment_start: int, splat_count: int, label_count: int, blocks: Sequence[NDArray[Any]]) -> bytes:
    """Return a delta file whose blocks lead from the first frame of a segment through the later ones."""
    header = _HEADER.pack(MAGIC, 1, segment_start, len(blocks) + 1, splat_count, label_count)
    return header + b"".join(struct.pack("<I", len(block)) + block.astype(UPDATE).tobytes() for block in blocks)


def read_delta(data: bytes, segment: Segment, splat_count: int, label_count: int) -> tuple[list[NDArray[Any]], list[Issue]]:
    """Return the blocks of a delta file as far as they can be told apart, and everything that is wrong with it.

    Parameters
    ----------
    data
        The file.
    segment, splat_count, label_count
        What meta.json says about it.
    """
    field = segment.delta_path
    if len(data) < _HEADER.size:
        message = f"expected a header of {_HEADER.size} bytes, found {len(data)}"
        if not data.startswith(MAGIC[: len(data)]):
            return [], [Issue(code="delta-magic", message=f"expected {MAGIC!r}, found {data[:8]!r}", field=field, offset=0)]
        return [], [Issue(code="delta-truncated", message=message, field=field, offset=len(data), frame=segment.start_frame)]
    magic, version, *found = _HEADER.unpack_from(data)
    if magic != MAGIC:
        return [], [Issue(code="delta-magic", message=f"expected {MAGIC!r}, found {magic!r}", field=field, offset=0)]
    if version != 1:
        message = f"expected version 1, found {version}"
        return [], [Issue(code="delta-version", message=message, field=field, offset=8, value=version)]
    expected = (segment.start_frame, segment.frame_count, splat_count, label_count)
    issues = [
        Issue(code="delta-header", message=f"expected {name} {want}, found {got}", field=field, offset=12 + 4 * i, value=got)
        for i, (name, want, got) in enumerate(zip(_HEADER_FIELDS, expected, found, strict=True))
        if want != got
    ]
    if issues:
        return [], issues
    blocks: list[NDArray[Any]] = []
    position = _HEADER.size
    for frame in range(segment.start_frame + 1, segment.start_frame + segment.frame_count):
        if position + 4 > len(data):
            message = f"expected a block for frame {frame}, found the end of the file"
            issues.append(Issue(code="delta-truncated", message=message, field=field, offset=position, frame=frame))
            return blocks, issues
        (count,) = struct.unpack_from("<I", data, position)
        if count > splat_count:
            message = f"expected at most {splat_count} updates, found {count}"
            issues.append(Issue(code="delta-count", message=message, field=field, offset=position, frame=frame, value=count))
            return blocks, issues
        if position + 4 + count * UPDATE.itemsize > len(data):
            message = f"expected {count} updates of {UPDATE.itemsize} bytes, found {len(data) - position - 4} bytes"
            issues.append(Issue(code="delta-truncated", message=message, field=field, offset=position, frame=frame))
            return blocks, issues
        block = np.frombuffer(data, UPDATE, count, position + 4)
        issues.extend(_check_block(block, field, frame, position + 4, splat_count, label_count))
        blocks.append(block)
        position += 4 + count * UPDATE.itemsize
    if position < len(data):
        message = f"expected the end of the file after the last block, found {len(data) - position} more bytes"
        issues.append(Issue(code="delta-trailing", message=message, field=field, offset=position))
    return blocks, issues


def _check_block(block: NDArray[Any], field: str, frame: int, offset: int, splat_count: int, label_count: int) -> list[Issue]:
    """Return what is wrong with the updates of one frame, one issue a rule."""
    splats, labels = block["splat"], block["label"]
    falls = np.zeros(len(block), np.bool_)
    falls[1:] = splats[1:] <= splats[:-1]
    checks = (
        ("delta-splat", splats >= splat_count, splats, f"a splatId below {splat_count}"),
        ("delta-order", falls, splats, "a splatId above the one before"),
        ("delta-label", labels >= label_count, labels, f"a label below {label_count}"),
        ("delta-reserved", block["reserved"] != 0, block["reserved"], "two bytes of 0"),
    )
    issues = []
    for code, is_bad, values, rule in checks:
        if is_bad.any():
            first = int(np.argmax(is_bad))
            issues.append(
                Issue(
                    code=code,
                    message=f"expected {rule}, found {values[first]}",
                    field=field,
                    frame=frame,
                    splat=int(splats[first]),
                    value=int(values[first]),
                    offset=offset + first * UPDATE.itemsize,
                    count=int(np.count_nonzero(is_bad)),
                )
            )
    return issues
