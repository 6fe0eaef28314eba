"""Companions: a JSON object beside a file of plain buffers, which says what the file cannot.

A writer attaches the object to its stream, `save` puts it beside the target, and a reader finds it on its stream again.
The object names the size and checksum of its file. While a file is replaced, its companion holds the descriptions of both
the new and the old one, so that a crash at any moment leaves a pair that can be read.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from gsplat_tools.errors import CorruptDataError, FormatError, WriteError
from gsplat_tools.formats import _json
from gsplat_tools.formats._files import reason
from gsplat_tools.formats._stream import stream_size

SUFFIX = ".json"
"""Added to the name of the file."""

_ATTRIBUTE = "gsplat_companion"
_NEXT = ".next"
_MAX_BYTES = 1 << 20
_BLOCK = 1 << 20


def attach(stream: BinaryIO, companion: Mapping[str, Any]) -> None:
    """Give a stream what stands, or shall stand, beside its file."""
    setattr(stream, _ATTRIBUTE, companion)


def companion_of(stream: BinaryIO) -> Mapping[str, Any] | None:
    """Return what was attached to a stream, or None."""
    companion: Mapping[str, Any] | None = getattr(stream, _ATTRIBUTE, None)
    return companion


def path_of(path: Path) -> Path:
    """Return where the companion of a file lies."""
    return path.with_name(path.name + SUFFIX)


def read_beside(path: Path, stream: BinaryIO) -> dict[str, Any] | None:
    """Return what the companion beside a file says about this very file, or None where there is no companion.

    Parameters
    ----------
    path
        The file.
    stream
        Its bytes; the position is 0 afterwards.

    Raises
    ------
    CorruptDataError
        The companion is no JSON object, or describes another file.
    """
    place = path_of(path)
    if not place.is_file():
        return None
    if place.stat().st_size > _MAX_BYTES:
        raise CorruptDataError(f"{place.name} is larger than {_MAX_BYTES} bytes, which no companion is", field=place.name)
    try:
        whole = _json.parse(place.read_bytes())
    except ValueError as error:
        raise CorruptDataError(f"{place.name} is not JSON: {error}", field=place.name) from error
    if not isinstance(whole, dict):
        raise CorruptDataError(f"{place.name} must hold a JSON object", field=place.name)
    found: dict[str, int] | None = None
    for entry in (whole, whole.pop("previous", None)):
        if not isinstance(entry, dict):
            continue
        described = entry.get("file")
        if described is None:  # written by hand
            return entry
        if not isinstance(described, dict) or described.get("bytes") != stream_size(stream):
            continue
        found = found or _describe(stream)
        if described == found:
            return entry
    raise CorruptDataError(
        f"{place.name} describes another file than this one of {stream_size(stream)} bytes: the two are not of one "
        "conversion, or the file was changed; convert again",
        field=place.name,
    )


def write_beside(stream: BinaryIO) -> None:
    """Write the companion of a finished temporary file beside it, where one was attached."""
    companion = companion_of(stream)
    if companion is not None:
        position = stream.tell()
        _write(path_of(Path(stream.name)), {**companion, "file": _describe(stream)})
        stream.seek(position)


@contextmanager
def published(temporary: Path, target: Path) -> Iterator[None]:
    """Publish the companion of a temporary file around the rename of the file itself, which the block does."""
    ready, place = path_of(temporary), path_of(target)
    if not ready.is_file():
        yield
        return
    companion = json.loads(ready.read_bytes())
    previous = None
    if target.is_file():
        with suppress(FormatError), target.open("rb") as old:
            previous = read_beside(target, old)
    between = ready.with_name(ready.name + _NEXT)
    _write(between, companion if previous is None else {**companion, "previous": previous})
    between.replace(place)
    yield
    ready.replace(place)


def remove_beside(temporary: Path) -> None:
    """Remove what is left of the companion of a temporary file."""
    ready = path_of(temporary)
    for leftover in (ready, ready.with_name(ready.name + _NEXT)):
        with suppress(OSError):
            leftover.unlink(missing_ok=True)


def file_of(name: str) -> str:
    """Return the name of the file that a companion, finished or not, belongs to; other names as they are."""
    return name.removesuffix(_NEXT).removesuffix(SUFFIX)


def sweep_beside(entry: Path, temporary: Path, *, is_alive: bool) -> None:
    """Remove the companion of a temporary file once the file and its writer are gone."""
    if not temporary.exists() and not is_alive:
        with suppress(OSError):
            entry.unlink(missing_ok=True)


def _describe(stream: BinaryIO) -> dict[str, int]:
    """Return size and checksum of a stream, which is at 0 afterwards."""
    stream.seek(0)
    size, checksum = 0, 0
    while block := stream.read(_BLOCK):
        size, checksum = size + len(block), zlib.crc32(block, checksum)
    stream.seek(0)
    return {"bytes": size, "crc32": checksum}


def _write(path: Path, companion: Mapping[str, Any]) -> None:
    """Write a JSON object and wait until it is on the disk."""
    try:
        with path.open("wb") as stream:
            stream.write((json.dumps(companion, indent=2, allow_nan=False) + "\n").encode())
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise WriteError(f"cannot write: {reason(error)}", path=path) from error
