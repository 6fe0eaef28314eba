"""Version 4: a header in the clear, a table of contents, and one zstd frame an attribute."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable
from contextlib import ExitStack
from typing import BinaryIO, cast

import numpy as np
import zstandard

from gsplat_tools.errors import CorruptDataError, TruncatedDataError
from gsplat_tools.formats._files import Spool
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.spz.header import (
    FIRST_ZSTD_VERSION,
    HAS_EXTENSIONS,
    MAGIC,
    ZSTD_HEADER,
    Header,
    check_fields,
    check_version,
    parse_extensions,
)
from gsplat_tools.formats.spz.payload import Payload, allocate
from gsplat_tools.parallel import for_each

_ENTRY = struct.Struct("<QQ")
_READ_BYTES = 1 << 18

_LEVEL_OF_NOISE = 9
_REWARDING = ("alphas", "colors", "sh")
"""Attributes that get smaller above level 9 of zstd; up to level 12 the others take three times as long for nothing."""
_LEVEL_FOR_ALL = 12
_MAX_WINDOW, _ANY_WINDOW = 1 << 27, 1 << 25
"""Largest window of a frame, bytes: the decoder allocates it, so that short streams are allowed less."""


def read_header(stream: BinaryIO) -> tuple[Header, dict[str, tuple[int, int]]]:
    """Return the header, and (offset, length) of every attribute's compressed stream.

    Raises
    ------
    FormatError
        The header contradicts itself or the size of the file.
    """
    size = stream_size(stream)
    stream.seek(0)
    raw = read_exactly(stream, ZSTD_HEADER.size, field="header")
    magic, version, count, degree, bits, flags, num_streams, toc, _reserved = ZSTD_HEADER.unpack(raw)
    if magic != MAGIC:
        raise CorruptDataError(f"expected {MAGIC!r}, found {magic!r}", field="magic", offset=0)
    check_version(version, (FIRST_ZSTD_VERSION,), "uncompressed NGSP header")
    header = Header(version=version, num_splats=count, sh_degree=degree, fractional_bits=bits, flags=flags)
    check_fields(header, available=size)
    names = {name: width for name, width in header.attributes().items() if count * width}
    if num_streams != len(names):
        raise CorruptDataError(
            f"{count} splats of degree {degree} have {len(names)} streams, found {num_streams}", field="numStreams", offset=15
        )
    data = toc + num_streams * _ENTRY.size
    if toc < ZSTD_HEADER.size:
        raise CorruptDataError(f"expected at least {ZSTD_HEADER.size}, found {toc}", field="tocByteOffset", offset=16)
    if data > size:
        raise TruncatedDataError(f"the table of contents ends at {data}, the file at {size}", field="tocByteOffset", offset=16)
    if flags & HAS_EXTENSIONS:
        block = read_exactly(stream, toc - ZSTD_HEADER.size, field="extensions")
        header = Header(
            version=version,
            num_splats=count,
            sh_degree=degree,
            fractional_bits=bits,
            flags=flags,
            extensions=parse_extensions(block, ZSTD_HEADER.size),
        )
    stream.seek(toc)
    table = read_exactly(stream, num_streams * _ENTRY.size, field="table of contents")
    places = {}
    for index, (name, width) in enumerate(names.items()):
        stored, length = _ENTRY.unpack_from(table, index * _ENTRY.size)
        if length != count * width:
            raise CorruptDataError(
                f"{count} splats take {count * width} bytes, the table says {length}",
                field=name,
                offset=toc + index * _ENTRY.size,
            )
        places[name] = (data, stored)
        data += stored
    if data > size:
        raise TruncatedDataError(f"the streams end at {data}, the file at {size}", field="table of contents", offset=toc)
    if data < size:
        raise CorruptDataError(f"the streams end at {data}, the file at {size}", field="table of contents", offset=toc)
    return header, places


def read_payload(stream: BinaryIO, header: Header, places: dict[str, tuple[int, int]], *, in_memory: bool) -> Payload:
    """Return the bytes of every attribute, decompressed side by side.

    Raises
    ------
    CorruptDataError
        A stream does not decompress to the length that it must have.
    """
    payload = allocate(header, in_memory=in_memory)
    lock = threading.Lock()

    def decompress(name: str) -> None:
        offset, length = places[name]
        section = _Section(stream, offset, length, lock)
        buffer = payload[name].reshape(-1).data
        window = min(max(1 << len(buffer).bit_length(), _ANY_WINDOW), _MAX_WINDOW)
        decompressor = zstandard.ZstdDecompressor(max_window_size=window)
        try:
            with decompressor.stream_reader(cast("BinaryIO", section), read_across_frames=True, closefd=False) as reader:
                done = 0
                while done < len(buffer):
                    count = reader.readinto(buffer[done : done + _READ_BYTES])
                    if not count:
                        break
                    done += count
                is_longer = done == len(buffer) and bool(reader.read(1))
        except zstandard.ZstdError as error:
            raise CorruptDataError(f"the zstd stream does not decompress: {error}", field=name, offset=offset) from error
        if done < len(buffer) or is_longer:
            found = f"{done}" if done < len(buffer) else "more"
            raise CorruptDataError(f"the stream must hold {len(buffer)} bytes, found {found}", field=name, offset=offset)

    for_each(decompress, [name for name in payload if name in places])
    return payload


def _level_of(name: str, level: int) -> int:
    """Return the level for an attribute."""
    return level if name in _REWARDING or level > _LEVEL_FOR_ALL else min(level, _LEVEL_OF_NOISE)


class _Section:
    """Part of a file that threads read side by side."""

    def __init__(self, stream: BinaryIO, offset: int, length: int, lock: threading.Lock) -> None:
        self._stream, self._position, self._end, self._lock = stream, offset, offset + length, lock

    def read(self, size: int = -1) -> bytes:
        """Return up to `size` bytes."""
        left = self._end - self._position
        with self._lock:
            self._stream.seek(self._position)
            data = self._stream.read(left if size < 0 else min(size, left))
        self._position += len(data)
        return data


def write(stream: BinaryIO, header: Header, extensions: bytes, rows: Iterable[Payload], level: int) -> None:
    """Write a file; the rows of all splats come piece by piece, and only compressed bytes wait.

    Parameters
    ----------
    stream
        Written from its position on.
    header
        Of the file.
    extensions
        Its extension block.
    rows
        Bytes of the attributes, `num_splats` rows over all items.
    level
        Of zstd; up to 12 noisy attributes get 9 at most.
    """
    names = {name: width for name, width in header.attributes().items() if header.num_splats * width}
    with ExitStack() as stack:
        files = {name: stack.enter_context(Spool()) for name in names}
        compressors = {
            name: zstandard.ZstdCompressor(level=_level_of(name, level), write_checksum=True).compressobj(
                size=header.num_splats * width
            )
            for name, width in names.items()
        }
        # The longest first, so that threads end together.
        by_length = sorted(names, key=lambda name: -names[name])
        for row in rows:

            def compress(name: str, row: Payload = row) -> None:
                files[name].write(compressors[name].compress(np.ascontiguousarray(row[name]).data))

            for_each(compress, by_length)

        def finish(name: str) -> None:
            files[name].write(compressors[name].flush())

        for_each(finish, by_length)
        flags = header.flags | (HAS_EXTENSIONS if extensions else 0)
        stream.write(
            ZSTD_HEADER.pack(
                MAGIC,
                header.version,
                header.num_splats,
                header.sh_degree,
                header.fractional_bits,
                flags,
                len(names),
                ZSTD_HEADER.size + len(extensions),
                bytes(12),
            )
        )
        stream.write(extensions)
        stream.writelines(_ENTRY.pack(files[name].length, header.num_splats * width) for name, width in names.items())
        for file in files.values():
            stream.writelines(file.parts())
