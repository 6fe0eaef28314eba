"""The bytes of .gspk: header, JSON description, and streams in independent frames of rows (docs/formats/gspk.md)."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from gsplat_tools.errors import CorruptDataError, LimitExceededError, TruncatedDataError, UnsupportedVersionError
from gsplat_tools.formats import _json
from gsplat_tools.formats._limits import check_claim
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.pack.json_fields import whole

MAGIC = b"GSPK"
VERSION = 1
LAYOUTS = ("spark", "uncompressed")
"""Layouts by the number that the header holds."""

ALIGNMENT = 64

HEADER = struct.Struct("<4sIQQQII24s")
assert HEADER.size == ALIGNMENT
DTYPES = {"f32": np.dtype("<f4"), "u32": np.dtype("<u4")}


@dataclass(frozen=True, slots=True)
class StreamLayout:
    """What a stream holds, but for the number of rows.

    Parameters
    ----------
    name
        Name in the description.
    dtype
        "f32" or "u32".
    columns
        Shape of one row.
    """

    name: str
    dtype: str
    columns: tuple[int, ...]

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return DTYPES[self.dtype].itemsize * math.prod(self.columns)


@dataclass(frozen=True, slots=True)
class Stream:
    """A stream of a file, checked against its size.

    Parameters
    ----------
    layout
        What it holds.
    offset, stored_length, codec
        Where it is, and how it is stored.
    starts
        Offset in the file of every frame, and of the end.
    checksums
        CRC-32 of the raw bytes of every frame.
    """

    layout: StreamLayout
    offset: int
    stored_length: int
    codec: str
    starts: tuple[int, ...]
    checksums: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Container:
    """The description of a file, checked.

    Parameters
    ----------
    description
        The JSON object.
    count, frame_rows
        Splats, and splats a frame.
    streams
        The known streams by name.
    size
        Length of the file.
    """

    description: Mapping[str, Any]
    count: int
    frame_rows: int
    streams: Mapping[str, Stream]
    size: int

    def frames(self) -> list[tuple[int, int]]:
        """Return (start, stop) of the splats of every frame."""
        return [(start, min(start + self.frame_rows, self.count)) for start in range(0, self.count, self.frame_rows)]


def parse(stream: BinaryIO, layouts_of: Callable[[Mapping[str, Any]], Sequence[StreamLayout]]) -> Container:
    """Read and check everything but the data.

    Parameters
    ----------
    stream
        Can seek; the file starts at 0.
    layouts_of
        Function from a checked description to the streams that it must have.

    Raises
    ------
    UnsupportedVersionError, TruncatedDataError, CorruptDataError, LimitExceededError
        The header, the description and the size of the file do not agree, or claim too much.
    """
    size = stream_size(stream)
    stream.seek(0)
    header = read_exactly(stream, HEADER.size, field="header")
    magic, version, length, json_offset, json_length, checksum, layout, reserved = HEADER.unpack(header)
    if magic != MAGIC:
        raise CorruptDataError(f"expected {MAGIC!r}, found {magic!r}", field="magic", offset=0)
    if version != VERSION:
        raise UnsupportedVersionError(
            f"version {version} is not known; this reader knows version {VERSION}", field="version", offset=4
        )
    if length > size:
        raise TruncatedDataError(f"the header says {length} bytes but the file has {size}", field="file_length", offset=8)
    if length < size:
        raise CorruptDataError(f"the header says {length} bytes but the file has {size}", field="file_length", offset=8)
    if any(reserved):
        raise CorruptDataError("expected zeros; a later version may use them", field="reserved", offset=40)
    if not HEADER.size <= json_offset <= size or json_length > size - min(json_offset, size):
        raise CorruptDataError(
            f"{json_length} bytes at {json_offset} are not in a file of {size}", field="json_offset", offset=16
        )
    if json_length > _json.longest(0):
        raise LimitExceededError(f"{json_length} bytes are more than {_json.longest(0)}", field="json_length", offset=24)
    stream.seek(json_offset)
    text = read_exactly(stream, json_length, field="description")
    if zlib.crc32(text) != checksum:
        raise CorruptDataError("the checksum of the description differs", field="json_crc32", offset=32)
    description = _parse_json(text, json_offset)
    if layout >= len(LAYOUTS) or description.get("layout") != LAYOUTS[layout]:
        raise CorruptDataError(
            f"the header says layout {layout}, the description {_json.shown(description.get('layout'))}",
            field="layout",
            offset=36,
        )
    count = whole(description, "count")
    frame_rows = whole(description, "frame_rows", low=1)
    streams = _check_streams(description, layouts_of(description), count, frame_rows, size)
    _check_overlaps(streams.values(), json_offset, json_length)
    return Container(description, count, frame_rows, streams, size)


def _parse_json(text: bytes, offset: int) -> dict[str, Any]:
    """Return the object that a description is."""

    def refuse(name: str) -> float:
        raise CorruptDataError(f"{name} is not a JSON number", field="description", offset=offset)

    try:
        description = _json.parse(text, parse_constant=refuse)
    except CorruptDataError:
        raise
    except ValueError as error:
        raise CorruptDataError(f"not JSON: {error}", field="description", offset=offset) from error
    if not isinstance(description, dict):
        raise CorruptDataError(f"expected an object, found {type(description).__name__}", field="description", offset=offset)
    return description


def _check_streams(
    description: Mapping[str, Any], layouts: Sequence[StreamLayout], count: int, frame_rows: int, size: int
) -> dict[str, Stream]:
    """Return the streams that must be there; unknown ones are ignored."""
    entries = description.get("streams")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CorruptDataError("expected an array of objects", field="streams")
    by_name: dict[Any, dict[str, Any]] = {}
    for entry in entries:
        name = entry.get("name")
        if not isinstance(name, str) or name in by_name:
            raise CorruptDataError(f"expected a name of its own, found {_json.shown(name)}", field="streams")
        by_name[name] = entry
    check_claim(sum(count * layout.row_bytes for layout in layouts), size, field="count")
    streams = {}
    for layout in layouts:
        if layout.name not in by_name:
            raise CorruptDataError("the stream is missing", field=f"streams.{layout.name}")
        streams[layout.name] = _check_stream(by_name[layout.name], layout, count, frame_rows, size)
    return streams


def _check_stream(entry: Mapping[str, Any], layout: StreamLayout, count: int, frame_rows: int, size: int) -> Stream:
    """Return a stream after holding its entry against the layout and the file."""
    where = f"streams.{layout.name}."
    for key, expected in (
        ("dtype", layout.dtype),
        ("shape", [count, *layout.columns]),
        ("raw_length", count * layout.row_bytes),
    ):
        if entry.get(key) != expected:
            raise CorruptDataError(f"expected {expected!r}, found {_json.shown(entry.get(key))}", field=f"{where}{key}")
    codec = entry.get("codec")
    if codec not in ("zstd", "none"):
        raise CorruptDataError(f"expected 'zstd' or 'none', found {_json.shown(codec)}", field=f"{where}codec")
    offset = whole(entry, "offset", low=ALIGNMENT, where=where)
    stored = whole(entry, "stored_length", where=where)
    if offset % ALIGNMENT:
        raise CorruptDataError(f"expected a multiple of {ALIGNMENT}, found {offset}", field=f"{where}offset")
    if offset + stored > size and stored:
        raise TruncatedDataError(f"{stored} bytes at {offset} are not in a file of {size}", field=f"{where}offset")
    num_frames = -(-count // frame_rows)
    lists = {key: entry.get(key) for key in ("frames", "crc32")}
    for key, values in lists.items():
        if not isinstance(values, list) or len(values) != num_frames:
            raise CorruptDataError(f"expected {num_frames} numbers, one a frame", field=f"{where}{key}")
        for value in values:
            if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= size + (1 << 32):
                raise CorruptDataError(f"expected a whole number, found {_json.shown(value)}", field=f"{where}{key}")
    starts = [offset]
    for index, value in enumerate(lists["frames"] or []):
        raw = (min(count, (index + 1) * frame_rows) - index * frame_rows) * layout.row_bytes
        if codec == "none" and value != raw:
            raise CorruptDataError(f"frame {index} has {value} bytes stored, expected {raw}", field=f"{where}frames")
        starts.append(starts[-1] + value)
    if starts[-1] != offset + stored:
        raise CorruptDataError(
            f"the frames have {starts[-1] - offset} bytes together, stored_length says {stored}", field=f"{where}frames"
        )
    return Stream(layout, offset, stored, codec, tuple(starts), tuple(lists["crc32"] or []))


def _check_overlaps(streams: Iterable[Stream], json_offset: int, json_length: int) -> None:
    """Refuse parts that share bytes."""
    parts = [(json_offset, json_length, "description")]
    parts += [(stream.offset, stream.stored_length, f"streams.{stream.layout.name}") for stream in streams]
    parts = sorted(part for part in parts if part[1])
    for (offset, length, name), (following, _, other) in pairwise(parts):
        if offset + length > following:
            raise CorruptDataError(f"overlaps {name}", field=other, offset=following)


def read_frame(stream: BinaryIO, container: Container, index: int) -> dict[str, bytes]:
    """Return the stored bytes of frame `index` of every stream.

    Raises
    ------
    TruncatedDataError
        The file has become shorter.
    """
    stored = {}
    for name, entry in container.streams.items():
        stream.seek(entry.starts[index])
        stored[name] = read_exactly(stream, entry.starts[index + 1] - entry.starts[index], field=f"streams.{name}")
    return stored


def decode_frame(container: Container, index: int, stored: Mapping[str, bytes]) -> dict[str, NDArray[Any]]:
    """Return the rows of frame `index` of every stream.

    Raises
    ------
    CorruptDataError
        A frame does not decompress to the rows that it should hold, or its checksum differs.
    """
    start, stop = index * container.frame_rows, min((index + 1) * container.frame_rows, container.count)
    arrays = {}
    for name, entry in container.streams.items():
        place: dict[str, Any] = {"field": f"streams.{name}", "offset": entry.starts[index]}
        size = (stop - start) * entry.layout.row_bytes
        raw = stored[name] if entry.codec == "none" else _decompress(stored[name], size, place)
        if zlib.crc32(raw) != entry.checksums[index]:
            raise CorruptDataError(f"the checksum of frame {index} differs", **place)
        arrays[name] = np.frombuffer(raw, DTYPES[entry.layout.dtype]).reshape(stop - start, *entry.layout.columns)
    return arrays


def _decompress(data: bytes, size: int, place: Mapping[str, Any]) -> bytes:
    """Return the `size` raw bytes of one Zstandard frame."""
    try:
        # The decoder allocates what the frame says, so that this is looked at first.
        found = zstandard.get_frame_parameters(data).content_size
        if found != size:
            raise CorruptDataError(f"the frame says that it holds {found} bytes, expected {size}", **place)
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CorruptDataError(f"the frame does not decompress: {error}", **place) from error
