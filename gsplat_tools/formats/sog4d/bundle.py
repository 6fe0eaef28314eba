"""An opened .sog4d bundle: its files checked as they are taken out, one frame at a time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import FormatError
from gsplat_tools.formats import _webp
from gsplat_tools.formats._issues import Issue, raise_errors, refuse
from gsplat_tools.formats._limits import splat_bytes, too_much
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats._webp import Image
from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.sog4d import labels as label_files
from gsplat_tools.formats.sog4d.labels import Labels
from gsplat_tools.formats.sog4d.meta import Meta, PaletteMeta, Segment, frame_path
from gsplat_tools.formats.sog4d.meta_reader import parse_meta
from gsplat_tools.formats.sog4d.rules import RULES
from gsplat_tools.formats.sog4d.textures import check_indices, index_image, indices_of

_KEPT_SEGMENTS = 4

REPEATABLE = ("meta.json",)
"""Entries that may occur again: the fork's `normalize-meta` adds a second meta.json."""


class Bundle:
    """The files of a bundle, each checked when it is asked for.

    Parameters
    ----------
    stream
        Can seek; stays open as long as the bundle is used. Methods may be called from several threads.

    Raises
    ------
    FormatError
        meta.json breaks a rule, or a file that it names is missing; `code` of the error is the code of the rule.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.archive = ZipReader(stream, repeatable=REPEATABLE)
        self.meta, self.issues = read_meta(self.archive)
        self.issues += raise_errors(check_layout(self.meta, stream_size(stream)), RULES)
        raise_errors(missing_files(self.meta, self.archive), RULES)
        self._lock = threading.Lock()
        self._deltas: OrderedDict[tuple[str, int], _SegmentLabels] = OrderedDict()

    def image(self, path: str, frame: int | None = None) -> Image:
        """Return one image, its size checked before it is decoded.

        Raises
        ------
        FormatError
            It is not a still lossless WebP image of the layout's size.
        """
        width, height = self.meta.width, self.meta.height
        data = self.archive.read(path, frame=frame, at_most=_webp.most_bytes(width, height))
        try:
            header = _webp.parse_header(data, field=path, frame=frame)
            if (header.width, header.height) == (width, height):
                return _webp.decode_rgba(data, width, height, field=path, frame=frame)
        except FormatError as error:
            error.code = "image-format"  # type: ignore[attr-defined]
            raise
        message = f"expected an image of {width} x {height} pixels, found {header.width} x {header.height}"
        raise refuse(Issue(code="image-size", message=message, field=path, frame=frame), RULES)

    def planes(self, frame: int) -> dict[str, Image]:
        """Return the images of a frame by stream name; labels of delta segments are expanded to images."""
        images = {name: self.image(frame_path(path, frame), frame) for name, path in self.meta.stream_paths().items()}
        for palette in self.meta.palettes:
            if palette.labels_path is None:
                labels = self.labels(palette, frame)
                images[f"{palette.name}_labels"] = index_image(labels, self.meta.width, self.meta.height)
        return images

    def labels(self, palette: PaletteMeta, frame: int) -> Labels:
        """Return the label of every splat in one frame.

        Raises
        ------
        FormatError
            A label is out of range, or the delta file breaks a rule.
        """
        if palette.labels_path is not None:
            return self._label_image(palette, frame_path(palette.labels_path, frame), frame)
        segment = next(s for s in palette.segments if frame in s)
        with self._lock:
            key = (palette.name, segment.start_frame)
            state = self._deltas.get(key)
            if state is None:
                state = self._open_segment(palette, segment)
                self._deltas[key] = state
                if len(self._deltas) > _KEPT_SEGMENTS:
                    self._deltas.popitem(last=False)
            self._deltas.move_to_end(key)
            return state.at(frame - segment.start_frame)

    def centroids(self, palette: PaletteMeta) -> NDArray[np.float32]:
        """Return the entries of a palette, (K, C, 3).

        Raises
        ------
        CorruptDataError
            The file has another size, or holds numbers that are not finite.
        """
        return centroids_of(palette, self.archive.read(palette.centroids_path, at_most=2 * centroid_bytes(palette)))

    def _label_image(self, palette: PaletteMeta, path: str, frame: int) -> Labels:
        labels = indices_of(self.image(path, frame), self.meta.splat_count)
        raise_errors(check_indices("label-range", labels, palette.count, "label", path, frame), RULES)
        return labels

    def _open_segment(self, palette: PaletteMeta, segment: Segment) -> _SegmentLabels:
        base = self._label_image(palette, segment.base_labels_path, segment.start_frame)
        most = label_files.most_bytes(segment, self.meta.splat_count)
        data = self.archive.read(segment.delta_path, frame=segment.start_frame, at_most=most)
        blocks, issues = label_files.read_delta(data, segment, self.meta.splat_count, palette.count)
        raise_errors(issues, RULES)
        return _SegmentLabels(base, blocks)


class _SegmentLabels:
    """Labels of one segment, remembered where they were last asked for."""

    def __init__(self, base: Labels, blocks: list[NDArray[Any]]) -> None:
        self._base = base
        self._blocks = blocks
        self._index = 0
        self._current = base

    def at(self, index: int) -> Labels:
        """Return the labels of the frame that is `index` after the first."""
        if index < self._index:
            self._index, self._current = 0, self._base
        if index > self._index:
            current = self._current.copy()
            for block in self._blocks[self._index : index]:
                current[block["splat"]] = block["label"]
            self._index, self._current = index, current
        return self._current


def read_meta(archive: ZipReader) -> tuple[Meta, list[Issue]]:
    """Return meta.json and what is less than an error in it.

    Raises
    ------
    FormatError
        There is none, or it breaks a rule.
    """
    if "meta.json" not in archive:
        message = f"expected a meta.json at the root of the archive, found {len(archive.names)} other entries"
        raise refuse(Issue(code="meta-missing", message=message, field="meta.json"), RULES)
    meta, issues = parse_meta(archive.description("meta.json"), archive.length)
    rest = raise_errors(issues, RULES)
    assert meta is not None
    return meta, rest


def check_layout(meta: Meta, size: int) -> list[Issue]:
    """Return an issue where the images and splats of a frame are beyond what a file of this size can hold."""
    claimed = max(meta.width * meta.height * 4, meta.splat_count * splat_bytes(meta.bands))
    message = too_much(claimed, size)
    if message is None:
        return []
    return [Issue(code="layout-limit", message=message, field="meta.json layout", value=claimed)]


def missing_files(meta: Meta, archive: ZipReader) -> Iterator[Issue]:
    """Yield an issue for every file that meta.json names and the archive lacks."""
    for path, frame in _wanted_files(meta):
        if path not in archive:
            message = "expected this file in the archive, found none"
            yield Issue(code="file-missing", message=message, field=path, frame=frame)


def _wanted_files(meta: Meta) -> Iterator[tuple[str, int | None]]:
    """Yield (name, frame) of every file that meta.json names."""
    for frame in range(meta.frame_count):
        for path in meta.stream_paths().values():
            yield frame_path(path, frame), frame
    for palette in meta.palettes:
        yield palette.centroids_path, None
        for segment in palette.segments:
            yield segment.base_labels_path, segment.start_frame
            yield segment.delta_path, segment.start_frame


def centroid_bytes(palette: PaletteMeta) -> int:
    """Return the size of a centroid file."""
    return palette.count * palette.coefficients * 3 * palette.centroids_dtype.itemsize


def centroids_of(palette: PaletteMeta, data: bytes) -> NDArray[np.float32]:
    """Return the entries that a centroid file holds, (K, C, 3).

    Raises
    ------
    CorruptDataError
        The file has another size, or holds numbers that are not finite.
    """
    raise_errors(check_centroids(palette, data), RULES)
    values = np.frombuffer(data, palette.centroids_dtype).astype(np.float32)
    return values.reshape(palette.count, palette.coefficients, 3)


def check_centroids(palette: PaletteMeta, data: bytes) -> list[Issue]:
    """Return what is wrong with a centroid file."""
    field = palette.centroids_path
    expected = centroid_bytes(palette)
    if len(data) != expected:
        message = (
            f"expected {expected} bytes ({palette.count} entries of {palette.coefficients} x 3 {palette.centroids_type}), "
            f"found {len(data)}"
        )
        return [Issue(code="centroids-size", message=message, field=field, value=len(data))]
    is_finite = np.isfinite(np.frombuffer(data, palette.centroids_dtype))
    if is_finite.all():
        return []
    first = int(np.argmin(is_finite))
    entry = first // (palette.coefficients * 3)
    message = f"expected finite numbers, found one that is not in entry {entry}"
    bad = int(np.count_nonzero(~is_finite))
    return [
        Issue(code="centroids-value", message=message, field=field, offset=first * palette.centroids_dtype.itemsize, count=bad)
    ]
