"""Files, a folder or a glob of frames as one sequence; one frame in memory at a time."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, UnknownFormatError
from gsplat_tools.formats._stores import is_url, local_path, matching
from gsplat_tools.formats.base import FileInfo, Format, Scene
from gsplat_tools.formats.loading import inspect_file, is_single, located, open_scene
from gsplat_tools.formats.registry import format_of_extension
from gsplat_tools.sequence import GaussianSequence

_COMPARED = ("splats", "sh_degree", "coordinate_system", "splat_model")


def open_sequence(paths: str | Path | Iterable[str | Path], *, frame_times: Sequence[float] | None = None) -> GaussianSequence:
    """Open frames as a sequence.

    Parameters
    ----------
    paths
        One path or several, each a file, a folder, or a pattern with `*`, `?` or `[`. Files of a folder or a pattern come
        in natural order (2 before 10); several paths keep the order in which they are given. A single .sog4d file is
        the sequence that it holds.
    frame_times
        Normalized times in [0, 1], one a frame; by default frames are spaced evenly.

    Returns
    -------
    GaussianSequence
        Its frames hold what the files hold, invalid splats included, and are read when they are asked for.

    Raises
    ------
    FormatError
        A file cannot be read.
    CapabilityError
        There is no frame, or a file holds several of its own.
    CloudError
        A frame differs from the first in its count, SH degree, properties or axes; the first that does is named.
    """
    files = frame_files(paths)
    first_record, first = inspect_file(files[0])
    if len(files) == 1 and first_record.holds_sequences:
        return _single_bundle(files[0], frame_times)
    for frame_id, path in enumerate(files):
        record, info = (first_record, first) if frame_id == 0 else inspect_file(path)
        check_frame(first, record, info, files[0], path, frame_id)
    times = None if frame_times is None else np.asarray(frame_times, np.float64)
    if times is not None and times.shape != (len(files),):
        raise CapabilityError(f"frame_times needs one time a frame, {len(files)}, and has {times.size}")
    return GaussianSequence(
        lambda frame_id: load_frame(files[frame_id], frame_id, first),
        num_splats=first.splats,
        sh_degree=first.sh_degree,
        frame_times=times,
        num_frames=len(files),
    )


def frame_files(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return the files that paths, folders and patterns stand for.

    Parameters
    ----------
    paths
        As for `open_sequence`.

    Raises
    ------
    CapabilityError
        Nothing is there, or a folder holds no file of a known format, or files of several.
    """
    items = [paths] if isinstance(paths, str | Path) else list(paths)
    files: list[Path] = []
    for item in map(Path, map(local_path, items)):
        if is_url(item):
            files += _objects(item)
        elif item.is_dir():
            files += _files_of_folder(item)
        elif item.exists() or not glob.has_magic(str(item)):
            files.append(item)
        else:
            found = [Path(name) for name in glob.glob(str(item), recursive=True)]  # noqa: PTH207 - absolute patterns too
            if not found:
                raise CapabilityError("no file matches the pattern", path=item)
            files += sorted((path for path in found if path.is_file()), key=natural_key)
    if not files:
        raise CapabilityError("a sequence needs at least one frame")
    return files


def _objects(item: Path) -> list[Path]:
    """Return the objects that a URL or a pattern of one stands for."""
    if not glob.has_magic(str(item)):
        return [item]
    found = [Path(url) for url in matching(item)]
    if not found:
        raise CapabilityError("no object matches the pattern", path=item)
    return sorted(found, key=natural_key)


def natural_key(path: Path) -> tuple[Any, ...]:
    """Return a sort key that compares runs of digits as numbers, and letters without case."""
    parts = re.split(r"(\d+)", path.name.lower())
    return (*(int(part) if part.isdigit() else part for part in parts), path.name, str(path.parent))


def _files_of_folder(folder: Path) -> list[Path]:
    """Return the frames in a folder in natural order; files of no known format are passed over."""
    known = {path: format_of_extension(path) for path in folder.iterdir() if path.is_file() and path.name[0] != "."}
    by_format: dict[str, list[Path]] = {}
    for path, record in known.items():
        if record is not None:
            by_format.setdefault(record.id, []).append(path)
    if not by_format:
        raise CapabilityError("the folder holds no file of a known format", path=folder)
    if len(by_format) > 1:
        counts = ", ".join(f"{len(files)} {name}" for name, files in sorted(by_format.items()))
        raise CapabilityError(
            f"the folder mixes formats ({counts}); name the frames with a pattern such as '*.ply'", path=folder
        )
    return sorted(next(iter(by_format.values())), key=natural_key)


def check_frame(first: FileInfo, record: Format, info: FileInfo, first_path: Path, path: Path, frame_id: int) -> None:
    """Refuse a frame that is a sequence itself, or whose header differs from that of the first.

    Raises
    ------
    CapabilityError, CloudError
        It is, or does.
    """
    if record.holds_sequences and info.frames > 1:
        raise CapabilityError(f"a frame cannot be a sequence of {info.frames} frames itself", path=path, frame=frame_id)
    for name in _COMPARED:
        if getattr(info, name) != getattr(first, name):
            raise CloudError(
                f"every frame needs the {name} of the first, {getattr(first, name)} in {first_path.name}; "
                f"this one has {getattr(info, name)}",
                path=path,
                frame=frame_id,
            )
    ours, theirs = (set(part.encoding.get("properties") or ()) for part in (first, info))
    if ours != theirs:
        missing, added = ", ".join(sorted(ours - theirs)), ", ".join(sorted(theirs - ours))
        what = "; ".join(text for text in (f"lacks {missing}" if missing else "", f"adds {added}" if added else "") if text)
        raise CloudError(f"every frame needs the properties of {first_path.name}; this one {what}", path=path, frame=frame_id)


def load_frame(path: Path, frame_id: int, first: FileInfo) -> GaussianCloud:
    """Read one frame, as it is on the disk now.

    Parameters
    ----------
    path, frame_id
        The file, and the frame that errors name.
    first
        What the header of the first frame says; this one must have as many splats of the same degree.

    Raises
    ------
    FormatError, CloudError
        It cannot be read, or is unlike the first.
    """
    with open_scene(path, in_chunks=False) as scene:
        cloud = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
        if not isinstance(cloud, GaussianCloud):
            raise UnknownFormatError("expected a scene that can be read whole", path=path, frame=frame_id)
    if len(cloud) != first.splats or cloud.sh_degree != first.sh_degree:
        raise CloudError(
            f"every frame needs {first.splats} splats of SH degree {first.sh_degree}; "
            f"this one has {len(cloud)} of degree {cloud.sh_degree}",
            path=path,
            frame=frame_id,
        )
    return cloud


def _single_bundle(path: Path, frame_times: Sequence[float] | None) -> GaussianSequence:
    """Open the one file that is a sequence, with other times if they are given."""
    from gsplat_tools.formats.loading import load

    with located(path):
        sequence = load(path)
    assert isinstance(sequence, GaussianSequence)
    if frame_times is None:
        return sequence
    times = np.asarray(frame_times, np.float64)
    if times.shape != (len(sequence),):
        raise CapabilityError(f"frame_times needs one time a frame, {len(sequence)}, and has {times.size}", path=path)
    return GaussianSequence(
        sequence.frame,
        num_splats=sequence.num_splats,
        sh_degree=sequence.sh_degree,
        frame_times=times,
        load_bounds=sequence.bounds,
    )


@contextmanager
def open_sources(
    sources: Sequence[str | Path], *, in_chunks: bool, read_options: dict[str, Any], options: dict[str, Any]
) -> Iterator[tuple[Scene, str]]:
    """Open what one conversion reads: a file, or several, a folder or a glob as a sequence.

    Parameters
    ----------
    sources
        Paths as `convert` takes them.
    in_chunks
        Whether a file is read in chunks where its format allows.
    read_options
        Read options of the source's format.
    options
        Of the conversion; `frame_times` is taken out of them for a sequence.

    Yields
    ------
    tuple
        The scene, invalid splats included, and the id of its format.
    """
    if len(sources) == 1 and is_single(Path(sources[0])):
        found: list[Format] = []
        with open_scene(Path(sources[0]), in_chunks=in_chunks, on_format=found.append, **read_options) as scene:
            yield scene, found[0].id
        return
    sequence = open_sequence(sources, frame_times=options.pop("frame_times", None))
    yield sequence, inspect_file(frame_files(sources)[0])[0].id
