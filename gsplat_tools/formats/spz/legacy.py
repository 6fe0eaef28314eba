"""Versions 1 to 3: header and attributes, one after the other, in a single gzip stream."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from contextlib import ExitStack
from typing import BinaryIO

import numpy as np

from gsplat_tools.errors import CorruptDataError, TruncatedDataError
from gsplat_tools.formats._files import Spool
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats.spz.header import (
    FIRST_ZSTD_VERSION,
    HAS_EXTENSIONS,
    LEGACY_HEADER,
    MAGIC,
    READ_VERSIONS,
    Header,
    check_fields,
    check_version,
    parse_extensions,
)
from gsplat_tools.formats.spz.payload import Payload, allocate

_GZIP = 16 + zlib.MAX_WBITS
_READ_BYTES = 1 << 18
_MAX_EXTENSION_BYTES = 1 << 20
_SPOOL_BYTES = 32 << 20


class _Inflater:
    """Decompresses a gzip stream as far as it is asked to."""

    def __init__(self, stream: BinaryIO) -> None:
        stream.seek(0)
        self._stream = stream
        self._object = zlib.decompressobj(_GZIP)
        self._pending = b""
        self.position = 0

    def read(self, size: int) -> bytes:
        """Return up to `size` bytes, none at the end.

        Raises
        ------
        CorruptDataError
            The bytes do not decompress, or something follows them.
        TruncatedDataError
            The gzip stream does not end.
        """
        while not self._object.eof:
            data = self._pending or self._stream.read(_READ_BYTES)
            if not data:
                raise TruncatedDataError("the gzip stream does not end", offset=self._stream.tell())
            try:
                part = self._object.decompress(data, size)
            except zlib.error as error:
                raise CorruptDataError(f"the gzip stream does not decompress: {error}", offset=self._stream.tell()) from error
            self._pending = self._object.unconsumed_tail
            if part:
                self.position += len(part)
                return part
        if self._object.unused_data or self._stream.read(1):
            raise CorruptDataError("bytes follow the gzip stream", offset=self._stream.tell())
        return b""

    def fill(self, buffer: memoryview, field: str) -> None:
        """Fill `buffer`.

        Raises
        ------
        TruncatedDataError
            The stream ends first.
        """
        start, done = self.position, 0
        while done < len(buffer):
            part = self.read(min(len(buffer) - done, _READ_BYTES))
            if not part:
                raise TruncatedDataError(
                    f"needs {len(buffer)} bytes but only {done} remain (offsets after decompression)", offset=start, field=field
                )
            buffer[done : done + len(part)] = part
            done += len(part)


def starts_with_header(head: bytes) -> bool:
    """Whether a gzip stream that starts with these bytes holds an SPZ file."""
    try:
        return zlib.decompressobj(_GZIP).decompress(head, len(MAGIC)) == MAGIC
    except zlib.error:
        return False


def read_header(stream: BinaryIO) -> Header:
    """Return the header; extensions are read too, which takes going through the whole file.

    Raises
    ------
    FormatError
        The header contradicts itself or the size of the file.
    """
    inflater, header = _open(stream)
    if not header.flags & HAS_EXTENSIONS:
        return header
    skipped = 0
    while skipped < header.raw_length():
        part = inflater.read(min(_READ_BYTES, header.raw_length() - skipped))
        if not part:
            raise TruncatedDataError(f"needs {header.raw_length()} bytes but only {skipped} remain", offset=LEGACY_HEADER.size)
        skipped += len(part)
    return _with_extensions(inflater, header)


def read(stream: BinaryIO, *, in_memory: bool) -> tuple[Header, Payload]:
    """Return the header with its extensions, and the bytes of every attribute.

    Raises
    ------
    FormatError
        The header contradicts itself or the size of the file, or the stream does not decompress.
    """
    inflater, header = _open(stream)
    payload = allocate(header, in_memory=in_memory)
    for name, values in payload.items():
        inflater.fill(values.reshape(-1).data, name)
    return _with_extensions(inflater, header), payload


def _open(stream: BinaryIO) -> tuple[_Inflater, Header]:
    """Read and check the header."""
    inflater = _Inflater(stream)
    raw = bytearray(LEGACY_HEADER.size)
    inflater.fill(memoryview(raw), "header")
    magic, version, count, degree, bits, flags, _zero = LEGACY_HEADER.unpack(raw)
    if magic != MAGIC:
        raise CorruptDataError(f"expected {MAGIC!r}, found {magic!r}", field="magic", offset=0)
    check_version(version, tuple(v for v in READ_VERSIONS if v < FIRST_ZSTD_VERSION), "gzip-compressed")
    header = Header(version=version, num_splats=count, sh_degree=degree, fractional_bits=bits, flags=flags)
    check_fields(header, available=stream_size(stream))
    return inflater, header


def _with_extensions(inflater: _Inflater, header: Header) -> Header:
    """Read what follows the attributes, to the end of the file."""
    start = inflater.position
    block = b""
    while len(block) <= _MAX_EXTENSION_BYTES:
        part = inflater.read(_READ_BYTES)
        if not part:
            break
        block += part
    if not header.flags & HAS_EXTENSIONS:
        if block:
            raise CorruptDataError(f"at least {len(block)} bytes follow the attributes", field="numPoints", offset=start)
        return header
    if len(block) > _MAX_EXTENSION_BYTES:
        raise CorruptDataError(f"expected at most {_MAX_EXTENSION_BYTES} bytes of extensions", field="extensions", offset=start)
    return Header(
        version=header.version,
        num_splats=header.num_splats,
        sh_degree=header.sh_degree,
        fractional_bits=header.fractional_bits,
        flags=header.flags,
        extensions=parse_extensions(block, start),
    )


def write(stream: BinaryIO, header: Header, extensions: bytes, rows: Iterable[Payload], level: int) -> None:
    """Write a file; the attributes wait in temporary files, because the format wants them one after the other.

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
        Of zlib, 1 to 9.
    """
    names = [name for name, width in header.attributes().items() if width]
    flags = header.flags | (HAS_EXTENSIONS if extensions else 0)
    fixed = LEGACY_HEADER.pack(MAGIC, header.version, header.num_splats, header.sh_degree, header.fractional_bits, flags, 0)
    with ExitStack() as stack:
        files = {name: stack.enter_context(Spool(_SPOOL_BYTES)) for name in names}
        for row in rows:
            for name, file in files.items():
                file.write(np.ascontiguousarray(row[name]).data)
        # zlib writes a gzip header without name and time: the same bytes for the same scene.
        compressor = zlib.compressobj(level, zlib.DEFLATED, _GZIP, 9)
        stream.write(compressor.compress(fixed))
        for file in files.values():
            stream.writelines(map(compressor.compress, file.parts(_READ_BYTES)))
        stream.write(compressor.compress(extensions))
        stream.write(compressor.flush())
