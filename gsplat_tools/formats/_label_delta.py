"""SH labels as changes from frame to frame: the delta-v1 block that .sog4d and .splat4d share.

| bytes | field |
|---|---|
| 0-7 | magic, "SOG4DLB1" or "SPL4DLB1" |
| 8-11 | u32 version, 1 |
| 12-27 | u32 segmentStartFrame, segmentFrameCount, splatCount, labelCount |
| then, for every later frame | u32 updateCount; updateCount times u32 splatId, u16 newLabel, u16 0; splatId rising |

Source: .sog4d specification of raiscui/gsplat-unity.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import TruncatedDataError, UnsupportedVersionError
from gsplat_tools.formats._issues import Issue, Rule

Labels = NDArray[np.uint16]

MAGICS = (b"SOG4DLB1", b"SPL4DLB1")
HEADER = struct.Struct("<8s5I")
UPDATE = np.dtype([("splat", "<u4"), ("label", "<u2"), ("reserved", "<u2")])
"""One change of a label."""

_HEADER_FIELDS = ("segmentStartFrame", "segmentFrameCount", "splatCount", "labelCount")

RULES: dict[str, Rule] = {
    "delta-magic": Rule(severity="error", meaning="a label delta starts with its magic"),
    "delta-version": Rule(severity="error", meaning="the version of a label delta is 1", error=UnsupportedVersionError),
    "delta-header": Rule(severity="error", meaning="the header of a label delta repeats what the file says of the segment"),
    "delta-truncated": Rule(severity="error", meaning="a label delta has a block for every frame", error=TruncatedDataError),
    "delta-count": Rule(severity="error", meaning="a frame changes at most every label"),
    "delta-splat": Rule(severity="error", meaning="a change names a splat that there is"),
    "delta-order": Rule(severity="error", meaning="changes of a frame name splats in rising order"),
    "delta-label": Rule(severity="error", meaning="a change gives a label that there is"),
    "delta-reserved": Rule(severity="error", meaning="reserved bytes of a change are 0"),
    "delta-trailing": Rule(severity="error", meaning="nothing follows the last block"),
}
"""What a label delta has to keep."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeltaSegment:
    """What a file says about a segment.

    Parameters
    ----------
    field
        Name of the delta for messages.
    start_frame, frame_count
        First frame, whose labels are stored whole, and number of frames.
    splat_count, label_count
        Splats, and entries of the palette.
    """

    field: str
    start_frame: int
    frame_count: int
    splat_count: int
    label_count: int


def changes(before: Labels, after: Labels) -> NDArray[Any]:
    """Return the updates that turn the labels of one frame into those of the next, by rising splat."""
    splats = np.flatnonzero(before != after)
    updates = np.zeros(len(splats), UPDATE)
    updates["splat"] = splats
    updates["label"] = after[splats]
    return updates


def write_delta(segment: DeltaSegment, blocks: Sequence[NDArray[Any]], *, magic: bytes) -> bytes:
    """Return a delta whose blocks lead from the first frame of a segment through the later ones."""
    header = HEADER.pack(magic, 1, segment.start_frame, segment.frame_count, segment.splat_count, segment.label_count)
    return header + b"".join(struct.pack("<I", len(block)) + block.astype(UPDATE).tobytes() for block in blocks)


def read_delta(data: bytes, segment: DeltaSegment) -> tuple[list[NDArray[Any]], list[Issue]]:
    """Return the blocks of a delta as far as they can be told apart, and everything that is wrong with it."""
    field, start = segment.field, segment.start_frame
    if len(data) < HEADER.size:
        message = f"expected a header of {HEADER.size} bytes, found {len(data)}"
        return [], [Issue(code="delta-truncated", message=message, field=field, offset=len(data), frame=start)]
    magic, version, *found = HEADER.unpack_from(data)
    if magic not in MAGICS:
        message = f"expected {' or '.join(repr(known) for known in MAGICS)}, found {magic!r}"
        return [], [Issue(code="delta-magic", message=message, field=field, offset=0)]
    if version != 1:
        message = f"expected version 1, found {version}"
        return [], [Issue(code="delta-version", message=message, field=field, offset=8, value=version)]
    expected = (start, segment.frame_count, segment.splat_count, segment.label_count)
    issues = [
        Issue(code="delta-header", message=f"expected {name} {want}, found {got}", field=field, offset=12 + 4 * i, value=got)
        for i, (name, want, got) in enumerate(zip(_HEADER_FIELDS, expected, found, strict=True))
        if want != got
    ]
    return ([], issues) if issues else _read_blocks(data, segment)


def _read_blocks(data: bytes, segment: DeltaSegment) -> tuple[list[NDArray[Any]], list[Issue]]:
    """Return the blocks behind a header that is right, and what is wrong with them."""
    field, issues = segment.field, list[Issue]()
    blocks: list[NDArray[Any]] = []
    position = HEADER.size
    for frame in range(segment.start_frame + 1, segment.start_frame + segment.frame_count):
        if position + 4 > len(data):
            message = f"expected a block for frame {frame}, found the end of the delta"
            issues.append(Issue(code="delta-truncated", message=message, field=field, offset=position, frame=frame))
            return blocks, issues
        (count,) = struct.unpack_from("<I", data, position)
        if count > segment.splat_count:
            message = f"expected at most {segment.splat_count} updates, found {count}"
            issues.append(Issue(code="delta-count", message=message, field=field, offset=position, frame=frame, value=count))
            return blocks, issues
        if position + 4 + count * UPDATE.itemsize > len(data):
            message = f"expected {count} updates of {UPDATE.itemsize} bytes, found {len(data) - position - 4} bytes"
            issues.append(Issue(code="delta-truncated", message=message, field=field, offset=position, frame=frame))
            return blocks, issues
        block = np.frombuffer(data, UPDATE, count, position + 4)
        issues.extend(_check_block(block, segment, frame, position + 4))
        blocks.append(block)
        position += 4 + count * UPDATE.itemsize
    if position < len(data):
        message = f"expected the end after the last block, found {len(data) - position} more bytes"
        issues.append(Issue(code="delta-trailing", message=message, field=field, offset=position))
    return blocks, issues


def _check_block(block: NDArray[Any], segment: DeltaSegment, frame: int, offset: int) -> list[Issue]:
    """Return what is wrong with the updates of one frame, one issue a rule."""
    splats, labels = block["splat"], block["label"]
    falls = np.zeros(len(block), np.bool_)
    falls[1:] = splats[1:] <= splats[:-1]
    checks = (
        ("delta-splat", splats >= segment.splat_count, splats, f"a splatId below {segment.splat_count}"),
        ("delta-order", falls, splats, "a splatId above the one before"),
        ("delta-label", labels >= segment.label_count, labels, f"a label below {segment.label_count}"),
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
                    field=segment.field,
                    frame=frame,
                    splat=int(splats[first]),
                    value=int(values[first]),
                    offset=offset + first * UPDATE.itemsize,
                    count=int(np.count_nonzero(is_bad)),
                )
            )
    return issues
