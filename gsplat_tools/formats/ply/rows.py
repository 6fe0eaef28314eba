"""Rows of the vertex element as records, from a file, a stream or parsed text; safe to call from several threads."""

from __future__ import annotations

import io
import os
import threading
import warnings
from itertools import islice
from typing import Any, BinaryIO, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import CorruptDataError, GsplatWarning, TruncatedDataError
from gsplat_tools.formats._files import read_at
from gsplat_tools.formats._ply_header import PlyElement, PlyHeader, check_text_claim, element_offsets
from gsplat_tools.formats._stream import read_into

BLOCK_BYTES = 1 << 20
"""Bytes of rows a block: they stay in the second-level cache between the system call and the scatter."""


class Rows(Protocol):
    """Rows that can be asked for in blocks, in any order."""

    block_size: int

    def block(self, start: int, stop: int) -> NDArray[Any]:
        """Return rows as a structured array, valid until the same thread asks for the next block."""


class StreamRows:
    """Rows of a fixed size in a binary stream."""

    def __init__(self, stream: BinaryIO, element: PlyElement, offset: int) -> None:
        self._stream = stream
        self._element = element
        self._dtype = element.row_dtype
        self._offset = offset
        self.block_size = max(1, BLOCK_BYTES // self._dtype.itemsize)
        self._lock = threading.Lock()
        self._local = threading.local()
        # Only a plain file's descriptor is at the same bytes as the stream (gzip and zip members have descriptors too).
        is_file = isinstance(stream, io.BufferedReader | io.BufferedRandom) and isinstance(stream.raw, io.FileIO)
        self._file: int | None = None
        if is_file and hasattr(os, "preadv"):
            stream.flush()
            self._file = stream.fileno()

    def block(self, start: int, stop: int) -> NDArray[Any]:
        """Return rows as a structured array, valid until the same thread asks for the next block."""
        if not hasattr(self._local, "buffer"):
            # float32 makes the buffer aligned whatever the offset in the file is.
            self._local.buffer = np.empty(-(-self.block_size * self._dtype.itemsize // 4), np.float32)
        size = (stop - start) * self._dtype.itemsize
        buffer = self._local.buffer.view(np.uint8)[:size]
        offset = self._offset + start * self._dtype.itemsize
        if self._file is None:
            with self._lock:
                self._stream.seek(offset)
                read_into(self._stream, memoryview(buffer), field=self._element.name)
        else:
            self._read_file(self._file, memoryview(buffer), offset)
        return cast("NDArray[Any]", buffer.view(self._dtype))

    def _read_file(self, file: int, buffer: memoryview, offset: int) -> None:
        """Fill the buffer without moving the position that threads share."""
        done = 0
        while done < len(buffer):
            count = read_at(file, buffer[done:], offset + done)
            if count == 0:
                raise TruncatedDataError(
                    "the file became shorter while it was read", field=self._element.name, offset=offset + done
                )
            done += count


class ParsedRows:
    """Rows that were parsed into memory."""

    def __init__(self, records: NDArray[Any]) -> None:
        self._records = records
        self.block_size = max(1, BLOCK_BYTES // max(records.dtype.itemsize, 1))

    def block(self, start: int, stop: int) -> NDArray[Any]:
        """Return rows as a structured array."""
        return self._records[start:stop]


def open_rows(stream: BinaryIO, header: PlyHeader, vertex: PlyElement) -> Rows:
    """Return the rows of the vertex element, after holding all counts against the size of the file.

    Raises
    ------
    TruncatedDataError, CorruptDataError
        The header promises more or less than the file holds, or text is malformed.
    """
    if header.encoding == "ascii":
        check_text_claim(header, stream)
        records = _parse_plain_text(stream, header, vertex)
        return ParsedRows(_parse(stream, header, header.elements, header.size) if records is None else records)
    offset = element_offsets(header, stream)[vertex.name]
    if vertex.has_lists:
        return ParsedRows(_parse(stream, header, (vertex,), offset))
    return StreamRows(stream, vertex, offset)


def check_rows(stream: BinaryIO, header: PlyHeader) -> None:
    """Hold all counts against the size of the file, as far as that needs no parsing of text.

    Raises
    ------
    TruncatedDataError, CorruptDataError
        The header promises more or less than the file holds.
    """
    if header.encoding == "ascii":
        check_text_claim(header, stream)
    else:
        element_offsets(header, stream)


class _Joined(io.RawIOBase):
    """A header of ours followed by the stream from where it stands; closing it leaves the stream open."""

    def __init__(self, head: bytes, stream: BinaryIO) -> None:
        self._head = head
        self._stream = stream

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        part, self._head = self._head[: len(buffer)], self._head[len(buffer) :]
        if not part:
            part = self._stream.read(len(buffer))
        buffer[: len(part)] = part
        return len(part)


def _parse_plain_text(stream: BinaryIO, header: PlyHeader, vertex: PlyElement) -> NDArray[Any] | None:
    """Parse scalar rows that end the file, or return None for whatever needs plyfile: its dialects, or its error."""
    if vertex.count == 0 or vertex.has_lists or any(other.count for other in header.elements if other is not vertex):
        return None
    stream.seek(header.size)
    text = io.TextIOWrapper(io.BufferedReader(_Joined(b"", stream), 1 << 16), "ascii")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            records = np.loadtxt(islice(text, vertex.count), vertex.row_dtype, comments=None, ndmin=1)
            is_whole = len(records) == vertex.count and not text.read().strip() and _ends_a_line(stream)
    except (ValueError, OverflowError, Warning):
        return None
    return records if is_whole else None


def _parse(stream: BinaryIO, header: PlyHeader, elements: tuple[PlyElement, ...], offset: int) -> NDArray[Any]:
    """Let plyfile parse elements that start at an offset, and return the records of the vertex element."""
    import plyfile

    stream.seek(offset)
    joined = io.BufferedReader(_Joined(_declare(header, elements), stream), 1 << 16)
    source = io.TextIOWrapper(joined, "ascii") if header.encoding == "ascii" else joined
    try:
        with np.errstate(over="ignore"), warnings.catch_warnings():
            # 1e99 as float32 is infinite, which the filter of invalid splats counts.
            warnings.filterwarnings("ignore", "overflow encountered", RuntimeWarning)
            warnings.filterwarnings("ignore", "loadtxt: input contained no data", UserWarning)  # empty lists are legal
            parsed = plyfile.PlyData.read(source, mmap=False)
        rest = source.read() if header.encoding == "ascii" else ""
    except plyfile.PlyElementParseError as error:
        kind = TruncatedDataError if "end-of-file" in error.message else CorruptDataError
        place = "" if error.prop is None else f", property {error.prop.name}"
        raise kind(
            f"row {error.row} of {error.element.count}{place}: {error.message}", field=error.element.name, offset=offset
        ) from error
    except (plyfile.PlyParseError, ValueError, OverflowError) as error:
        raise CorruptDataError(f"the values cannot be read: {error}", offset=offset) from error
    if header.encoding == "ascii" and not _ends_a_line(stream):
        warnings.warn(
            GsplatWarning("the text ends without a line end: its last number may have been cut off", code="no-line-end"),
            stacklevel=6,
        )
    if rest.strip():
        raise CorruptDataError(
            f"{len(rest.strip())} bytes of text follow the last element, starting with {rest.split()[0][:20]!r}",
            field=header.elements[-1].name,
        )
    return cast("NDArray[Any]", parsed["vertex"].data)


def _ends_a_line(stream: BinaryIO) -> bool:
    """Whether the last byte ends a line."""
    stream.seek(-1, io.SEEK_END)
    return stream.read(1) in {b"\n", b"\r"}


def _declare(header: PlyHeader, elements: tuple[PlyElement, ...]) -> bytes:
    """Write the header of some of the elements in plain words."""
    lines = ["ply", f"format {header.encoding} 1.0"]
    for element in elements:
        lines.append(f"element {element.name} {element.count}")
        for prop in element.properties:
            kind = prop.dtype.name
            lines.append(
                f"property {kind} {prop.name}"
                if prop.count_dtype is None
                else f"property list {prop.count_dtype.name} {kind} {prop.name}"
            )
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
