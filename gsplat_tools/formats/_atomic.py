"""Targets appear whole or not at all: temporary file beside the target, fsync, rename."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, cast

from gsplat_tools.errors import GsplatError, TargetExistsError

_SUFFIX = ".gsplat-tmp"


class WriteError(GsplatError, OSError):
    """The operating system refused to write the target."""

    __str__ = GsplatError.__str__


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
        The folder is missing, the disk is full, or another refusal by the operating system.
    """
    path = path.resolve()  # a link stays a link, and what it points to is replaced
    if path.is_dir():
        raise TargetExistsError("the target is a folder; name a file in it", path=path)
    if path.exists() and not path.is_file():
        raise WriteError("the target is not a regular file (a device or a pipe); write to a file", path=path)
    if path.exists() and not overwrite:
        raise TargetExistsError("the target exists; use --overwrite (library: overwrite=True) to replace it", path=path)
    if not path.parent.is_dir():
        raise WriteError("the folder of the target does not exist; make it first", path=path)
    sweep_stale(path)
    stream: BinaryIO | None = None
    try:
        stream = cast(
            "BinaryIO",
            tempfile.NamedTemporaryFile(  # noqa: SIM115 - closed below, renamed or removed
                mode="w+b", dir=path.parent, prefix=f".{path.name}.{os.getpid()}.", suffix=_SUFFIX, delete=False
            ),
        )
        yield stream
        stream.flush()
        os.fsync(stream.fileno())
        stream.close()
        _copy_mode(path, Path(stream.name))
        if path.exists() and not overwrite:  # made by someone else meanwhile
            raise TargetExistsError("the target appeared while it was being made", path=path)
        Path(stream.name).replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        if isinstance(error, GsplatError):
            raise
        raise WriteError(f"cannot write: {error.strerror or error}", path=path) from error
    finally:
        if stream is not None:
            with suppress(OSError):
                stream.close()
            with suppress(OSError):
                Path(stream.name).unlink(missing_ok=True)


def sweep_stale(path: Path) -> None:
    """Remove temporaries of this target that a killed process left behind."""
    pattern = re.compile(rf"\.{re.escape(path.name)}\.(\d+)\..*{re.escape(_SUFFIX)}")
    for entry in path.parent.iterdir():
        match = pattern.fullmatch(entry.name)
        if match and not _is_alive(int(match[1])):
            with suppress(OSError):
                entry.unlink()


def _is_alive(process: int) -> bool:
    """Whether a process of this number exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _copy_mode(path: Path, temporary: Path) -> None:
    """Give the new file the permissions of the old one, or those that a plain open() would have given."""
    if path.exists():
        mode = path.stat().st_mode & 0o7777
    else:
        umask = os.umask(0)
        os.umask(umask)
        mode = 0o666 & ~umask
    temporary.chmod(mode)


def _sync_folder(folder: Path) -> None:
    """Make the rename durable where folders can be synced."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
