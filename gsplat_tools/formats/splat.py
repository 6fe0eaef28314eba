"""The .splat array of antimatter15's viewer: 32 bytes a splat, no header, known by its extension alone.

| bytes | field |
|---|---|
| 0-11 | x y z float32, world units |
| 12-23 | scales float32, linear |
| 24-27 | r g b a uint8: sh0 * SH_C0 + 0.5, and opacity, in 255ths |
| 28-31 | w x y z uint8, (b - 128) / 128, normalized by the reader |

Source: antimatter15/splat, `convert.py` and `main.js`. See docs/formats/splat.md.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations
from gsplat_tools.chunks import CHUNK_SIZE, CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud, empty_cloud
from gsplat_tools.codecs.smallest_three import Rotation
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning, TruncatedDataError
from gsplat_tools.formats._issues import Rule, naming_rules
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.base import Bounds, FileInfo, Format, Scene
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.parallel import BLOCK_SIZE, blocks, run_blocks
from gsplat_tools.sequence import GaussianSequence

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
assert RECORD.itemsize == 32

LOG_SCALE_RANGE = (float(np.log(np.finfo(np.float32).tiny)), 88.72)
"""Logarithms of the scales that a normal float32 holds; GPUs take smaller ones for 0."""

_ROUNDING = 2.0**-22
"""A scale is rounded to float32, which moves its logarithm by half of 2^-23, and so is the logarithm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatOptions:
    """Choices of the writer.

    Parameters
    ----------
    rotation
        Frame and length of each quaternion: "reference" rounds the unit quaternion in its own frame; "best" has the
        smallest decoded error; "small" takes the smallest turn.
    """

    rotation: Rotation = "best"


def matches(_head: bytes) -> bool:
    """Whether a file is .splat by its first bytes: nothing tells."""
    return False


RULES = {
    "record-length": Rule(
        severity="error", meaning="The file is one or more whole records of 32 bytes.", error=TruncatedDataError
    )
}


@naming_rules({"": "record-length"})
def _count(stream: BinaryIO) -> int:
    """Return the splats of a file.

    Raises
    ------
    TruncatedDataError
        The length is no multiple of 32, or 0.
    """
    size = stream_size(stream)
    if size == 0 or size % RECORD.itemsize:
        raise TruncatedDataError(
            f"expected records of {RECORD.itemsize} bytes, at least one, found {size} bytes",
            offset=size - size % RECORD.itemsize,
        )
    check_splats(size // RECORD.itemsize, 0, None, field="records")
    return size // RECORD.itemsize


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what the length tells.

    Raises
    ------
    TruncatedDataError
        The length is no multiple of 32, or 0.
    """
    return FileInfo(version="", splats=_count(stream), sh_degree=0, encoding={"row_bytes": RECORD.itemsize})


def read_chunks(stream: BinaryIO, _options: Any = None) -> CloudChunks:
    """Return the cloud in chunks.

    Raises
    ------
    TruncatedDataError
        The length is no multiple of 32, or 0.
    """
    count = _count(stream)

    def iterate() -> Iterator[GaussianCloud]:
        for start, stop in blocks(count, CHUNK_SIZE):
            stream.seek(start * RECORD.itemsize)
            data = read_exactly(stream, (stop - start) * RECORD.itemsize, field="records")
            yield decode(np.frombuffer(data, RECORD))

    return CloudChunks(count, empty_cloud(0, 0), iterate)


def read(stream: BinaryIO, _options: Any = None) -> GaussianCloud:
    """Read the whole cloud; values are as stored, invalid ones included.

    Raises
    ------
    TruncatedDataError
        The length is no multiple of 32, or 0.
    """
    count = _count(stream)
    stream.seek(0)
    return decode(np.frombuffer(read_exactly(stream, count * RECORD.itemsize, field="records"), RECORD))


def decode(records: NDArray[Any]) -> GaussianCloud:
    """Return the splats of (N,) records; opacity bytes 0 and 255 have logits -inf and +inf, scale 0 is flat."""
    from gsplat_tools.codecs import quaternion_u8

    cloud = empty_cloud(len(records), 0)
    bytes_ = np.arange(256) / 255
    colors, logits = ((bytes_ - 0.5) / SH_C0).astype(np.float32), activations.logit(bytes_).astype(np.float32)

    def decode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        rows = records[part]
        cloud.means[part] = rows["mean"]
        with np.errstate(invalid="ignore"):
            cloud.log_scales[part] = activations.log_scales(rows["scale"].astype(np.float32))
        cloud.sh0[part] = colors[rows["rgba"][:, :3]]
        cloud.opacity_logits[part] = logits[rows["rgba"][:, 3]]
        cloud.quats[part] = quaternion_u8.decode(rows["quat"])

    run_blocks(decode_block, len(records))
    return cloud


def write(scene: Scene, stream: BinaryIO, options: SplatOptions) -> None:
    """Write a cloud or chunks of SH degree 0, in the order that they are in.

    Raises
    ------
    CapabilityError
        The scene is a sequence.
    CloudError
        A position is not finite, or a value is not a number.

    Warns
    -----
    LossyConversionWarning
        Colors or scales were clamped, with counts.
    """
    if isinstance(scene, GaussianSequence):
        raise CapabilityError("a .splat file holds one moment; choose one with --time or --frame")
    tally: dict[str, int] = {}
    stream.writelines(encode(chunk, options.rotation, tally).view(np.uint8).data for chunk in as_chunks(scene))
    if tally:
        parts = ", ".join(f"{count} {what}" for what, count in tally.items())
        warnings.warn(LossyConversionWarning(f"clamped: {parts}", code="clamped"), stacklevel=2)


def encode(cloud: GaussianCloud, rotation: Rotation, tally: dict[str, int]) -> NDArray[Any]:
    """Return the (N,) records of a cloud, and add to the counts of clamped values.

    Parameters
    ----------
    cloud
        N splats; SH is left out.
    rotation
        How frames are chosen.
    tally
        Counts by what was clamped.

    Raises
    ------
    CloudError
        A position is not finite, or a value is not a number.
    """
    from gsplat_tools.codecs import quaternion_u8

    _check(cloud)
    if rotation == "reference":
        codes, log_scales = quaternion_u8.encode(cloud.quats, mode="reference"), cloud.log_scales
    else:
        codes, log_scales = quaternion_u8.encode_with_frames(cloud.quats, cloud.log_scales, mode=rotation)
    records = np.empty(len(cloud), RECORD)
    low, high = LOG_SCALE_RANGE
    clamped = np.zeros((len(blocks(len(cloud))), 2), np.int64)

    def encode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        logs = log_scales[part]
        is_outside = np.isfinite(logs) & ((logs < low) | (logs > high))
        colors = cloud.sh0[part].astype(np.float64) * (SH_C0 * 255) + 127.5
        rows = records[part]
        rows["mean"] = cloud.means[part]
        rows["scale"] = activations.exp_scales(np.where(is_outside, np.clip(logs, low, high), logs).astype(np.float32))
        rows["rgba"][:, :3] = np.rint(np.clip(colors, 0, 255))
        rows["rgba"][:, 3] = np.rint(activations.sigmoid(cloud.opacity_logits[part].astype(np.float64)) * 255)
        rows["quat"] = codes[part]
        clamped[start // BLOCK_SIZE] = np.count_nonzero((colors < -0.5) | (colors > 255.5)), np.count_nonzero(is_outside)

    run_blocks(encode_block, len(cloud))
    for what, count in zip(("color channels outside 0..1", "scale axes outside float32"), clamped.sum(axis=0), strict=True):
        if count:
            tally[what] = tally.get(what, 0) + int(count)
    return records


def _check(cloud: GaussianCloud) -> None:
    """Refuse what bytes and linear scales cannot express."""
    if not np.isfinite(cloud.means).all():
        bad = int(np.count_nonzero(~np.isfinite(cloud.means).all(axis=1)))
        raise CloudError(f"{bad} splats have positions that are not finite; drop them first", field="means")
    for name in ("log_scales", "opacity_logits", "sh0"):
        if np.isnan(getattr(cloud, name)).any():
            raise CloudError("values are not numbers; drop those splats first", field=name)


def bounds(source: GaussianCloud, _stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that records allow for the splats of `source`."""
    from gsplat_tools.codecs.quaternion_u8 import MAX_ANGLE
    from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges

    logs = source.log_scales.astype(np.float64)
    clamped = np.where(np.isfinite(logs), np.clip(logs, *LOG_SCALE_RANGE), logs)
    sorted_logs = np.sort(logs, axis=1)
    moved = np.where(np.isfinite(sorted_logs), np.abs(sorted_logs - np.clip(sorted_logs, *LOG_SCALE_RANGE)), 0.0)
    colors = source.sh0.astype(np.float64) * SH_C0 + 0.5
    return {
        "means": np.zeros((1, 3)),
        "scales": moved + _ROUNDING,
        "covariances": covariance_bound_of_ranges(logs, clamped - _ROUNDING, clamped + _ROUNDING, MAX_ANGLE),
        "opacities": np.array([0.5 / 255 + _ROUNDING]),
        "sh0": (0.5 / 255 + np.maximum(np.maximum(-colors, colors - 1), 0.0)) / SH_C0 + _ROUNDING * (2 + np.abs(source.sh0)),
    }


FORMAT = Format(
    id="splat",
    title=".splat array",
    extensions=(".splat",),
    spec="docs/formats/splat.md",
    max_sh_degree=0,
    matches=matches,
    inspect=inspect,
    read=read,
    read_chunks=read_chunks,
    write=write,
    bounds=bounds,
    rules=RULES,
    min_splats=1,
    streams=True,
    write_options=SplatOptions,
    presets={"fast": {"rotation": "reference"}, "balanced": {}, "best": {}, "exact": {}},
    knobs={**general_knobs(0), "rotation": Knob(values=("small", "best"), stream="rotations")},
    model=("spark", None),
)
