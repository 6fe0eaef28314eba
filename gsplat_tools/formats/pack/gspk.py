"""Reading .gspk of either layout, and writing it from clouds or chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, BinaryIO, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud, empty_cloud
from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats.base import Bounds, FileInfo, Scene
from gsplat_tools.formats.pack import arrays, container, container_writing, words
from gsplat_tools.formats.pack.container import Container
from gsplat_tools.formats.pack.container_writing import MAX_LEVEL, Codec, Rows
from gsplat_tools.formats.pack.description import MOTION_LAYOUTS, BoxTally, Description
from gsplat_tools.parallel import map_ordered
from gsplat_tools.sequence import GaussianSequence

EncodeChunk = Callable[[GaussianCloud], tuple[Rows, NDArray[np.floating[Any]]]]
"""A chunk to the rows of its streams and the positions that they hold."""


def matches(head: bytes, layout: str) -> bool:
    """Whether a file that starts with these bytes is a .gspk of that layout."""
    number = int.from_bytes(head[36:40], "little")
    return head.startswith(container.MAGIC) and number == container.LAYOUTS.index(layout)


def parse(stream: BinaryIO) -> tuple[Container, Description]:
    """Return what the header and the description say, checked.

    Raises
    ------
    FormatError
        They contradict themselves, each other or the size of the file.
    """
    parsed = container.parse(stream, lambda entry: Description.from_json(entry).stream_layouts())
    description = Description.from_json(parsed.description)
    has_motion = description.time_model is not None
    check_splats(description.count, description.degree, parsed.size, field="count", has_motion=has_motion)
    return parsed, description


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what the header and the description say; no stream is read.

    Raises
    ------
    FormatError
        They contradict themselves, each other or the size of the file.
    """
    parsed, description = parse(stream)
    streams = {
        name: {"codec": entry.codec, "stored_length": entry.stored_length, "raw_length": parsed.count * entry.layout.row_bytes}
        for name, entry in parsed.streams.items()
    }
    encoding: dict[str, Any] = {"layout": description.layout, "frame_rows": parsed.frame_rows, "streams": streams}
    if description.encoding is not None:
        encoding |= {"splat_encoding": description.encoding.to_json(), "rotation": description.rotation}
    if description.source_format:
        encoding["source_format"] = description.source_format
    if description.time_model is not None:
        encoding |= {"time_model": description.time_model, "temporal_cutoff": description.temporal_cutoff}
    return FileInfo(
        version=str(container.VERSION),
        splats=description.count,
        sh_degree=description.degree,
        coordinate_system=description.coordinate_system,
        origin=description.origin,
        splat_model=description.splat_model,
        bounds=description.world_box(description.bounds),
        motion_bounds=description.world_box(description.motion_bounds),
        encoding=encoding,
    )


def read(stream: BinaryIO, _options: Any = None) -> GaussianCloud:
    """Read the whole cloud; frames are decoded side by side.

    Raises
    ------
    FormatError
        The file is damaged; the message says where.
    """
    parsed, description = parse(stream)
    cloud = empty_cloud(description.count, description.degree, has_motion=description.time_model is not None)
    frames = parsed.frames()

    def decode(item: tuple[int, dict[str, bytes]]) -> None:
        index, stored = item
        _decode_rows(container.decode_frame(parsed, index, stored), description, cloud.take(slice(*frames[index])))

    stored_frames = ((index, container.read_frame(stream, parsed, index)) for index in range(len(frames)))
    for _ in map_ordered(decode, stored_frames):
        pass
    return cloud.replace(**description.metadata())


def read_chunks(stream: BinaryIO, _options: Any = None) -> CloudChunks:
    """Return the cloud in chunks of a frame each, decoded as they are asked for.

    Raises
    ------
    FormatError
        The header or the description is damaged; a damaged frame raises when its chunk is asked for.
    """
    parsed, description = parse(stream)
    has_motion = description.time_model is not None
    template = empty_cloud(0, description.degree, has_motion=has_motion).replace(**description.metadata())
    frames = parsed.frames()

    def decode(item: tuple[int, dict[str, bytes]]) -> GaussianCloud:
        index, stored = item
        start, stop = frames[index]
        cloud = empty_cloud(stop - start, description.degree, has_motion=has_motion)
        _decode_rows(container.decode_frame(parsed, index, stored), description, cloud)
        return cloud.replace(**description.metadata())

    def iterate() -> Iterator[GaussianCloud]:
        stored_frames = ((index, container.read_frame(stream, parsed, index)) for index in range(len(frames)))
        return map_ordered(decode, stored_frames, ahead=2)

    return CloudChunks(description.count, template, iterate)


def _decode_rows(rows: Mapping[str, NDArray[Any]], description: Description, target: GaussianCloud) -> None:
    """Fill the arrays of `target` from the rows of its splats."""
    if description.encoding is not None:
        words.decode_rows(rows, description.encoding, target)
    else:
        arrays.decode_rows(rows, target)
    if target.has_motion:
        for layout in MOTION_LAYOUTS:
            getattr(target, layout.name)[:] = rows[layout.name]


def write(
    scene: Scene,
    stream: BinaryIO,
    description: Callable[[CloudChunks], Description],
    encode: EncodeChunk,
    finish: Callable[[], None],
    *,
    codec: Codec,
    level: int,
) -> None:
    """Write a scene in one pass over its chunks.

    Parameters
    ----------
    scene
        Cloud or chunks.
    stream
        Can seek; written from its start.
    description
        Facts that are known beforehand.
    encode
        Rows of a chunk, and the positions that they hold.
    finish
        Called after the last chunk: raises or warns about what was counted.
    codec, level
        How frames are stored.

    Raises
    ------
    CapabilityError
        The scene is a sequence, or the codec or its level is unknown.
    """
    if isinstance(scene, GaussianSequence):
        raise CapabilityError("a .gspk holds one moment; choose one with --time or --frame")
    if codec not in get_args(Codec) or not 1 <= level <= MAX_LEVEL:
        raise CapabilityError(f"expected codec zstd of level 1 to {MAX_LEVEL}, or none, found {codec!r} of level {level}")
    chunks = as_chunks(scene)
    facts = description(chunks)
    tally = BoxTally()

    def rows() -> Iterator[Rows]:
        for chunk in chunks:
            encoded, positions = encode(chunk)
            tally.add(positions, chunk)
            yield {**encoded, **{name: values for name, values in chunk.arrays().items() if name in _MOTION}}

    def describe() -> dict[str, Any]:
        finish()
        entry = facts.to_json()
        box, motion_box = tally.box(), tally.motion_box(facts.time_model, facts.temporal_cutoff)
        entry["bounds"] = None if box is None else {"min": box[0], "max": box[1]}
        if facts.time_model is not None:
            entry["motion_bounds"] = None if motion_box is None else {"min": motion_box[0], "max": motion_box[1]}
        return entry

    container_writing.write(stream, facts.stream_layouts(), rows(), describe, count=chunks.num_splats, codec=codec, level=level)


_MOTION = frozenset(layout.name for layout in MOTION_LAYOUTS)


def facts_of(chunks: CloudChunks, layout: str, **changes: Any) -> Description:
    """Return the description of chunks as far as it is known before they are read."""
    template = chunks.template
    x, y, z = map(float, template.origin)
    return Description(
        layout=layout,
        count=chunks.num_splats,
        degree=template.sh_degree,
        origin=(x, y, z),
        coordinate_system=template.coordinate_system,
        splat_model=template.splat_model,
        source_format=template.source_format,
        time_model=template.time_model if template.has_motion else None,
        temporal_cutoff=template.temporal_cutoff,
        **changes,
    )


def bounds(source: GaussianCloud, stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that the file's layout and ranges allow for the splats of `source`."""
    from gsplat_tools.formats.pack import limits

    _, description = parse(stream)
    if description.encoding is None:
        return limits.uncompressed_bounds(source)
    return limits.spark_bounds(source, description.encoding)
