"""Targets of several files: an index that names the others, which appears last and so names only what is whole."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import BinaryIO, cast

from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats.base import FolderLayout


@contextmanager
def replacing_folder(path: Path, layout: FolderLayout, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a temporary bundle whose files take their places beside `path` when the block ends without an exception.

    Parameters
    ----------
    path
        The index; its folder is made if only that is missing.
    layout
        How the bundle becomes files and the index. Files of an index that is replaced go with it.
    overwrite
        Whether an index that is there may be replaced.

    Yields
    ------
    BinaryIO
        A file open for writing and reading.

    Raises
    ------
    TargetExistsError, WriteError
        As `replacing`.

    Notes
    -----
    A file whose name is taken gets another, made from its content, so that the old index stays whole until the new one
    has taken its place.
    """
    path = path.resolve()
    makes_folder = not path.parent.exists() and path.parent.parent.is_dir()
    if makes_folder:
        path.parent.mkdir()
    placed: list[Path] = []
    try:
        before = _files_of(path, layout)
        # What is entered first is published last: the index.
        with replacing(path, overwrite=overwrite) as index, ExitStack() as files, NamedTemporaryFile() as bundle:
            yield cast("BinaryIO", bundle)
            bundle.seek(0)

            def take(name: str, data: bytes) -> str:
                final = path.with_name(name)
                if final.exists() and final.read_bytes() != data:
                    final = final.with_stem(f"{final.stem}.{hashlib.sha256(data).hexdigest()[:12]}")
                if not final.exists():
                    files.enter_context(_placing(final, placed)).write(data)
                return final.name

            index.write(layout.unpack(cast("BinaryIO", bundle), take))
    except BaseException:
        for file in placed:
            with suppress(OSError):
                file.unlink()
        if makes_folder:
            with suppress(OSError):
                path.parent.rmdir()
        raise
    for file in before - _files_of(path, layout):
        with suppress(OSError):
            file.unlink()


@contextmanager
def _placing(path: Path, placed: list[Path]) -> Iterator[BinaryIO]:
    """Write a new file and add it to `placed` once it is there."""
    with replacing(path, overwrite=False) as stream:
        yield stream
    placed.append(path)


def folder_size(path: Path, layout: FolderLayout) -> int:
    """Return the bytes of an index and the files that it names."""
    return sum(file.stat().st_size for file in {path, *_files_of(path, layout)})


def _files_of(path: Path, layout: FolderLayout) -> set[Path]:
    """Return what an index names and is there in its own folder; nothing for one that cannot be read."""
    try:
        names = layout.named_files(path.read_bytes())
    except (OSError, ValueError):
        return set()
    return {path.with_name(name) for name in names if Path(name).name == name and path.with_name(name).is_file()}
