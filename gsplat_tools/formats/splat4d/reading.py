"""Bytes to clouds: both versions, the SH labels of any frame, and header facts without decoding."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.motion import MotionBox
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, TimeModel, empty_cloud
from gsplat_tools.constants import TEMPORAL_CUTOFF
from gsplat_tools.errors import (
    CapabilityError,
    CorruptDataError,
    GsplatWarning,
    LossyConversionWarning,
    TruncatedDataError,
    UnsupportedVersionError,
)
from gsplat_tools.formats._issues import raise_errors
from gsplat_tools.formats._label_delta import RULES, DeltaSegment, Labels, read_delta
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._motion_repair import MotionRepair
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.base import FileInfo
from gsplat_tools.formats.splat4d import records as record_rows
from gsplat_tools.formats.splat4d.container import BAND_COEFFICIENTS, FAMILY, MAGIC, RECORD_BYTES, Band, Contents, parse
from gsplat_tools.formats.splat4d.options import Splat4dReadOptions
from gsplat_tools.formats.splat4d.records import RECORD

_BLOCK_RECORDS = 1 << 15


def version_of(stream: BinaryIO) -> int:
    """Return 1 or 2.

    Raises
    ------
    UnsupportedVersionError
        The magic is that of a later version.
    TruncatedDataError
        The file is empty.
    CorruptDataError
        There is no magic, and the size is no multiple of 64.
    """
    size = stream_size(stream)
    stream.seek(0)
    head = stream.read(len(MAGIC))
    if head == MAGIC:
        return 2
    if head.startswith(FAMILY) and head[6:8].isdigit():
        raise UnsupportedVersionError(f"versions 1 and 2 are read, found {head!r}", offset=0, field="magic")
    if size == 0:
        raise TruncatedDataError("the file is empty", offset=0)
    if size % RECORD_BYTES:
        raise CorruptDataError(
            f"a file without the magic {MAGIC.decode()} is of version 1, records of {RECORD_BYTES} bytes, "
            f"but {size} bytes are no multiple of that",
            offset=size - size % RECORD_BYTES,
        )
    check_splats(size // RECORD_BYTES, 0, None, field="RECS", has_motion=True)
    return 1


def read(stream: BinaryIO, options: Splat4dReadOptions | None = None) -> GaussianCloud:
    """Read a file of either version.

    Parameters
    ----------
    stream
        Can seek.
    options
        Time model, and the frame whose SH labels are taken.

    Returns
    -------
    GaussianCloud
        With motion, unless every splat stands still and is always visible.

    Raises
    ------
    FormatError
        The bytes are at fault; see docs/formats/splat4d.md for all that is checked.
    CapabilityError
        There is no such frame of SH labels.

    Warns
    -----
    GsplatWarning
        A version 1 file is taken as gaussian.
    LossyConversionWarning
        Times or durations were clamped, or SH labels change over time.
    """
    options = options or Splat4dReadOptions()
    if version_of(stream) == 1:
        return _read_version_1(stream, options)
    contents = parse(stream)
    cloud = empty_cloud(contents.splat_count, contents.sh_bands, has_motion=True)
    for start, block in record_blocks(stream, contents.records.offset, contents.splat_count):
        record_rows.decode_into(block, cloud.take(slice(start, start + len(block))))
    changed = np.zeros(contents.splat_count, np.bool_)
    for band in contents.bands:
        labels = read_labels(stream, contents, band, options.frame, changed)
        first = sum(BAND_COEFFICIENTS[: band.number - 1])
        count = BAND_COEFFICIENTS[band.number - 1]
        cloud.shN[:, first : first + count] = read_centroids(stream, band)[labels].reshape(-1, count, 3)
    if changed.any():
        warnings.warn(
            LossyConversionWarning(
                f"the SH of {np.count_nonzero(changed)} of {len(changed)} splats changes over {contents.frame_count} frames: "
                f"that of frame {options.frame} is used; the read option frame takes another",
                code="sh-over-time",
            ),
            stacklevel=2,
        )
    return _finished(cloud, options.time_model or contents.time_model, contents.temporal_cutoff)


def _read_version_1(stream: BinaryIO, options: Splat4dReadOptions) -> GaussianCloud:
    """Read a file that is nothing but records."""
    count = stream_size(stream) // RECORD_BYTES
    cloud = empty_cloud(count, 0, has_motion=True)
    for start, block in record_blocks(stream, 0, count):
        record_rows.decode_into(block, cloud.take(slice(start, start + len(block))))
    assert cloud.times is not None
    assert cloud.durations is not None
    time_model = options.time_model
    if time_model is None:
        time_model = "window"
        if record_rows.is_gaussian(cloud.times, cloud.durations):
            time_model = "gaussian"
            warnings.warn(GsplatWarning(_GAUSSIAN_MESSAGE, code="assumed-gaussian"), stacklevel=3)
    return _finished(cloud, time_model, TEMPORAL_CUTOFF)


_GAUSSIAN_MESSAGE = (
    "over 1 % of the times or durations of this version 1 file lie outside [0, 1]: taken as the gaussian time model, as "
    "gsplat-unity's fork does; the read option time_model says otherwise"
)


def _finished(cloud: GaussianCloud, time_model: TimeModel, cutoff: float) -> GaussianCloud:
    """Return the cloud with times as its model allows them, and without motion where there is none."""
    repair = MotionRepair(time_model, len(cloud))
    cloud = cloud.replace(time_model=time_model, temporal_cutoff=cutoff, **repair.apply(cloud))
    repair.warn()
    assert cloud.velocities is not None
    assert cloud.times is not None
    assert cloud.durations is not None
    # Compared, not any(): numpy warns of a signaling NaN as it turns one into a truth value.
    moves = (cloud.velocities != 0).any() or (cloud.times != 0).any()
    stands_still = not moves and bool((cloud.durations == 1).all())
    if stands_still and time_model == "window":
        return cloud.replace(velocities=None, times=None, durations=None)
    return cloud


def record_blocks(stream: BinaryIO, offset: int, count: int) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield (index of the first, records)."""
    stream.seek(offset)
    for start in range(0, count, _BLOCK_RECORDS):
        size = min(_BLOCK_RECORDS, count - start)
        yield start, np.frombuffer(read_exactly(stream, size * RECORD_BYTES, field="RECS"), RECORD)


def read_centroids(stream: BinaryIO, band: Band) -> NDArray[np.float32]:
    """Return the codebook of a band, (count, 3 C), coefficients outer, RGB inner."""
    stream.seek(band.centroids.offset)
    data = read_exactly(stream, band.centroids.length, field=band.centroids.name)
    return np.frombuffer(data, band.centroids_type).astype(np.float32).reshape(band.count, -1)


def read_labels(
    stream: BinaryIO, contents: Contents, band: Band, frame: int = 0, changed: NDArray[np.bool_] | None = None
) -> Labels:
    """Return the labels (N,) of a band at a frame, after checking those of all frames.

    Parameters
    ----------
    stream, contents, band
        The file and what it says about itself.
    frame
        0 where labels are stored once.
    changed
        (N,) bool, set to true for splats whose label is not the same in all frames.

    Raises
    ------
    FormatError
        A label is not one of the codebook, or a delta breaks a rule.
    CapabilityError
        There is no such frame.
    """
    frames = contents.frame_count if band.deltas else 1
    if frame >= frames:
        raise CapabilityError(f"SH labels are stored for {frames} frames, there is no frame {frame}", field="frame")
    wanted: Labels | None = None
    first: Labels | None = None
    for index, section in enumerate(band.labels):
        stream.seek(section.offset)
        labels = np.frombuffer(read_exactly(stream, section.length, field=section.name), "<u2").astype(np.uint16)
        beyond = labels >= band.count
        if beyond.any():
            splat = int(np.argmax(beyond))
            raise CorruptDataError(
                f"expected labels below {band.count}, found {np.count_nonzero(beyond)} others, the first {labels[splat]} of "
                f"splat {splat}",
                offset=section.offset + 2 * splat,
                field=section.name,
            )
        first = labels.copy() if first is None else first
        moment = section.start_frame if band.deltas else 0
        blocks = _delta_blocks(stream, contents, band, index) if band.deltas else []
        for block in (None, *blocks):
            if block is not None:
                labels[block["splat"]] = block["label"]
                moment += 1
            if changed is not None and (block is None or len(block)):
                changed |= labels != first
            if moment == frame:
                wanted = labels.copy()
    assert wanted is not None
    return wanted


def _delta_blocks(stream: BinaryIO, contents: Contents, band: Band, index: int) -> list[NDArray[Any]]:
    """Return the changes of a segment, checked."""
    section = band.deltas[index]
    stream.seek(section.offset)
    blocks, issues = read_delta(
        read_exactly(stream, section.length, field=section.name),
        DeltaSegment(
            field=section.name,
            start_frame=section.start_frame,
            frame_count=section.frame_count,
            splat_count=contents.splat_count,
            label_count=band.count,
        ),
    )
    raise_errors(issues, RULES)
    return blocks


def inspect(stream: BinaryIO) -> FileInfo:
    """Return header facts; records are read for the bounds, and nothing is decoded.

    Raises
    ------
    FormatError
        The header, the section table or META is at fault, or version 1 has no whole number of records.
    """
    if version_of(stream) == 1:
        return _inspect_version_1(stream)
    contents = parse(stream)
    box = MotionBox(contents.time_model, contents.temporal_cutoff)
    for _, block in record_blocks(stream, contents.records.offset, contents.splat_count):
        box.add(block["mean"], block["velocity"], _allowed(block["duration"], contents.time_model))
    palettes = {
        f"sh{band.number}": {
            "entries": band.count,
            "centroids": "f16" if band.centroids_type == "<f2" else "f32",
            "labels": band.labels_encoding,
            "segments": len(band.deltas),
        }
        for band in contents.bands
    }
    return FileInfo(
        version="2",
        splats=contents.splat_count,
        sh_degree=contents.sh_bands,
        bounds=box.box(),
        motion_bounds=box.motion_box(),
        encoding={
            "time_model": contents.time_model,
            "temporal_cutoff": contents.temporal_cutoff,
            "label_frames": contents.frame_count,
            "delta_segment_length": contents.delta_segment_length,
            "palettes": palettes,
            "sections": {section.name: section.length for section in contents.sections},
        },
    )


def _inspect_version_1(stream: BinaryIO) -> FileInfo:
    """Return what records alone tell."""
    count = stream_size(stream) // RECORD_BYTES
    times, durations = np.empty(count, np.float32), np.empty(count, np.float32)
    for start, block in record_blocks(stream, 0, count):
        times[start : start + len(block)], durations[start : start + len(block)] = block["time"], block["duration"]
    time_model: TimeModel = "gaussian" if record_rows.is_gaussian(times, durations) else "window"
    box = MotionBox(time_model)
    for start, block in record_blocks(stream, 0, count):
        box.add(block["mean"], block["velocity"], _allowed(durations[start : start + len(block)], time_model))
    return FileInfo(
        version="1",
        splats=count,
        sh_degree=0,
        bounds=box.box(),
        motion_bounds=box.motion_box(),
        encoding={"time_model": time_model, "temporal_cutoff": TEMPORAL_CUTOFF},
    )


def _allowed(durations: NDArray[np.floating[Any]], time_model: TimeModel) -> NDArray[np.floating[Any]]:
    """Return durations as `read` would clamp them."""
    return np.clip(durations, 0, 1) if time_model == "window" else np.where(np.isfinite(durations), durations, np.float32(1))


assert REST_COEFFICIENTS[1:4] == (3, 8, 15)  # the bands of the format, one after the other
