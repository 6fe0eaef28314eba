"""Writing .gspk: frames are compressed side by side into a temporary file a stream, then put behind the description."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, BinaryIO, Literal

import numpy as np
import zstandard
from numpy.typing import NDArray

from gsplat_tools.errors import CloudError
from gsplat_tools.formats._files import Spool
from gsplat_tools.formats.pack.container import ALIGNMENT, DTYPES, HEADER, LAYOUTS, MAGIC, VERSION, StreamLayout
from gsplat_tools.parallel import map_ordered

FRAME_ROWS = 1 << 16
MAX_LEVEL = 22

Codec = Literal["zstd", "none"]
Buffer = bytes | memoryview
Rows = Mapping[str, NDArray[Any]]
"""The rows of some splats in every stream, by the stream's name."""


def write(
    stream: BinaryIO,
    layouts: Sequence[StreamLayout],
    rows: Iterable[Rows],
    describe: Callable[[], Mapping[str, Any]],
    *,
    count: int,
    codec: Codec,
    level: int,
) -> None:
    """Write a file.

    Parameters
    ----------
    stream
        Can seek; written from its start.
    layouts
        Streams in the order of the file, at least one.
    rows
        Rows of all streams, `count` over all items.
    describe
        Returns the description without `frame_rows` and `streams`; called after the last row has been taken.
    count
        Splats.
    codec, level
        How frames are stored.

    Raises
    ------
    CloudError
        The items do not hold `count` splats.
    """
    with ExitStack() as stack:
        files = [stack.enter_context(Spool()) for _ in layouts]
        lengths: list[list[int]] = [[] for _ in layouts]
        checksums: list[list[int]] = [[] for _ in layouts]
        pieces = ((index, data, codec, level) for index, data in _frames(layouts, rows, count))
        for index, stored, checksum in map_ordered(_store, pieces):
            files[index].write(stored)
            lengths[index].append(len(stored))
            checksums[index].append(checksum)
        entries: list[dict[str, Any]] = [
            {
                "name": layout.name,
                "dtype": layout.dtype,
                "shape": [count, *layout.columns],
                "offset": 0,
                "raw_length": count * layout.row_bytes,
                "stored_length": sum(lengths[index]),
                "codec": codec,
                "frames": lengths[index],
                "crc32": checksums[index],
            }
            for index, layout in enumerate(layouts)
        ]
        description = describe()
        text, end = _place({**description, "frame_rows": FRAME_ROWS, "streams": entries}, entries)
        layout_number = LAYOUTS.index(description["layout"])
        stream.write(HEADER.pack(MAGIC, VERSION, end, ALIGNMENT, len(text), zlib.crc32(text), layout_number, bytes(24)))
        stream.write(text)
        position = ALIGNMENT + len(text)
        for file, entry in zip(files, entries, strict=True):
            stream.write(bytes(entry["offset"] - position))
            stream.writelines(file.parts())
            position = entry["offset"] + entry["stored_length"]


def _place(description: Mapping[str, Any], entries: list[dict[str, Any]]) -> tuple[bytes, int]:
    """Set the offsets of the streams behind a description that holds those offsets; return its text and the file's end."""
    room = 0
    while True:
        end = position = ALIGNMENT + room
        for entry in entries:
            entry["offset"] = -(-position // ALIGNMENT) * ALIGNMENT
            end = position = entry["offset"] + entry["stored_length"]
        text = json.dumps(description, separators=(",", ":"), allow_nan=False).encode()
        if len(text) <= room:
            return text, end
        room = len(text)


def _frames(layouts: Sequence[StreamLayout], rows: Iterable[Rows], count: int) -> Iterator[tuple[int, list[NDArray[Any]]]]:
    """Cut rows into frames; yield the number of the stream and the pieces of one frame of it."""
    pending: list[Rows] = []
    held = total = 0
    for row in rows:
        size = len(row[layouts[0].name])
        total += size
        start = 0
        while held + size - start >= FRAME_ROWS:
            stop = start + FRAME_ROWS - held
            pending.append({name: values[start:stop] for name, values in row.items()})
            yield from _pieces(layouts, pending)
            pending, held, start = [], 0, stop
        if start < size:
            pending.append({name: values[start:] for name, values in row.items()})
            held += size - start
    if pending:
        yield from _pieces(layouts, pending)
    if total != count:
        raise CloudError(f"the scene announced {count} splats but its chunks hold {total}")


def _pieces(layouts: Sequence[StreamLayout], rows: list[Rows]) -> Iterator[tuple[int, list[NDArray[Any]]]]:
    """Yield the pieces of one frame of every stream."""
    for index, layout in enumerate(layouts):
        yield index, [np.ascontiguousarray(row[layout.name], DTYPES[layout.dtype]) for row in rows]


def _store(piece: tuple[int, list[NDArray[Any]], Codec, int]) -> tuple[int, Buffer, int]:
    """Return the number of the stream, the stored bytes of a frame and the checksum of its raw bytes."""
    index, arrays, codec, level = piece
    # One array, the common case, is taken as it lies in memory.
    raw = (arrays[0] if len(arrays) == 1 else np.concatenate(arrays)).reshape(-1).view(np.uint8).data
    checksum = zlib.crc32(raw)
    if codec == "none":
        return index, raw, checksum
    return index, zstandard.ZstdCompressor(level=level, write_checksum=False).compress(raw), checksum
