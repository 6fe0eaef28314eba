"""An opened .sog4d bundle: its files checked as they are taken out, one frame at a time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import FormatError
from gsplat_tools.formats import _webp
from gsplat_tools.formats._issues import Issue, raise_errors, refuse
from gsplat_tools.formats._stream import MAX_EXPANSION, stream_size
from gsplat_tools.formats._webp import Image
from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.sog4d import labels as label_files
from gsplat_tools.formats.sog4d.labels import Labels
from gsplat_tools.formats.sog4d.meta import Meta, PaletteMeta, Segment, frame_path
from gsplat_tools.formats.sog4d.meta_reader import parse_meta
from gsplat_tools.formats.sog4d.rules import RULES
from gsplat_tools.formats.sog4d.textures import check_indices, index_image, indices_of

_KEPT_SEGMENTS = 4


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
        self.archive = ZipReader(stream)
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
        data = self.archive.read(path, frame=frame)
        width, height = self.meta.width, self.meta.height
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
        data = self.archive.read(palette.centroids_path)
        raise_errors(check_centroids(palette, data), RULES)
        values = np.frombuffer(data, palette.centroids_dtype).astype(np.float32)
        return values.reshape(palette.count, palette.coefficients, 3)

    def _label_image(self, palette: PaletteMeta, path: str, frame: int) -> Labels:
        labels = indices_of(self.image(path, frame), self.meta.splat_count)
        raise_errors(check_indices("label-range", labels, palette.count, "label", path, frame), RULES)
        return labels

    def _open_segment(self, palette: PaletteMeta, segment: Segment) -> _SegmentLabels:
        base = self._label_image(palette, segment.base_labels_path, segment.start_frame)
        data = self.archive.read(segment.delta_path, frame=segment.start_frame)
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
    meta, issues = parse_meta(archive.read("meta.json"))
    rest = raise_errors(issues, RULES)
    assert meta is not None
    return meta, rest


def check_layout(meta: Meta, size: int) -> list[Issue]:
    """Return an issue where the images of a frame are beyond what a file of this size can hold."""
    claimed = meta.width * meta.height * 4
    if claimed <= size * MAX_EXPANSION:
        return []
    message = (
        f"images of {meta.width} x {meta.height} pixels take {claimed} bytes, over {MAX_EXPANSION} times the file's {size}"
    )
    return [Issue(code="layout-limit", message=message, field="meta.json layout", value=claimed)]


def missing_files(meta: Meta, archive: ZipReader) -> list[Issue]:
    """Return an issue for every file that meta.json names and the archive lacks."""
    names = set(archive.names)
    wanted: list[tuple[str, int | None]] = [
        (frame_path(path, frame), frame) for frame in range(meta.frame_count) for path in meta.stream_paths().values()
    ]
    for palette in meta.palettes:
        wanted.append((palette.centroids_path, None))
        for segment in palette.segments:
            wanted += [(segment.base_labels_path, segment.start_frame), (segment.delta_path, segment.start_frame)]
    return [
        Issue(code="file-missing", message="expected this file in the archive, found none", field=path, frame=frame)
        for path, frame in wanted
        if path not in names
    ]


def check_centroids(palette: PaletteMeta, data: bytes) -> list[Issue]:
    """Return what is wrong with a centroid file."""
    field = palette.centroids_path
    expected = palette.count * palette.coefficients * 3 * palette.centroids_dtype.itemsize
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
