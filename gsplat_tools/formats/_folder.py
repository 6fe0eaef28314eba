"""Targets of several files: an index that names the others, which appears last and so names only what is whole."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from gsplat_tools.formats._atomic import locked, read_back, replacing, sweep_stale, target_of, temporary_beside
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
    wanted: set[str] = set()
    with ExitStack() as lock:
        try:
            # What is entered first is published last: the index.
            with replacing(path, overwrite=overwrite) as index, ExitStack() as files, temporary_beside(path) as bundle:
                yield bundle
                read_back(bundle, path)
                bundle.seek(0)
                # From here on another writer could take a file of the old index for its own while that is removed.
                lock.enter_context(locked(path.parent))
                before = _files_of(path, layout)

                def take(name: str, data: bytes) -> str:
                    wanted.add(name)
                    final = path.with_name(name)
                    if final.exists() and final.read_bytes() != data:
                        final = final.with_stem(f"{final.stem}.{_digest(data)}")
                    if not final.exists():
                        files.enter_context(_placing(final, placed)).write(data)
                    return final.name

                index.write(layout.unpack(bundle, take))
        except BaseException:
            _remove(set(placed) - _files_of(path, layout))
            if makes_folder:
                with suppress(OSError):
                    path.parent.rmdir()
            raise
        _remove((before | _abandoned(path.parent, wanted)) - _files_of(path, layout))


def _digest(data: bytes) -> str:
    """Return what is put into the name of a file whose own name is taken."""
    return hashlib.sha256(data).hexdigest()[:12]


def _remove(files: set[Path]) -> None:
    """Remove files as far as that is possible."""
    for file in files:
        with suppress(OSError):
            file.unlink()


def _abandoned(folder: Path, wanted: set[str]) -> set[Path]:
    """Return files that killed writers placed under a name made from their content; sweep their temporaries."""
    found = set()
    for entry in list(folder.iterdir()):
        owner = target_of(entry.name)
        path = folder / (owner or entry.name)
        stem, _, digest = path.stem.rpartition(".")
        is_version = re.fullmatch("[0-9a-f]{12}", digest) is not None and path.with_stem(stem or "_").name in wanted
        if owner is not None and (is_version or owner in wanted):
            sweep_stale(path)
        elif owner is None and is_version and _digest(path.read_bytes()) == digest:
            found.add(path)
    return found


@contextmanager
def _placing(path: Path, placed: list[Path]) -> Iterator[BinaryIO]:
    """Write a new file and add it to `placed` once it is there."""
    with replacing(path, overwrite=False) as stream:
        yield stream
    placed.append(path)


def folder_size(path: Path, layout: FolderLayout) -> int:
    """Return the bytes of an index and the files that it names, as far as no other writer is just replacing them."""
    size = 0
    for file in {path, *_files_of(path, layout)}:
        with suppress(FileNotFoundError):
            size += file.stat().st_size
    return size


def _files_of(path: Path, layout: FolderLayout) -> set[Path]:
    """Return what an index names and is there in its own folder; nothing for one that cannot be read."""
    try:
        names = layout.named_files(path.read_bytes())
    except (OSError, ValueError):
        return set()
    return {path.with_name(name) for name in names if Path(name).name == name and path.with_name(name).is_file()}
