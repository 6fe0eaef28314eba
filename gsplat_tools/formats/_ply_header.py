"""Headers of PLY files: what plyfile makes of them, located and held against the bytes that are there.

plyfile parses the dialects (type names, list properties, extra elements). It is given the header with every count set
to zero, so that nothing is allocated before the counts have been checked here.

Source: Turk 1994, The PLY Polygon File Format; the plyfile package for dialects.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any, BinaryIO, Literal

import numpy as np

from gsplat_tools.errors import CorruptDataError, LimitExceededError, TruncatedDataError
from gsplat_tools.formats._stream import read_exactly, stream_size

MAX_HEADER_BYTES = 1 << 20
"""A header that is longer is refused; a splat with 72 f_rest has about 3 kB."""

_FIRST_READ = 1 << 12
_LIST_READ = 1 << 20
_ROWS_TO_REPEAT = 128
"""Rows with lists of the same lengths after which more of them are looked for at once."""
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class PlyProperty:
    """A property as the header declares it.

    Parameters
    ----------
    name
        As in the file.
    dtype
        Of a value, in the byte order of the file (native for ASCII).
    count_dtype
        Of the length that stands before the values of a list; None for a scalar.
    """

    name: str
    dtype: np.dtype[Any]
    count_dtype: np.dtype[Any] | None = None


@dataclass(frozen=True)
class PlyElement:
    """An element as the header declares it.

    Parameters
    ----------
    name, count, properties
        As in the file.
    line_offset
        Byte offset of its line in the header.
    """

    name: str
    count: int
    properties: tuple[PlyProperty, ...]
    line_offset: int

    @cached_property
    def by_name(self) -> dict[str, PlyProperty]:
        """The properties by name."""
        return {prop.name: prop for prop in self.properties}

    @cached_property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(prop.count_dtype is not None for prop in self.properties)

    @cached_property
    def min_row_bytes(self) -> int:
        """Bytes of a binary row, with every list empty."""
        return sum((prop.count_dtype or prop.dtype).itemsize for prop in self.properties)

    @cached_property
    def row_dtype(self) -> np.dtype[Any]:
        """Packed record of a binary row; only without lists."""
        return np.dtype([(prop.name, prop.dtype) for prop in self.properties])

    def property_names(self) -> list[str]:
        """Return the names of all properties, lists included."""
        return [prop.name for prop in self.properties]


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """What the header says.

    Parameters
    ----------
    encoding
        "ascii", "binary_little_endian" or "binary_big_endian".
    elements, comments, obj_info
        In the order of the file; text without the keyword.
    size
        Bytes up to the first one after the line of end_header.
    """

    encoding: str
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    obj_info: tuple[str, ...]
    size: int

    def element(self, name: str) -> PlyElement | None:
        """Return the element of that name, or None."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(stream: BinaryIO) -> PlyHeader:
    """Read the header at the start of a stream; LF, CRLF and CR line ends are understood.

    Parameters
    ----------
    stream
        Can seek; left anywhere.

    Returns
    -------
    PlyHeader
        Counts are as declared, not yet held against the size of the file.

    Raises
    ------
    TruncatedDataError
        The stream ends inside the header.
    LimitExceededError
        There is no end_header within MAX_HEADER_BYTES.
    CorruptDataError
        A line that is not understood; the error gives its offset.
    """
    raw = _read_raw_header(stream)
    separator = b"\r" if re.match(rb"ply[ \t]*\r(?!\n)", raw) else b"\n"
    lines: list[bytes] = []
    offsets: list[int] = []
    comments: list[str] = []
    obj_info: list[str] = []
    counts: list[tuple[int, int]] = []
    offset = 0
    for raw_line in raw.split(separator):
        line = raw_line.strip()
        keyword, rest = (*line.split(None, 1), b"", b"")[:2]
        if keyword == b"comment":
            comments.append(rest.decode("utf-8", "replace").strip())
            line = b"comment"
        elif keyword == b"obj_info":
            obj_info.append(rest.decode("utf-8", "replace").strip())
            line = b"comment"  # plyfile allows obj_info only before the first element
        elif keyword == b"element":
            line, count = _without_count(line, offset)
            counts.append((count, offset))
        elif not line:
            line = b"comment"
        lines.append(line)
        offsets.append(offset)
        offset += len(raw_line) + len(separator)
        if line == b"end_header":
            break
    parsed = _parse(b"\n".join(lines) + b"\n", offsets)
    encoding = "ascii" if parsed.text else ("binary_little_endian" if parsed.byte_order == "<" else "binary_big_endian")
    elements = tuple(
        PlyElement(element.name, count, tuple(_property(prop, _BYTE_ORDERS[encoding]) for prop in element.properties), line)
        for element, (count, line) in zip(parsed.elements, counts, strict=True)
    )
    return PlyHeader(encoding, elements, tuple(comments), tuple(obj_info), len(raw))


def _read_raw_header(stream: BinaryIO) -> bytes:
    """Return the bytes up to and including the line of end_header."""
    stream.seek(0)
    head = b""
    while True:
        part = stream.read(max(_FIRST_READ, len(head)))
        head += part
        start = re.match(rb"ply[ \t]*(\r\n|\n|\r(?!\n))", head)
        if start is None:
            if len(head) < MAX_HEADER_BYTES and b"ply\r\n".startswith(head.rstrip(b" \t")):  # so far, so good
                if part:
                    continue
                where = f"the file ends after {len(head)} bytes, inside the PLY header" if head else "the file is empty"
                raise TruncatedDataError(f"{where}; get it again from where it came from", offset=len(head))
            raise CorruptDataError(f"expected a first line 'ply', found {head[:16]!r}", offset=0)
        end = rb"\r[ \t]*end_header[ \t]*\r" if start[1] == b"\r" else rb"\n[ \t]*end_header[ \t\r]*\n"
        match = re.search(end, head)
        if match is not None:
            return head[: match.end()]
        if len(head) >= MAX_HEADER_BYTES:
            raise LimitExceededError(
                f"no end_header within {MAX_HEADER_BYTES} bytes; headers of that size are refused", field="end_header"
            )
        if not part:
            raise TruncatedDataError(
                f"the file ends after {len(head)} bytes, before the end_header line", field="end_header", offset=len(head)
            )


def _without_count(line: bytes, offset: int) -> tuple[bytes, int]:
    """Return an element line with its count replaced by zero, and the count."""
    words = line.split()
    if len(words) != 3 or not re.fullmatch(rb"[0-9]{1,18}", words[2]):
        raise CorruptDataError(
            f"expected 'element NAME COUNT' with a count of at most 18 digits, found {line[:80].decode('ascii', 'replace')!r}",
            field="element",
            offset=offset,
        )
    return b"element " + words[1] + b" 0", int(words[2])


def _parse(text: bytes, offsets: list[int]) -> Any:
    """Let plyfile parse a header whose counts are zero."""
    import plyfile

    try:
        return plyfile.PlyData.read(io.BytesIO(text), mmap=False)
    except plyfile.PlyHeaderParseError as error:
        line = error.line if isinstance(error.line, int) else 1
        offset = offsets[min(line, len(offsets)) - 1]
        found = text.split(b"\n")[line - 1][:80].decode("ascii", "replace") if line <= len(offsets) else ""
        raise CorruptDataError(f"{error.message}, found {found!r}", field="header", offset=offset) from error
    except (plyfile.PlyParseError, ValueError) as error:  # names that repeat or are not ASCII
        raise CorruptDataError(f"the header is not understood: {error}", field="header", offset=0) from error


def _property(prop: Any, byte_order: str) -> PlyProperty:
    """Take over a property of plyfile."""
    import plyfile

    if isinstance(prop, plyfile.PlyListProperty):
        count_type, value_type = prop.list_dtype(byte_order)
        if np.dtype(count_type).kind == "f":
            raise CorruptDataError("the length of a list must be of an integer type", field=prop.name)
        return PlyProperty(prop.name, np.dtype(value_type), np.dtype(count_type))
    return PlyProperty(prop.name, np.dtype(prop.dtype(byte_order)))


def element_offsets(header: PlyHeader, stream: BinaryIO) -> dict[str, int]:
    """Return where the rows of each element of a binary file start, after checking that the file ends with the last.

    Parameters
    ----------
    header
        Of a binary file.
    stream
        Can seek; left anywhere. Elements with lists are walked through, others are skipped.

    Raises
    ------
    TruncatedDataError
        The header promises more bytes than there are.
    CorruptDataError
        There are bytes after the last element, or a list has a negative length.
    """
    size = stream_size(stream)
    offset = header.size
    offsets = {}
    for element in header.elements:
        offsets[element.name] = offset
        needed = element.count * element.min_row_bytes
        if needed > size - offset:
            at_least = "at least " if element.has_lists else ""
            raise TruncatedDataError(
                f"the header promises {element.count} rows of {at_least}{element.min_row_bytes} bytes ({needed} bytes), "
                f"but {size - offset} bytes remain; copy or download the file again",
                field=element.name,
                offset=offset,
            )
        offset = _end_of_lists(header, element, stream, offset, size) if element.has_lists else offset + needed
    if offset < size:
        raise CorruptDataError(
            f"{size - offset} bytes follow the last element; the header promises a file of {offset} bytes, found {size}; "
            "export it again, the header does not describe the data",
            offset=offset,
        )
    return offsets


def _end_of_lists(header: PlyHeader, element: PlyElement, stream: BinaryIO, offset: int, size: int) -> int:
    """Walk through an element with lists and return where it ends; rows with lists of the same lengths at once."""
    buffer, start = b"", offset
    byte_order: Literal["little", "big"] = "big" if header.encoding == "binary_big_endian" else "little"
    row, repeated, previous = 0, 0, [-1]
    while row < element.count:
        first, lengths = offset, []
        for prop in element.properties:
            if prop.count_dtype is None:
                offset += prop.dtype.itemsize
                continue
            width = prop.count_dtype.itemsize
            if not start <= offset <= start + len(buffer) - width:
                stream.seek(offset)
                buffer, start = read_exactly(stream, min(_LIST_READ, max(size - offset, width)), field=element.name), offset
            place = offset - start
            length = int.from_bytes(buffer[place : place + width], byte_order, signed=prop.count_dtype.kind == "i")
            if length < 0:
                raise CorruptDataError(f"row {row} has a list of length {length}", field=prop.name, offset=offset)
            lengths.append(length)
            offset += width + length * prop.dtype.itemsize
        if offset > size:
            raise TruncatedDataError(
                f"row {row} of {element.count} needs {offset - size} bytes more than the file has",
                field=element.name,
                offset=size,
            )
        row += 1
        repeated = repeated + 1 if lengths == previous else 0
        previous = lengths
        if repeated >= _ROWS_TO_REPEAT:
            # No more rows are looked at than were alike so far, so that what is in vain costs no more than what was not.
            alike = _rows_alike(element, lengths, buffer, first - start, min(repeated, element.count - row))
            offset += alike * (offset - first)
            row += alike
            repeated = repeated + alike if alike else 0
    return offset


def _rows_alike(element: PlyElement, lengths: list[int], buffer: bytes, place: int, most: int) -> int:
    """Return how many rows of the buffer that follow the one at `place` have lists as long as it, at most `most`."""
    counts: list[int] = []  # bytes of a row that say how long its lists are
    size, left = 0, iter(lengths)
    for prop in element.properties:
        if prop.count_dtype is not None:
            counts += range(size, size + prop.count_dtype.itemsize)
            size += prop.count_dtype.itemsize + next(left) * prop.dtype.itemsize
        else:
            size += prop.dtype.itemsize
    most = min(most, (len(buffer) - place) // size - 1)
    if place < 0 or most < 1:  # the first lists of the row are in the buffer before
        return 0
    rows = np.frombuffer(buffer, np.uint8, (most + 1) * size, place).reshape(most + 1, size)[:, counts]
    is_other = (rows[1:] != rows[0]).any(axis=1)
    return int(is_other.argmax()) if is_other.any() else most


def check_text_claim(header: PlyHeader, stream: BinaryIO) -> None:
    """Refuse counts of an ASCII file that its size cannot hold: a value takes at least a digit and a separator.

    Raises
    ------
    TruncatedDataError
        The header promises more values than there can be.
    """
    available = stream_size(stream) - header.size
    for element in header.elements:
        needed = element.count * max(2 * len(element.properties), 1) - 1
        if element.count and needed > available:
            raise TruncatedDataError(
                f"the header promises {element.count} rows of {len(element.properties)} values, at least {needed} bytes, "
                f"but {available} bytes remain; copy or download the file again",
                field=element.name,
                offset=header.size,
            )
        available -= needed + 1
