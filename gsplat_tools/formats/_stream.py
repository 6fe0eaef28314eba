"""Reading what a header promises, and no more."""

from __future__ import annotations

import io
from typing import BinaryIO, cast

from gsplat_tools.errors import TruncatedDataError
from gsplat_tools.formats._files import spooled
from gsplat_tools.formats._limits import max_memory

_SPOOL_BYTES = 16 << 20


def read_exactly(stream: BinaryIO, size: int, *, field: str) -> bytes:
    """Read `size` bytes of `field`.

    Raises
    ------
    TruncatedDataError
        The stream ends first.
    """
    start = stream.tell()
    parts = []
    missing = size
    while missing > 0:
        part = stream.read(missing)  # may be short on pipes and raw streams
        if not part:
            raise TruncatedDataError(f"needs {size} bytes but only {size - missing} remain", offset=start, field=field)
        parts.append(part)
        missing -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def read_into(stream: BinaryIO, buffer: memoryview, *, field: str) -> None:
    """Fill `buffer` from the stream.

    Raises
    ------
    TruncatedDataError
        The stream ends first.
    """
    start = stream.tell()
    done = 0
    while done < len(buffer):
        count = cast("io.BufferedIOBase", stream).readinto(buffer[done:])
        if not count:
            raise TruncatedDataError(f"needs {len(buffer)} bytes but only {done} remain", offset=start, field=field)
        done += count


def stream_size(stream: BinaryIO) -> int:
    """Return the length of a stream that can seek, leaving its position as it was."""
    position = stream.tell()
    size = stream.seek(0, io.SEEK_END)
    stream.seek(position)
    return size


def read_up_to(stream: BinaryIO, size: int) -> bytes:
    """Return `size` bytes, fewer only where the stream ends: pipes give what has arrived."""
    parts = []
    while size > 0 and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def seekable(stream: BinaryIO, head: bytes = b"") -> BinaryIO:
    """Return the stream, or a temporary copy where it cannot seek (pipes): of what was read already, and what is left.

    Raises
    ------
    LimitExceededError
        A pipe does not end within `use_max_memory`, or else within half of the room that there is for temporary files.
    """
    return stream if stream.seekable() else spooled(stream, _SPOOL_BYTES, head=head, limit=max_memory())
