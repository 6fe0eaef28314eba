"""visionary-i8, an int8 of ours: Visionary's documentation names one, its code has none.

| bytes | field |
|---|---|
| 0-7 | "GSVISI8" and 0 |
| 8-31 | u32: version 1, splats N, SH degree L, bits of positions (8 or 16), splats a block (256), CRC-32 from byte 64 on |
| 32-55 | origin, 3 f64 |
| 56-63 | 0 |
| 64 | channels: (f32 scale, f32 zero) of 3 log scales and 3 (L + 1)^2 SH values |
| | blocks: ceil(N / 256) times (f32 scale, f32 zero) of x, y, z |
| | Gaussian records: x y z (i8 or i16), opacity, 3 log scales, w x y z, all i8 |
| | color records: 3 (L + 1)^2 i8, coefficient by coefficient, red green blue |

Little-endian, value = zero + scale q. See docs/formats/visionary.md.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from dataclasses import dataclass
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, empty_cloud
from gsplat_tools.codecs import visionary_int8 as codec
from gsplat_tools.errors import CapabilityError, CorruptDataError, LossyConversionWarning, UnsupportedVersionError
from gsplat_tools.formats._companion import attach
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.base import Bounds, FileInfo, Scene
from gsplat_tools.formats.visionary.buffers import check
from gsplat_tools.formats.visionary.sidecar import ModelOptions, compose
from gsplat_tools.parallel import run_blocks
from gsplat_tools.sequence import GaussianSequence

MAGIC = b"GSVISI8\0"
VERSION = 1
_HEADER = struct.Struct("<8s6I3d8x")
assert _HEADER.size == 64

_FLOAT32_ROUNDING, _FLOAT32_ANGLE = 2.0**-23, 2.0**-20
"""Decoding in float32 moves values by less than this share of them, and turns rotations by less than this."""

Clip = float | Literal["auto"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Int8Options(ModelOptions):
    """Choices of the writer, and ModelParams.

    Parameters
    ----------
    clip
        Share of the values that lie beyond the range of their channel, at either end; "auto" chooses the ends of every
        channel by the least weighted error.
    position_bits
        16, or 8 for three bytes a splat less.
    kernel_size, gaussian_scaling, opacity_scale, cutoff_scale, render_mode, base_offset
        As in `ModelOptions`.
    """

    clip: Clip = "auto"
    position_bits: int = 16

    def __post_init__(self) -> None:
        ModelOptions.__post_init__(self)
        if self.clip != "auto" and not (isinstance(self.clip, float | int) and 0 <= self.clip < 0.5):
            raise CapabilityError(f"clip must be 'auto' or a share from 0 to below 0.5, got {self.clip!r}")
        if self.position_bits not in (8, 16):
            raise CapabilityError(f"position_bits must be 8 or 16, got {self.position_bits}")


@dataclass(frozen=True, slots=True)
class Header:
    """What the first 64 bytes say, and where things lie."""

    splats: int
    sh_degree: int
    position_bits: int
    checksum: int
    origin: NDArray[np.float64]

    @property
    def channels(self) -> int:
        """Log scales and SH values."""
        return 3 + 3 * (self.sh_degree + 1) ** 2

    @property
    def blocks(self) -> int:
        """Blocks of splats."""
        return -(-self.splats // codec.BLOCK)

    @property
    def record(self) -> np.dtype[Any]:
        """A Gaussian."""
        position = "<i2" if self.position_bits == 16 else "i1"
        return np.dtype([("mean", position, 3), ("opacity", "i1"), ("log_scales", "i1", 3), ("quat", "i1", 4)])

    @property
    def size(self) -> int:
        """Bytes of the file."""
        per_splat = self.record.itemsize + self.channels - 3
        return _HEADER.size + 8 * self.channels + 24 * self.blocks + per_splat * self.splats


def matches(head: bytes) -> bool:
    """Whether a file starts as ours do."""
    return head.startswith(MAGIC)


def _read_header(stream: BinaryIO) -> Header:
    """Return the header.

    Raises
    ------
    TruncatedDataError
        The file is shorter than that.
    CorruptDataError
        It is no header of ours, or the size is another than it promises.
    UnsupportedVersionError
        It is of a later version.
    """
    stream.seek(0)
    data = read_exactly(stream, _HEADER.size, field="header")
    magic, version, count, degree, bits, block, checksum, *origin = _HEADER.unpack(data)
    if magic != MAGIC:
        raise CorruptDataError(f"expected {MAGIC!r}, found {magic!r}", offset=0, field="magic")
    if version != VERSION:
        raise UnsupportedVersionError(f"version {version} of visionary-i8 is not known, only {VERSION}", offset=8)
    if degree > 3 or bits not in (8, 16) or block != codec.BLOCK or not np.isfinite(origin).all():
        raise CorruptDataError(
            f"expected SH degree 0 to 3, positions of 8 or 16 bits, blocks of {codec.BLOCK} and a finite origin, found "
            f"{degree}, {bits}, {block} and {origin}",
            offset=16,
            field="header",
        )
    header = Header(count, degree, bits, checksum, np.array(origin))
    size = stream_size(stream)
    if size != header.size:
        raise CorruptDataError(f"the header promises {header.size} bytes, found {size}", offset=12, field="splats")
    check_splats(count, degree, None, offset=12, field="splats")
    return header


def _tables(data: bytes, header: Header) -> tuple[codec.Ranges, codec.Ranges]:
    """Return the ranges of channels (C,) and of positions (B, 3) from what follows the header."""
    table = np.frombuffer(data, "<f4", 2 * (header.channels + 3 * header.blocks)).reshape(-1, 2)
    channels, blocks = table[: header.channels], table[header.channels :].reshape(-1, 3, 2)
    level = (1 << (header.position_bits - 1)) - 1
    return codec.Ranges(channels[:, 0], channels[:, 1]), codec.Ranges(blocks[..., 0], blocks[..., 1], level)


def inspect(stream: BinaryIO) -> FileInfo:
    """Return the facts of the header.

    Raises
    ------
    TruncatedDataError, CorruptDataError, UnsupportedVersionError
        The header is at fault.
    """
    header = _read_header(stream)
    return FileInfo(
        version=str(VERSION),
        splats=header.splats,
        sh_degree=header.sh_degree,
        origin=(float(header.origin[0]), float(header.origin[1]), float(header.origin[2])),
        encoding={
            "position_bits": header.position_bits,
            "block_splats": codec.BLOCK,
            "gaussian_bytes": header.record.itemsize,
            "color_bytes": header.channels - 3,
        },
    )


def read(stream: BinaryIO, _options: Any = None) -> GaussianCloud:
    """Read the whole cloud.

    Raises
    ------
    TruncatedDataError, CorruptDataError, UnsupportedVersionError
        The bytes are at fault.
    """
    from gsplat_tools.codecs import quaternion_u8

    header = _read_header(stream)
    data = read_exactly(stream, header.size - _HEADER.size, field="data")
    if zlib.crc32(data) != header.checksum:
        raise CorruptDataError("the checksum does not fit the data: the file was changed", offset=28, field="crc32")
    channels, positions = _tables(data, header)
    count, start = header.splats, 8 * header.channels + 24 * header.blocks
    records = np.frombuffer(data, header.record, count, start)
    colors = np.frombuffer(data, np.int8, offset=start + records.nbytes).reshape(count, header.channels - 3)
    cloud = empty_cloud(count, header.sh_degree).replace(origin=header.origin)

    def decode(first: int, stop: int) -> None:
        part = slice(first, stop)
        rows = records[part]
        blocks = np.arange(first, stop) // codec.BLOCK
        # Ranges that a checksum lets pass may still overflow: what is not finite is counted and dropped by whoever loads.
        with np.errstate(over="ignore", invalid="ignore"):
            steps = positions.scales[blocks].astype(np.float64)
            cloud.means[part] = positions.zeros[blocks] + steps * rows["mean"]
            codes = np.concatenate([rows["log_scales"], colors[part]], axis=1)
            values = channels.decode(codes)
        cloud.log_scales[part] = np.where(codes[:, :3] == codec.FLAT, np.float32(-np.inf), values[:, :3])
        cloud.sh0[part] = values[:, 3:6]
        cloud.shN[part] = values[:, 6:].reshape(stop - first, -1, 3)
        cloud.opacity_logits[part] = activations.logit((rows["opacity"].astype(np.float64) + 128) / 255)
        cloud.quats[part] = quaternion_u8.decode((rows["quat"].astype(np.int16) + 128).astype(np.uint8))

    run_blocks(decode, count)
    return cloud


def write(scene: Scene, stream: BinaryIO, options: Int8Options) -> None:
    """Write a cloud, and attach the sidecar.

    Raises
    ------
    CapabilityError
        The scene is a sequence.
    CloudError
        A position is not finite, or a value is not a number.

    Warns
    -----
    LossyConversionWarning
        Values lie beyond the calibrated ranges, with the count.
    """
    if isinstance(scene, GaussianSequence):
        raise CapabilityError("a .vis file holds one moment; choose one with --time or --frame")
    cloud = scene if isinstance(scene, GaussianCloud) else scene.read()
    check(cloud)
    header = Header(len(cloud), cloud.sh_degree, options.position_bits, 0, cloud.origin)
    quats, log_scales = codec.sort_axes(cloud.quats, cloud.log_scales)
    colors = np.concatenate([cloud.sh0, cloud.shN.reshape(len(cloud), 3 * cloud.shN.shape[1])], axis=1)
    channels = _calibrate(cloud, log_scales, colors, options.clip)
    positions = codec.block_ranges(cloud.means, (1 << (options.position_bits - 1)) - 1)
    is_flat = np.isneginf(log_scales)
    values = np.concatenate([np.where(is_flat, channels.zeros[:3], log_scales), colors], axis=1)
    records = np.empty(len(cloud), header.record)
    bytes_ = np.empty(colors.shape, np.int8)
    clamped: list[int] = []

    def encode(start: int, stop: int) -> None:
        part = slice(start, stop)
        blocks = np.arange(start, stop) // codec.BLOCK
        steps = (cloud.means[part].astype(np.float64) - positions.zeros[blocks]) / positions.scales[blocks].astype(np.float64)
        codes, outside = channels.encode(values[part])
        clamped.append(outside)
        rows = records[part]
        rows["mean"] = np.rint(np.clip(steps, -positions.level, positions.level))
        rows["opacity"] = np.rint(activations.sigmoid(cloud.opacity_logits[part].astype(np.float64)) * 255) - 128
        rows["log_scales"] = np.where(is_flat[part], codec.FLAT, codes[:, :3])
        rows["quat"] = quats[part]
        bytes_[part] = codes[:, 3:]

    run_blocks(encode, len(cloud))
    if sum(clamped):
        message = (
            f"{sum(clamped)} of {values.size} scales and SH values lie beyond the calibrated ranges and were clamped to them; "
            "--clip 0 takes the whole range, with coarser steps"
        )
        warnings.warn(LossyConversionWarning(message, code="clipped"), stacklevel=2)
    tables = np.concatenate([np.stack([r.scales.ravel(), r.zeros.ravel()], axis=1) for r in (channels, positions)])
    parts = (tables.astype("<f4").tobytes(), records.tobytes(), bytes_.tobytes())
    checksum = 0
    for data in parts:
        checksum = zlib.crc32(data, checksum)
    stream.write(
        _HEADER.pack(
            MAGIC, VERSION, len(cloud), cloud.sh_degree, options.position_bits, codec.BLOCK, checksum, *map(float, cloud.origin)
        )
    )
    stream.writelines(parts)
    start = _HEADER.size + len(parts[0])
    buffers = [("gaussian", start, header.record.itemsize), ("color", start + len(parts[1]), header.channels - 3)]
    attach(
        stream, compose("i8", len(cloud), cloud.sh_degree, cloud.origin, options, buffers, source_format=cloud.source_format)
    )


def _calibrate(cloud: GaussianCloud, log_scales: NDArray[np.float32], colors: NDArray[np.float32], clip: Clip) -> codec.Ranges:
    """Return the ranges of log scales and SH values."""
    from gsplat_tools.ops.importance import importance

    if clip != "auto":
        return codec.clipped_ranges(np.concatenate([log_scales, colors], axis=1), float(clip))
    weights = importance(cloud)
    longest = np.exp(np.clip(np.where(np.isfinite(log_scales[:, 0]), log_scales[:, 0], 0.0).astype(np.float64), -700, 700))
    scales = codec.calibrated_ranges(log_scales, weights, longest)
    sh = codec.calibrated_ranges(colors, weights)
    return codec.Ranges(np.concatenate([scales.scales, sh.scales]), np.concatenate([scales.zeros, sh.zeros]))


def bounds(source: GaussianCloud, stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that the ranges in the file allow for the splats of `source`."""
    from gsplat_tools.codecs.quaternion_u8 import MAX_ANGLE
    from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges

    header = _read_header(stream)
    tables = read_exactly(stream, 8 * header.channels + 24 * header.blocks, field="ranges")
    channels, positions = _tables(tables, header)
    logs = -np.sort(-source.log_scales.astype(np.float64), axis=1)
    half, low, high = channels.max_error, channels.low, channels.high
    nearest = np.where(np.isfinite(logs), np.clip(logs, low[:3], high[:3]), logs)
    rounding = half[:3] + _FLOAT32_ROUNDING * (np.abs(low[:3]) + np.abs(high[:3]))
    with np.errstate(invalid="ignore"):
        moved = np.where(np.isfinite(logs), np.abs(logs - nearest), 0.0) + rounding
    colors = np.concatenate([source.sh0, source.shN.reshape(len(source), 3 * source.shN.shape[1])], axis=1).astype(np.float64)
    missing = REST_COEFFICIENTS[header.sh_degree] * 3 + 3 - colors.shape[1]
    colors = np.pad(colors, ((0, 0), (0, missing))) if missing > 0 else colors[:, : header.channels - 3]
    color_errors = np.abs(colors - np.clip(colors, low[3:], high[3:])) + half[3:]
    color_errors += _FLOAT32_ROUNDING * (np.abs(low[3:]) + np.abs(high[3:]))
    return {
        "means": positions.max_error.max(axis=0, keepdims=True, initial=0.0) + _FLOAT32_ROUNDING * np.abs(source.means),
        # Axes may change their rank: what bounds the one that moves farthest bounds them all.
        "scales": moved.max(axis=1, keepdims=True),
        "covariances": covariance_bound_of_ranges(logs, nearest - rounding, nearest + rounding, MAX_ANGLE + _FLOAT32_ANGLE),
        "opacities": np.array([0.5 / 255 + _FLOAT32_ROUNDING]),
        "sh0": color_errors[:, :3],
        "shN": color_errors[:, 3:].reshape(len(source), -1, 3),
    }
