"""Scenes to paths: prepare, write beside the target, check, rename."""

from __future__ import annotations

import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, BinaryIO

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.errors import TARGET_EXISTS, CapabilityError, FormatError, GsplatWarning, TargetExistsError, WriteError
from gsplat_tools.formats._atomic import read_back, replacing, temporary_beside
from gsplat_tools.formats._companion import path_of, write_beside
from gsplat_tools.formats._folder import folder_size, replacing_folder
from gsplat_tools.formats._stores import exists, is_url, local_path, replacing_object
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import located
from gsplat_tools.formats.preparing import Prepared, SaveChoices, prepare
from gsplat_tools.formats.registry import FORMATS, find_format, format_of_extension
from gsplat_tools.ops.visibility import faint_pixels
from gsplat_tools.sequence import GaussianSequence

DEFAULT_PRESET = "balanced"
COPY_BYTES = 1 << 20

Check = Callable[[BinaryIO, Prepared, Format], None]
"""Looks at the finished temporary file before it replaces the target; raises to keep the target as it was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SaveReport:
    """What `save` wrote.

    Parameters
    ----------
    path, format, bytes
        The target.
    splats, sh_degree, frames
        What it holds.
    dropped
        Splats left out, per cause; each counted once.
    seconds
        Time spent in "read" (reading and preparing the source), "encode", and "write" (sync, reading back, rename).
    options
        Every write option as it was used.
    """

    path: Path
    format: str
    bytes: int
    splats: int
    sh_degree: int
    frames: int
    dropped: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)


def find_target(path: Path, to: str | None) -> Format:
    """Return the format to write to `path`.

    Raises
    ------
    CapabilityError
        The format is unknown, or has no writer.
    """
    record = find_format(to) if to is not None else format_of_extension(path) or _format_of_index(path)
    if record is None:
        extensions = sorted({e for r in FORMATS.values() if r.write is not None for e in r.extensions})
        raise CapabilityError(
            f"cannot tell the format from the name; give --to or use one of {', '.join(extensions)}", path=path
        )
    if record.write is None:
        raise CapabilityError(f"{record.title} can be read but not written", path=path)
    return record


def _format_of_index(path: Path) -> Format | None:
    """Return the format whose folders a file of this name stands for."""
    return next((record for record in FORMATS.values() if record.folder is not None and record.folder.index == path.name), None)


def _replacing(path: Path, record: Format, *, overwrite: bool) -> AbstractContextManager[BinaryIO]:
    """Open what takes the place of a target: one file, the files of a folder, or an object of a store."""
    if is_url(path):
        return _replacing_object(path, record, overwrite=overwrite)
    if record.folder is not None and path.name == record.folder.index:
        return replacing_folder(path, record.folder, overwrite=overwrite)
    return replacing(path, overwrite=overwrite)


@contextmanager
def _replacing_object(path: Path, record: Format, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Write to a temporary file, which writers go back in, and send it when it is finished."""
    if record.claims is not None or (record.folder is not None and path.name == record.folder.index):
        raise CapabilityError(f"{record.title} is more than one file; write it to a disk and copy them", path=path)
    if not overwrite and exists(path):
        raise TargetExistsError(TARGET_EXISTS, path=path)
    with tempfile.TemporaryDirectory(prefix="gsplat-") as folder, temporary_beside(Path(folder) / path.name) as stream:
        yield stream
        read_back(stream, path)
        with replacing_object(path, overwrite=overwrite) as target:
            stream.seek(0)
            shutil.copyfileobj(stream, target, COPY_BYTES)


def count_splats(scene: Scene) -> int:
    """Return the splats of a scene; of one frame for a sequence."""
    return scene.num_splats if isinstance(scene, GaussianSequence | CloudChunks) else len(scene)


def split_options(record: Format, preset: str, options: dict[str, Any]) -> tuple[SaveChoices, Any]:
    """Divide options into those of every format and those of this one, the preset beneath them.

    Raises
    ------
    CapabilityError
        The preset or an option is unknown.
    """
    general = {option.name for option in fields(SaveChoices)}
    own = {option.name for option in fields(record.write_options)}
    unknown = sorted(set(options) - general - own)
    if unknown:
        raise CapabilityError(
            f"{record.title} has no option {', '.join(unknown)}; it has {', '.join(sorted(own)) or 'none of its own'}"
        )
    if preset != DEFAULT_PRESET and preset not in record.presets and record.presets:
        raise CapabilityError(f"unknown preset {preset!r}; {record.title} has {', '.join(record.presets)}")
    chosen = {**record.presets.get(preset, {}), **options}
    choices = SaveChoices(**{name: value for name, value in chosen.items() if name in general})
    written = record.write_options(**{name: value for name, value in chosen.items() if name in own})
    tolerance = getattr(written, "visual_tolerance", 0.0)
    if choices.outliers == "auto":
        choices = replace(choices, outliers="drop" if tolerance > 0 else "keep")
    if choices.prune_faint is None:
        choices = replace(choices, prune_faint=faint_pixels(tolerance))
    return choices, written


def check_header(stream: BinaryIO, record: Format, scene: Scene) -> None:
    """Hold the header and the tables of a finished file against its size and the scene; no splat is decoded.

    Raises
    ------
    WriteError
        They do not agree.
    """
    stream.seek(0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GsplatWarning)
            info = record.inspect(stream)
    except FormatError as error:
        message = f"what was written cannot be read back ({error.message}); the target is left as it was"
        raise WriteError(message, offset=error.offset, field=error.field) from error
    expected = count_splats(scene), len(scene) if isinstance(scene, GaussianSequence) else 1
    if (info.splats, info.frames if record.holds_sequences else 1) != expected:
        raise WriteError(
            f"{expected[0]} splats in {expected[1]} frames were written, but the file says {info.splats} in {info.frames}; "
            "the target is left as it was"
        )


def save(
    scene: Scene,
    path: str | Path,
    *,
    to: str | None = None,
    overwrite: bool = False,
    preset: str = DEFAULT_PRESET,
    check: Check | None = None,
    **options: Any,
) -> SaveReport:
    """Save a scene; the target appears whole or not at all.

    Parameters
    ----------
    scene
        Cloud, sequence, or chunks.
    path
        Target; a temporary file is written beside it, synced and renamed.
    to
        Format id; by default from the extension.
    overwrite
        Replace a target that is there.
    preset
        "fast", "balanced" or "best".
    check
        Called with the finished temporary file before it replaces the target.
    **options
        Choices of `SaveChoices` and write options of the format.

    Returns
    -------
    SaveReport
        Bytes, counts and seconds.

    Raises
    ------
    CapabilityError
        The format is unknown, has no writer, cannot hold the scene, or does not know an option.
    CloudError
        `strict` and there are invalid splats.
    TargetExistsError
        The target is there and `overwrite` is false.
    WriteError
        The operating system refused to write, or what was written does not read back the same.

    Warns
    -----
    LossyConversionWarning, NonFiniteWarning
        What the target cannot hold, with counts.
    """
    path = Path(local_path(path))
    record = find_target(path, to)
    choices, write_options = split_options(record, preset, options)
    assert record.write is not None
    if record.claims is not None and path_of(path).exists() and not overwrite:
        raise TargetExistsError("it stands beside the target and would be replaced; use --overwrite", path=path_of(path))
    with located(path), _replacing(path, record, overwrite=overwrite) as stream:
        start = time.perf_counter()
        prepared = prepare(scene, record, choices)
        prepared_at = time.perf_counter()
        splats = count_splats(prepared.scene)
        if splats < record.min_splats:
            raise CapabilityError(f"{record.title} holds at least {record.min_splats} splat, and {splats} are left to write")
        record.write(prepared.scene, stream, write_options)
        write_beside(stream)
        stream.flush()
        size = stream_size(stream)
        check_header(stream, record, prepared.scene)
        written_at = time.perf_counter()
        if check is not None:
            stream.seek(0)
            check(stream, prepared, record)
        checked_at = time.perf_counter()
    done = time.perf_counter()
    if record.folder is not None and path.name == record.folder.index:
        size = folder_size(path, record.folder)
    final = prepared.scene
    return SaveReport(
        path=path,
        format=record.id,
        bytes=size,
        splats=splats,
        sh_degree=final.sh_degree,
        frames=len(final) if isinstance(final, GaussianSequence) else 1,
        dropped=prepared.dropped,
        seconds={"read": prepared_at - start, "encode": written_at - prepared_at, "write": done - checked_at},
        options={option.name: getattr(write_options, option.name) for option in fields(write_options)},
    )
