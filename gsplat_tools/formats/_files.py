"""Files that say what the operating system refused, and that know whether they still hold what was written to them."""

from __future__ import annotations

import errno
import io
import os
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, BinaryIO, cast

import numpy as np

from gsplat_tools.errors import LimitExceededError, ReadError, WriteError
from gsplat_tools.formats._stores import is_url, open_object
from gsplat_tools.parallel import map_ordered

_COLUMNS = 1021
_ROWS = 63
BLOCK_BYTES = _COLUMNS * _ROWS * 8
"""Bytes under one checksum, few enough to be read back into the second-level cache."""

_BLOCKS_AT_ONCE = 8

_BUFFER_BYTES = 1 << 18
_READ_BYTES = 1 << 20

_ADVICE = {
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some space or write elsewhere",
    errno.EFBIG: "the file system or a limit (ulimit -f) allows no file of this size; write elsewhere",
    errno.EACCES: "change the permissions or write elsewhere",
    errno.EPERM: "change the permissions or write elsewhere",
    errno.EROFS: "write elsewhere",
    errno.EIO: "the disk, or the connection to it, is failing",
    errno.ENAMETOOLONG: "give it a shorter name",
}

# Bound here, so that tests can let them fail.
_raw_readinto = io.FileIO.readinto
_raw_write = io.FileIO.write


def checksum(data: bytes | bytearray | memoryview) -> int:
    """Return a checksum of bytes that costs little more than reading them, about a fifth of CRC-32.

    Notes
    -----
    The CRC-32 of sums, modulo 2^64, over the columns of a matrix of 64-bit words, and of the bytes that fill no row. Any
    change within one word is seen. So are pages and sectors in each other's places: 1021 is prime, so that no distance
    between them keeps the columns. An odd number of rows shows a bit that is the same in every word.
    """
    words = np.frombuffer(data, np.uint64, len(data) // 8)
    rows = len(words) // _COLUMNS
    sums = np.add.reduce(words[: rows * _COLUMNS].reshape(rows, _COLUMNS), axis=0, dtype=np.uint64)
    return zlib.crc32(memoryview(data)[rows * _COLUMNS * 8 :], zlib.crc32(sums))


def reason(error: OSError) -> str:
    """Return what the operating system said, and what to do about it."""
    advice = _ADVICE.get(error.errno or 0)
    said = error.strerror or str(error)
    return f"{said}; {advice}" if advice else said


class SourceFile(io.FileIO):
    """A file open for reading, whose errors name it.

    Parameters
    ----------
    path
        The file; a pipe is one too.

    Raises
    ------
    ReadError
        By every read that the operating system fails.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path), "rb")
        self._path = path

    def readinto(self, buffer: bytearray | memoryview, /) -> int | None:  # type: ignore[override]
        """Fill the buffer as far as one system call does."""
        try:
            return _raw_readinto(self, buffer)
        except OSError as error:
            raise ReadError(f"cannot read: {reason(error)}", path=self._path) from error

    def readall(self) -> bytes:
        """Return everything up to the end."""
        parts = []
        buffer = bytearray(_READ_BYTES)
        while count := self.readinto(buffer):
            parts.append(bytes(buffer[:count]))
        return b"".join(parts)


def open_source_file(path: Path) -> BinaryIO:
    """Open a file, a pipe, or an object of a store for reading.

    Raises
    ------
    OSError
        It cannot be opened.
    """
    if is_url(path):
        return open_object(path)
    return io.BufferedReader(SourceFile(path))


def read_at(file: int, buffer: memoryview, offset: int) -> int:
    """Fill the buffer from an offset of a descriptor, as far as one system call does, without moving its position.

    Raises
    ------
    ReadError
        The operating system fails.
    """
    try:
        return os.preadv(file, [buffer], offset)
    except OSError as error:
        raise ReadError(f"cannot read: {reason(error)}", offset=offset) from error


class RecordedFile(io.FileIO):
    """A new file that keeps checksums of what it was told to write, and can be held against them.

    Parameters
    ----------
    path
        File to make; it must not be there.
    mode
        Permissions, less the process's mask.
    target
        Path for messages.

    Raises
    ------
    FileExistsError, OSError
        The file is there, or cannot be made.
    """

    def __init__(self, path: Path, mode: int, target: Path) -> None:
        super().__init__(str(path), "x+b", opener=lambda name, flags: os.open(name, flags, mode))
        self._target = target
        self._end = 0
        self._blocks: list[tuple[int, int, int]] = []  # (offset, length, checksum), without gaps
        # (offset, before, after) of bytes that were written again, such as headers that are filled in at the end.
        self._changes: list[tuple[int, bytes, bytes]] = []

    def write(self, data: bytes | memoryview, /) -> int | None:  # type: ignore[override]
        """Write as much as one system call does, and remember it."""
        view = memoryview(data).cast("B")
        try:
            offset = self.tell()
            before = self._peek(offset, min(len(view), max(self._end - offset, 0)))
            count = _raw_write(self, view)
        except OSError as error:
            raise WriteError(f"cannot write: {reason(error)}", path=self._target) from error
        if not count:
            return count
        changed = min(len(before), count)
        if changed:
            self._changes.append((offset, before[:changed], bytes(view[:changed])))
        if offset > self._end:
            self._remember(memoryview(bytes(offset - self._end)))  # what was skipped reads as zeros
        self._remember(view[changed:count])
        return count

    def first_difference(self) -> int | None:
        """Return where the file on the disk first differs from what was written, to a block, or None where it does not."""
        size = Path(self.name).stat().st_size
        if size != self._end:
            return min(size, self._end)
        parts = range(0, len(self._blocks), _BLOCKS_AT_ONCE)
        differing = map_ordered(lambda i: self._first_of(self._blocks[i : i + _BLOCKS_AT_ONCE]), parts)
        return next((offset for offset in differing if offset is not None), None)

    def _peek(self, offset: int, size: int) -> bytes:
        """Return bytes that were written before, leaving the position as it was."""
        if not size:
            return b""
        buffer = bytearray(size)
        count = _raw_readinto(self, buffer) or 0
        self.seek(offset)
        return bytes(buffer[:count])

    def _remember(self, view: memoryview) -> None:
        """Add bytes at the end to the checksums."""
        for start in range(0, len(view), BLOCK_BYTES):
            part = view[start : start + BLOCK_BYTES]
            self._blocks.append((self._end, len(part), checksum(part)))
            self._end += len(part)

    def _first_of(self, blocks: list[tuple[int, int, int]]) -> int | None:
        """Return the offset of the first of some adjacent blocks that does not read as it was written, or None."""
        first, end = blocks[0][0], blocks[-1][0] + blocks[-1][1]
        changes = [change for change in self._changes if change[0] < end and change[0] + len(change[2]) > first]
        buffer = memoryview(bytearray(BLOCK_BYTES))
        with open(self.name, "rb", buffering=0) as file:  # noqa: PTH123 - by its name, as everyone will
            file.seek(first)
            for start, length, written in blocks:
                data = buffer[:length]
                done = 0
                while count := file.readinto(data[done:]):
                    done += count
                if done < length or not _undo(changes, data, start) or checksum(data) != written:
                    return start
        return None


def _undo(changes: list[tuple[int, bytes, bytes]], data: memoryview, start: int) -> bool:
    """Put back what stood in a block before its changes, from the last on; False where one of them is not there."""
    for offset, before, after in reversed(changes):
        low, high = max(offset, start), min(offset + len(after), start + len(data))
        if low < high:
            place, part = slice(low - start, high - start), slice(low - offset, high - offset)
            if data[place] != after[part]:
                return False
            data[place] = before[part]
    return True


class Spool:
    """Bytes that wait in memory or in a temporary file, and come back as they went in or not at all.

    Parameters
    ----------
    in_memory
        Bytes that are kept in memory; more go to the folder for temporary files.
    """

    def __init__(self, in_memory: int = _BUFFER_BYTES) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=in_memory)  # noqa: SIM115 - closed by __exit__
        self._checksum = 0
        self.length = 0

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, data: bytes | memoryview) -> None:
        """Append bytes.

        Raises
        ------
        WriteError
            The temporary file cannot be written.
        """
        view = memoryview(data).cast("B")
        try:
            self._file.write(view)
        except OSError as error:
            raise _spool_error(error) from error
        self._checksum = zlib.crc32(view, self._checksum)
        self.length += len(view)

    def parts(self, size: int = _READ_BYTES) -> Iterator[bytes]:
        """Yield everything from the start on.

        Raises
        ------
        WriteError
            The bytes are not those that went in; what was yielded must not be used.
        """
        length = checksum = 0
        try:
            self._file.seek(0)
            while part := self._file.read(size):
                length += len(part)
                checksum = zlib.crc32(part, checksum)
                yield part
        except WriteError:
            raise
        except OSError as error:
            raise _spool_error(error) from error
        if (length, checksum) != (self.length, self._checksum):
            raise WriteError(
                "the temporary file does not hold what was written to it; set TMPDIR to a folder on another disk",
                path=tempfile.gettempdir(),
            )


def spooled(stream: BinaryIO, in_memory: int, *, head: bytes = b"", limit: int | None = None) -> BinaryIO:
    """Return a stream that cannot seek as one that can; the caller closes it.

    Parameters
    ----------
    stream
        What is left of it is read to its end.
    in_memory
        Bytes from which on they wait on the disk.
    head
        What was read of it already.
    limit
        Bytes that are taken at most, but for `in_memory`; None takes half of the room that temporary files have.

    Raises
    ------
    ReadError, WriteError
        The stream cannot be read, or the temporary file cannot be written.
    LimitExceededError
        It does not end within the limit.
    """
    copy = tempfile.SpooledTemporaryFile(max_size=in_memory)  # noqa: SIM115 - the caller owns it
    try:
        copy.write(head)
        _copy(stream, cast("BinaryIO", copy), in_memory, limit)
        copy.seek(0)
    except BaseException as error:
        copy.close()
        if isinstance(error, OSError) and not isinstance(error, ReadError):
            raise _spool_error(error) from error
        raise
    return cast("BinaryIO", copy)


def _copy(stream: BinaryIO, target: BinaryIO, least: int, limit: int | None) -> None:
    """Copy a stream to its end; see `spooled`."""
    folder = tempfile.gettempdir()
    most = max(least, shutil.disk_usage(folder).free // 2 if limit is None else limit)
    while part := stream.read(_READ_BYTES):
        target.write(part)
        if target.tell() > most:
            room = f"half of what is free in {folder}" if limit is None else "allowed by --max-memory"
            raise LimitExceededError(
                f"the pipe has not ended after {target.tell()} bytes, more than {room}; save it to a file and give that",
                offset=target.tell(),
            )


def reserve(file: IO[bytes], size: int) -> None:
    """Make a temporary file `size` bytes long, on the disk where possible: mapped, a full disk would end the process.

    Raises
    ------
    WriteError
        There is no room for it.
    """
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
    except OSError as error:
        raise _spool_error(error) from error


def _spool_error(error: OSError) -> WriteError:
    """Return the error for a temporary file that failed."""
    return WriteError(
        f"cannot write temporary data: {reason(error)}, or set TMPDIR to a folder elsewhere", path=tempfile.gettempdir()
    )
