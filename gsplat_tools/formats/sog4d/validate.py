"""Every rule of a bundle held against every byte of it, errors collected instead of raised."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import BinaryIO

import numpy as np

from gsplat_tools.errors import FormatError
from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.sog4d import labels as label_files
from gsplat_tools.formats.sog4d.bundle import REPEATABLE, Bundle, centroid_bytes, check_centroids, check_layout, missing_files
from gsplat_tools.formats.sog4d.decode import GENERATOR
from gsplat_tools.formats.sog4d.meta import Meta, PaletteMeta, frame_path
from gsplat_tools.formats.sog4d.meta_reader import parse_meta
from gsplat_tools.formats.sog4d.rules import RULES
from gsplat_tools.formats.sog4d.textures import check_indices, indices_of, pixels_of


def check(stream: BinaryIO) -> Iterator[Issue]:
    """Yield everything that is wrong with a bundle; its data are decoded, frame by frame.

    Parameters
    ----------
    stream
        Can seek.
    """
    try:
        archive = ZipReader(stream, refuses=False, repeatable=REPEATABLE)
    except FormatError as error:
        yield _issue(error, "zip-invalid")
        return
    yield from archive.issues
    if any(RULES[issue.code].severity == "error" for issue in archive.issues):
        return
    if "meta.json" not in archive:
        message = f"expected a meta.json at the root of the archive, found {len(archive.names)} other entries"
        yield Issue(code="meta-missing", message=message, field="meta.json")
        return
    try:
        meta, issues = parse_meta(archive.description("meta.json"), archive.length)
    except FormatError as error:
        yield _issue(error, "zip-entry-corrupt")
        return
    yield from issues
    if meta is None:
        return
    is_whole = True
    for issue in chain(check_layout(meta, stream_size(stream)), missing_files(meta, archive)):
        is_whole = False
        yield issue
    if not is_whole:
        return
    yield from _check_data(Bundle(stream))
    yield from _remarks(meta, archive)


def _check_data(bundle: Bundle) -> Iterator[Issue]:
    """Decode every file."""
    meta = bundle.meta
    for palette in meta.palettes:
        yield from _check_palette(bundle, palette)
    for frame in range(meta.frame_count):
        for name, template in meta.stream_paths().items():
            yield from _check_image(bundle, name, frame_path(template, frame), frame)


def _check_image(bundle: Bundle, stream: str, path: str, frame: int) -> Iterator[Issue]:
    """Decode one image and hold its numbers against their limits."""
    meta = bundle.meta
    try:
        image = bundle.image(path, frame)
    except FormatError as error:
        yield _issue(error, "image-format")
        return
    if stream == "scale_indices":
        indices = indices_of(image, meta.splat_count)
        yield from check_indices("index-range", indices, len(meta.scale_codebook), "scale index", path, frame)
    elif stream == "rotation":
        is_null = (pixels_of(image, meta.splat_count) == 128).all(axis=1)
        if is_null.any():
            first = int(np.argmax(is_null))
            message = f"expected a rotation, found 128 128 128 128 at splat {first}; it is read as the identity"
            number = int(np.count_nonzero(is_null))
            yield Issue(code="rotation-zero", message=message, field=path, frame=frame, splat=first, count=number)
    elif stream.endswith("_labels"):
        palette = next(p for p in meta.palettes if stream == f"{p.name}_labels")
        labels = indices_of(image, meta.splat_count)
        yield from check_indices("label-range", labels, palette.count, "label", path, frame)


def _check_palette(bundle: Bundle, palette: PaletteMeta) -> Iterator[Issue]:
    """Read centroids, base labels and delta files."""
    try:
        data = bundle.archive.read(palette.centroids_path, at_most=2 * centroid_bytes(palette))
        yield from check_centroids(palette, data)
    except FormatError as error:
        yield _issue(error, "zip-entry-corrupt")
    for segment in palette.segments:
        yield from _check_image(bundle, f"{palette.name}_labels", segment.base_labels_path, segment.start_frame)
        try:
            most = label_files.most_bytes(segment, bundle.meta.splat_count)
            data = bundle.archive.read(segment.delta_path, frame=segment.start_frame, at_most=most)
        except FormatError as error:
            yield _issue(error, "zip-entry-corrupt")
            continue
        yield from label_files.read_delta(data, segment, bundle.meta.splat_count, palette.count)[1]


def _remarks(meta: Meta, archive: ZipReader) -> Iterator[Issue]:
    """Say what is not wrong but worth knowing."""
    if meta.bands > 0 and not (meta.generator or "").startswith(GENERATOR):
        message = "SH may be in channel-major order, as ply_sequence_to_sog4d.py writes it; compare the colors with the source"
        yield Issue(code="foreign-sh", message=message, field="meta.json streams.sh")
    named = {"meta.json"}
    for frame in range(meta.frame_count):
        named |= {frame_path(template, frame) for template in meta.stream_paths().values()}
    for palette in meta.palettes:
        named.add(palette.centroids_path)
        named |= {path for segment in palette.segments for path in (segment.base_labels_path, segment.delta_path)}
    unused = [name for name in archive.names if name not in named and not name.endswith("/")]
    if unused:
        size = sum(archive.stored_size(name) for name in unused)
        message = f"{len(unused)} files of {size} bytes are named nowhere; leave them out"
        yield Issue(code="unreferenced-file", message=message, field=unused[0], count=len(unused))


def _issue(error: FormatError, code: str) -> Issue:
    """Return what an exception says."""
    return Issue(
        code=getattr(error, "code", code), message=error.message, field=error.field, frame=error.frame, offset=error.offset
    )
