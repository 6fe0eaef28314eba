"""Clouds to bytes: records, one codebook an SH band, and labels stored whole or as changes."""

from __future__ import annotations

import warnings
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, LossyConversionWarning
from gsplat_tools.formats._label_delta import UPDATE, DeltaSegment, Labels, write_delta
from gsplat_tools.formats._motion_repair import MotionRepair
from gsplat_tools.formats._palettes import check_range, stored_entries
from gsplat_tools.formats.base import Scene
from gsplat_tools.formats.splat4d import container
from gsplat_tools.formats.splat4d.container import BAND_COEFFICIENTS, DELTA, ENTRY, FULL, HEADER, META, TABLE_HEADER
from gsplat_tools.formats.splat4d.options import MAX_PALETTE, Splat4dOptions
from gsplat_tools.formats.splat4d.records import encode

_ALIGNMENT = 16
_DELTA_MAGIC = b"SPL4DLB1"


def write(scene: Scene, stream: BinaryIO, options: Splat4dOptions) -> None:
    """Write a cloud, with or without motion.

    Raises
    ------
    CapabilityError
        The scene is a sequence or has an SH band above 3, or version 1 cannot say its time model.
    CloudError
        A value is not one that a splat may hold.

    Warns
    -----
    LossyConversionWarning
        Colors, scales, times or durations were clamped, or version 1 leaves out SH, with counts.
    """
    if not isinstance(scene, GaussianCloud):
        raise CapabilityError("a .splat4d holds one cloud; fit a sequence first (gsplat_tools.ops.motion_fitting.fit_motion)")
    from gsplat_tools.ops.filtering import refuse_invalid

    if scene.sh_degree > len(BAND_COEFFICIENTS):
        raise CapabilityError(f".splat4d holds SH bands up to 3, the scene has {scene.sh_degree}", field="shN")
    if len(scene) == 0:
        raise CapabilityError("a .splat4d holds at least one splat, the scene has none")
    refuse_invalid(scene)
    cloud = _repaired(scene)
    if options.version == 1:
        _write_version_1(cloud, stream, options)
        return
    _write_version_2(cloud, stream, options)


def _repaired(cloud: GaussianCloud) -> GaussianCloud:
    """Return the cloud with times as its model allows them, warning about what was clamped."""
    if not cloud.has_motion:
        return cloud
    repair = MotionRepair(cloud.time_model, len(cloud))
    changes = repair.apply(cloud)
    repair.warn()
    return cloud.replace(**changes)


def _write_version_1(cloud: GaussianCloud, stream: BinaryIO, options: Splat4dOptions) -> None:
    """Write records alone, which readers take as the window model as long as all times lie in [0, 1]."""
    if cloud.has_motion and cloud.time_model != "window":
        raise CapabilityError(
            "version 1 has no field for the time model and is read as window: use version 2, or convert the cloud with "
            "gsplat_tools.ops.motion.with_time_model",
            field="time_model",
        )
    if cloud.sh_degree:
        message = f"version 1 of .splat4d holds no SH bands: dropped bands 1 to {cloud.sh_degree} of {len(cloud)} splats"
        warnings.warn(LossyConversionWarning(message + "; version 2 holds them", code="dropped-sh-bands"), stacklevel=3)
    data = encode(cloud, options.rotation).tobytes()
    if data.startswith(container.FAMILY):
        raise CapabilityError("the first position would be read as the magic of version 2; use version 2, or reorder")
    stream.write(data)


def _write_version_2(cloud: GaussianCloud, stream: BinaryIO, options: Splat4dOptions) -> None:
    """Write header, sections, and the table behind them."""
    uses_deltas = options.labels == "delta-v1" and cloud.sh_degree > 0
    length = options.delta_segment_length or options.frame_count
    segments = [(start, min(length, options.frame_count - start)) for start in range(0, options.frame_count, length)]
    entries: list[bytes] = []
    bands = _fit_bands(cloud, options)
    stream.write(bytes(HEADER.size))

    def add(kind: bytes, data: bytes, band: int = 0, segment: tuple[int, int] = (0, 0)) -> None:
        stream.write(bytes(-stream.tell() % _ALIGNMENT))
        entries.append(ENTRY.pack(kind, band, *segment, stream.tell(), len(data)))
        stream.write(data)

    add(b"RECS", encode(cloud, options.rotation).tobytes())
    infos = [
        number
        for band in range(3)
        for number in (
            (len(bands[band][0]), 1 if options.centroids == "f16" else 2, DELTA if uses_deltas else FULL, 0)
            if band < len(bands)
            else (0, 0, 0, 0)
        )
    ]
    add(b"META", META.pack(1, cloud.temporal_cutoff, options.delta_segment_length if uses_deltas else 0, 0, *infos))
    for band, (centroids, labels) in enumerate(bands, start=1):
        add(b"SHCT", centroids.tobytes(), band)
        whole = labels.astype("<u2").tobytes()
        if not uses_deltas:
            add(b"SHLB", whole, band)
            continue
        for start, count in segments:
            add(b"SHLB", whole, band, (start, count))
            told = DeltaSegment(
                field="SHDL", start_frame=start, frame_count=count, splat_count=len(cloud), label_count=len(centroids)
            )
            nothing = np.zeros(0, UPDATE)
            add(b"SHDL", write_delta(told, [nothing] * (count - 1), magic=_DELTA_MAGIC), band, (start, count))
    stream.write(bytes(-stream.tell() % _ALIGNMENT))
    table_offset = stream.tell()
    stream.write(TABLE_HEADER.pack(b"SECT", 1, len(entries), 0) + b"".join(entries))
    stream.seek(0)
    time_model = 2 if cloud.has_motion and cloud.time_model == "gaussian" else 1
    frame_count = options.frame_count if uses_deltas else 0
    stream.write(
        HEADER.pack(
            container.MAGIC, 2, HEADER.size, len(entries), container.RECORD_BYTES, len(cloud), cloud.sh_degree, time_model,
            frame_count, table_offset,
        )
    )  # fmt: skip
    stream.seek(0, 2)


def default_palette_size(num_splats: int) -> int:
    """Return how many entries a band's codebook gets by default."""
    return int(np.clip(num_splats // 16, 256, 8192))


def _fit_bands(cloud: GaussianCloud, options: Splat4dOptions) -> list[tuple[NDArray[np.floating], Labels]]:
    """Return the codebook, as it is stored, and the labels of every band."""
    from gsplat_tools.codecs.palette import fit_palette, nearest_labels
    from gsplat_tools.ops.importance import importance

    check_range(cloud.shN)
    size = min(options.sh_palette_size or default_palette_size(len(cloud)), MAX_PALETTE)
    step = max(1, len(cloud) // max(1 << 15, 8 * size))
    bands: list[tuple[NDArray[np.floating], Labels]] = []
    first = 0
    for band, count in enumerate(BAND_COEFFICIENTS[: cloud.sh_degree], start=1):
        points = np.ascontiguousarray(cloud.shN[:, first : first + count]).reshape(len(cloud), 3 * count)
        first += count
        fitted = fit_palette(points[::step], importance(cloud)[::step], size=size)
        stored = stored_entries(fitted, options.centroids, f"sh{band}")
        labels, _ = nearest_labels(points, stored.astype(np.float32))
        bands.append((stored, labels.astype(np.uint16)))
    return bands
