"""Paths to scenes: detect the format, read, and drop or refuse what is invalid."""

from __future__ import annotations

import glob
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, GsplatError, NonFiniteWarning, UnknownFormatError, counts_in_words
from gsplat_tools.formats._companion import attach, path_of, read_beside
from gsplat_tools.formats._files import open_source_file
from gsplat_tools.formats._stores import is_url
from gsplat_tools.formats._stream import read_up_to, seekable
from gsplat_tools.formats.base import SNIFF_BYTES, FileInfo, Format, Scene
from gsplat_tools.formats.registry import FORMATS, detect, find_format
from gsplat_tools.sequence import GaussianSequence

AnyScene = TypeVar("AnyScene", bound=Scene)


@contextmanager
def located(path: Path) -> Iterator[None]:
    """Give the path to errors of stream readers, which cannot know it."""
    try:
        yield
    except GsplatError as error:
        if error.path is None:
            error.path = path
        raise


def is_single(path: Path) -> bool:
    """Whether a path is one file, pipe or object, not a folder, a pattern or a device."""
    if is_url(path):
        return not glob.has_magic(str(path))
    return path.is_file() or path.is_fifo()


def open_source(path: Path) -> tuple[BinaryIO, Format]:
    """Open a file and find its format from its first bytes, then from its name; the caller closes it."""
    if path.exists() and not is_single(path):
        raise UnknownFormatError("this is no file and no pipe; give a file, or frames in a folder to gsplat-convert", path=path)
    stream = open_source_file(path)
    try:
        if not stream.seekable():
            with stream as pipe:
                head = read_up_to(pipe, SNIFF_BYTES)
                detect(head, path)  # what no format claims is not copied
                stream = seekable(pipe, head)
        head = stream.read(SNIFF_BYTES)
        stream.seek(0)
        return stream, _with_companion(stream, path, detect(head, path), head)
    except BaseException:
        stream.close()
        raise


def open_as(path: Path, record: Format) -> BinaryIO:
    """Open a file of a known format, with what its companion says; the caller closes it."""
    stream = open_source_file(path)
    if record.claims is not None:
        try:
            companion = read_beside(path, stream)
        except BaseException:
            stream.close()
            raise
        if companion is not None:
            attach(stream, companion)
    return stream


def _with_companion(stream: BinaryIO, path: Path, record: Format, head: bytes) -> Format:
    """Return the format, which for plain buffers the companion beside them names."""
    if record.claims is None or record.matches(head):
        return record
    companion = read_beside(path, stream)
    if companion is None:
        raise UnknownFormatError(
            f"a {path.suffix} file holds plain buffers, and {path_of(path).name}, which says what they are, is missing; "
            f'bring it along, or write one that names the format, such as {{"format": "{record.id}"}}',
            path=path,
        )
    attach(stream, companion)
    for candidate in FORMATS.values():
        if candidate.claims is not None and candidate.claims(companion):
            return candidate
    raise UnknownFormatError(f"{path_of(path).name} names no known format: {companion.get('format')!r}", path=path)


def read_options(record: Format, options: dict[str, Any]) -> Any:
    """Build the read options of a format.

    Raises
    ------
    CapabilityError
        The format does not know one of the options, or has no reader.
    """
    if record.read is None:
        raise CapabilityError(f"{record.title} can be written but not read")
    known = {option.name for option in fields(record.read_options)}
    unknown = sorted(set(options) - known)
    if unknown:
        raise CapabilityError(
            f"{record.title} has no read option {', '.join(unknown)}; it has {', '.join(sorted(known)) or 'none'}"
        )
    return record.read_options(**options)


def load(path: str | Path, *, strict: bool = False, **options: Any) -> GaussianCloud | GaussianSequence:
    """Load a scene; the format follows from the content, then from the extension.

    Parameters
    ----------
    path
        File to read.
    strict
        Refuse invalid splats instead of dropping and counting them.
    **options
        Read options of the format.

    Returns
    -------
    GaussianCloud | GaussianSequence
        A cloud, or lazy frames for formats that hold sequences (also for a single frame). Frames of a sequence are
        returned as stored.

    Raises
    ------
    FormatError
        The bytes are at fault; the error names path, offset and field.
    CapabilityError
        The format has no reader, or does not know an option.
    CloudError
        `strict` and the file holds invalid splats.
    FileNotFoundError
        There is no such file.

    Warns
    -----
    NonFiniteWarning
        Invalid splats were dropped, with the counts per cause.
    """
    path = Path(path)
    with located(path):
        stream, record = open_source(path)
        try:
            checked = read_options(record, options)
            assert record.read is not None
            scene = with_source_format(record.read(stream, checked), record)
        except BaseException:
            stream.close()
            raise
        if isinstance(scene, GaussianSequence):
            scene = scene.within(partial(located, path))
            weakref.finalize(scene, stream.close)  # its frames are read later
            return scene
        stream.close()
        return drop_or_refuse(scene, strict=strict)


def with_source_format(scene: AnyScene, record: Format) -> AnyScene:
    """Return the scene with a note of the lossy format that it was read from, if it was."""
    if not record.is_lossy:
        return scene  # what an earlier file was is kept where the format has a place for it

    def note(cloud: GaussianCloud) -> GaussianCloud:
        return cloud.replace(source_format=record.id)

    noted = note(scene) if isinstance(scene, GaussianCloud) else scene.map(note)
    return cast("AnyScene", noted)


def drop_or_refuse(cloud: GaussianCloud, *, strict: bool) -> GaussianCloud:
    """Return the cloud without its invalid splats, or raise CloudError with `strict`."""
    from gsplat_tools.ops.filtering import drop_invalid, refuse_invalid

    if strict:
        refuse_invalid(cloud)
        return cloud
    kept, dropped = drop_invalid(cloud)
    warn_dropped(dropped, len(cloud))
    return kept


def warn_dropped(dropped: dict[str, int], count: int) -> None:
    """Warn about invalid splats that were dropped, if any."""
    if dropped:
        causes = counts_in_words(dropped)
        warnings.warn(
            NonFiniteWarning(f"dropped {sum(dropped.values())} of {count} splats that are invalid: {causes}"), stacklevel=3
        )


@contextmanager
def open_scene(
    path: Path,
    *,
    in_chunks: bool,
    as_format: str | None = None,
    on_format: Callable[[Format], object] | None = None,
    **options: Any,
) -> Iterator[CloudChunks | GaussianCloud | GaussianSequence]:
    """Open a scene for one conversion, invalid splats included: in chunks if asked for and its format allows, else whole."""
    with located(path):
        if as_format is None:
            stream, record = open_source(path)
        else:
            record = find_format(as_format)
            stream = open_as(path, record)
        with stream:
            if on_format is not None:
                on_format(record)
            checked = read_options(record, options)
            reader = (record.read_chunks if in_chunks else None) or record.read
            assert reader is not None
            scene = with_source_format(reader(stream, checked), record)
            if isinstance(scene, CloudChunks):
                scene = replace(scene, iterate=partial(_located_chunks, path, scene.iterate))
            elif isinstance(scene, GaussianSequence):
                scene = scene.within(partial(located, path))
            yield scene


def _located_chunks(path: Path, iterate: Callable[[], Iterator[GaussianCloud]]) -> Iterator[GaussianCloud]:
    """Give the path to errors that appear while later chunks are read."""
    with located(path):
        yield from iterate()


def inspect_file(path: str | Path) -> tuple[Format, FileInfo]:
    """Return the format and the header facts of a file, without decoding where the format allows.

    Raises
    ------
    FormatError
        The bytes are at fault.
    """
    path = Path(path)
    with located(path):
        stream, record = open_source(path)
        with stream:
            return record, record.inspect(stream)
