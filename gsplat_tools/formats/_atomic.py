"""Targets appear whole or not at all: temporary file beside the target, sync, read back, rename, sync the folder."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from gsplat_tools.errors import TARGET_EXISTS, GsplatError, TargetExistsError, WriteError
from gsplat_tools.formats._companion import file_of, published, remove_beside, sweep_beside
from gsplat_tools.formats._files import RecordedFile, reason

if os.name == "posix":
    import fcntl

_SUFFIX = ".gsplat-tmp"
_MAX_STEM_BYTES = 180
"""Longer names are replaced by a digest in the names of temporary files, which may have 255 bytes."""

_BUFFER_BYTES = 1 << 20


@contextmanager
def replacing(path: Path, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a temporary file that takes the place of `path` when the block ends without an exception.

    Parameters
    ----------
    path
        The target; its folder must exist.
    overwrite
        Whether a file that is there may be replaced.

    Yields
    ------
    BinaryIO
        A file open for writing and reading; its `name` is the temporary path.

    Raises
    ------
    TargetExistsError
        The target is there and `overwrite` is false.
    WriteError
        The folder is missing, the disk is full, another refusal by the operating system, or the temporary file does
        not read back as it was written.
    """
    with _explained(path):
        target = check_target(path, overwrite=overwrite)
        sweep_stale(target)
    with temporary_beside(target) as stream:
        temporary = Path(stream.name)
        try:
            yield stream
            with _explained(path):
                _copy_mode(target, temporary)
                read_back(stream, path)
                if os.name != "posix":
                    stream.close()  # an open file cannot be renamed there; elsewhere its lock keeps sweepers away
                with published(temporary, target):
                    _publish(temporary, target, overwrite=overwrite)
                _sync_folder(target.parent)
        finally:
            remove_beside(temporary)


@contextmanager
def replacing_in_any_order(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file that takes the place of `path`, to be written in any order.

    It is not read back: whoever writes it knows what it has to hold, and has to look before using it.
    """
    with _explained(path):
        sweep_stale(path)
        with temporary_beside(path) as locked:
            with open(locked.name, "r+b") as stream:  # noqa: PTH123 - beside os.replace
                yield stream
            if os.name != "posix":
                locked.close()  # see `replacing`
            os.replace(locked.name, path)  # noqa: PTH105 - beside os.link and os.fsync


@contextmanager
def temporary_beside(target: Path) -> Iterator[BinaryIO]:
    """Open a temporary file in the folder of a target, that is gone when the block ends."""
    names: list[Path] = []  # before there is a file: a signal may end the process between any two lines
    stream: io.BufferedRandom | None = None
    try:
        with _explained(target):
            stream = io.BufferedRandom(_create_temporary(target, names), _BUFFER_BYTES)
        yield stream
    finally:
        # What could not be written stays in the buffer, and closing tries once more.
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.close()
        for name in names:
            with suppress(OSError):
                name.unlink(missing_ok=True)


def read_back(stream: BinaryIO, path: Path) -> None:
    """Bring a temporary file to the disk, and hold it against what was written to it.

    Raises
    ------
    WriteError
        It does not hold what was written.
    """
    assert isinstance(stream, io.BufferedRandom)
    assert isinstance(stream.raw, RecordedFile)
    with _explained(path):
        stream.flush()
        os.fsync(stream.fileno())
        offset = stream.raw.first_difference()
    if offset is not None:
        raise WriteError(
            "what was written does not read back the same: the disk, or the connection to it, is failing, or another program "
            "changed the file; the target is left as it was",
            path=path,
            offset=offset,
        )


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other writers that ask for it out of a folder, where there are locks and the folder may be read."""
    if os.name != "posix" or not os.access(folder, os.R_OK):
        yield
        return
    with _explained(folder):
        handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def target_of(temporary: str) -> str | None:
    """Return the name of the target that the name of a temporary file belongs to, or None for other names."""
    match = re.fullmatch(rf"\.(.+)\.\d+\.[0-9a-z_]+{re.escape(_SUFFIX)}", temporary)
    return match[1] if match else None


def sweep_stale(path: Path) -> None:
    """Remove temporaries of this target whose writers are gone; those of running ones are locked and stay."""
    pattern = re.compile(rf"\.{re.escape(_stem(path))}\.(\d+)\.[0-9a-z_]+{re.escape(_SUFFIX)}")
    with suppress(OSError):
        # The shortest first: companions of a temporary file can go once the file itself is gone.
        for name in sorted(os.listdir(path.parent), key=len):  # noqa: PTH208 - names are all that is needed
            owner = file_of(name)
            match = pattern.fullmatch(owner)
            if match and owner != name:
                sweep_beside(path.parent / name, path.parent / owner, is_alive=_is_alive(int(match[1])))
            elif match:
                with suppress(OSError):
                    _sweep(path.parent / name, int(match[1]))


def _sweep(entry: Path, process: int) -> None:
    """Remove a temporary file unless its writer is at work."""
    if os.name != "posix":
        entry.unlink()  # refused while the file is open
        return
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    handle = os.open(entry, flags)
    try:
        if _is_abandoned(handle, process):
            entry.unlink()  # the lock is still held: who made the file meanwhile sees that it is gone
    finally:
        os.close(handle)


def _is_abandoned(handle: int, process: int) -> bool:
    """Whether nobody holds the lock of a temporary file; where there are no locks, whether its process is gone."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return not _is_alive(process)
    return True


def _is_alive(process: int) -> bool:
    """Whether a process of this number exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn refusals by the operating system into errors that name the target."""
    try:
        yield
    except GsplatError:
        raise
    except OSError as error:
        raise WriteError(f"cannot write: {reason(error)}", path=path) from error


def check_target(path: Path, *, overwrite: bool) -> Path:
    """Return the file to replace, if it may be written: a link stays a link, and what it points to is replaced.

    Raises
    ------
    TargetExistsError
        The target is there and `overwrite` is false, or it is a folder.
    WriteError
        Its folder is missing, or it is nothing that may be replaced.
    """
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise WriteError("the target is a link that leads to itself; remove it", path=path)
    if target.is_dir():
        raise TargetExistsError("the target is a folder; name a file in it", path=path)
    if target.exists():
        if not target.is_file():
            raise WriteError("the target is not a regular file (a device or a pipe); write to a file", path=path)
        if not overwrite:
            raise TargetExistsError(TARGET_EXISTS, path=path)
        if not os.access(target, os.W_OK):
            raise WriteError("the target is write-protected; change its permissions or write elsewhere", path=path)
    if not target.parent.is_dir():
        raise WriteError("the folder of the target does not exist; make it first", path=path)
    return target


def _stem(path: Path) -> str:
    """Return what names of temporaries of a target have in common."""
    encoded = os.fsencode(path.name)
    return path.name if len(encoded) <= _MAX_STEM_BYTES else hashlib.sha256(encoded).hexdigest()


def _create_temporary(target: Path, names: list[Path]) -> RecordedFile:
    """Make a temporary file beside the target, locked as long as it is open, and add its name to what is to be removed."""
    # Never more open than the target; a new one gets what any new file gets.
    mode = 0o600 if target.exists() else 0o666
    while True:
        name = target.parent / f".{_stem(target)}.{os.getpid()}.{secrets.token_hex(4)}{_SUFFIX}"
        names.append(name)
        try:
            raw = RecordedFile(name, mode, target)
        except FileExistsError:
            names.remove(name)
            continue
        if os.name != "posix":
            return raw
        with suppress(OSError):  # not every file system has locks
            fcntl.flock(raw.fileno(), fcntl.LOCK_EX)
        if os.fstat(raw.fileno()).st_nlink:
            return raw
        raw.close()  # someone swept it between the two calls


def _copy_mode(target: Path, temporary: Path) -> None:
    """Give the new file the permissions of the old one."""
    with suppress(FileNotFoundError):
        temporary.chmod(target.stat().st_mode & 0o7777)


def _publish(temporary: Path, target: Path, *, overwrite: bool) -> None:
    """Give the temporary file its name."""
    if overwrite:
        os.replace(temporary, target)  # noqa: PTH105 - beside os.link and os.fsync
        return
    try:
        os.link(temporary, target)  # unlike a rename, it never replaces a file that was made meanwhile
    except OSError as error:
        if isinstance(error, FileExistsError) or target.exists():
            raise TargetExistsError("the target appeared while it was being made; it is left as it is", path=target) from error
        os.replace(temporary, target)  # noqa: PTH105 - a file system without links


def _sync_folder(folder: Path) -> None:
    """Make the new name survive a power cut, where folders can be synced."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return  # unreadable, or a system that opens no folders
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno in (errno.EIO, errno.ENOSPC, errno.EDQUOT):
            raise WriteError(
                f"the file is written, but its name may not survive a power cut: {reason(error)}", path=folder
            ) from error
    finally:
        os.close(handle)
