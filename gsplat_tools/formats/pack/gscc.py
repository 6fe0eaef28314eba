"""GSCC, the binary cache of gsplat-unity in Spark's layout (docs/formats/gscc.md).

| offset | type | field |
|---|---|---|
| 0 | u32 | magic 0x43435347, "GSCC" |
| 4 | u32 | version, 2 |
| 8 | u32 | splats N |
| 12 | u8, 3 zero bytes | SH bands, 0 to 4 |
| 16 | 3 f32 | center of the box of the positions |
| 28 | 3 f32 | size of that box |
| 40 | N x 16 | packed splats, then N x 8, 16, 16, 16 bytes for the SH bands that there are |

Source: the importer of wuyize25/gsplat-unity 1.4 reads this layout; ranges are Spark's defaults and axes RUF.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, Literal

import numpy as np

from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud, empty_cloud
from gsplat_tools.constants import MAX_SH_DEGREE
from gsplat_tools.errors import CapabilityError, CloudError, CorruptDataError, TruncatedDataError, UnsupportedVersionError
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.base import Bounds, FileInfo, Format, Scene
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.formats.pack import words
from gsplat_tools.formats.pack.container import StreamLayout
from gsplat_tools.formats.pack.description import BoxTally, Description
from gsplat_tools.formats.pack.encoding import SplatEncoding
from gsplat_tools.formats.pack.words import Rotation
from gsplat_tools.parallel import blocks
from gsplat_tools.sequence import GaussianSequence

MAGIC = b"GSCC"
VERSION = 2
AXES = "RUF"

_HEADER = struct.Struct("<4sIIB3s6f")
assert _HEADER.size == 40
_CHUNK = 1 << 16


@dataclass(frozen=True, slots=True, kw_only=True)
class GsccOptions:
    """Choices of GSCC.

    Parameters
    ----------
    rotation
        Frame of each rotation: "reference" as Spark's own encoder, to the bit; "best" the smallest decoded error;
        "small" the frame with the smallest turn.
    spark_encoding
        Only "default": gsplat-unity has these ranges built in.
    """

    rotation: Rotation = "best"
    spark_encoding: Literal["default", "fit"] = "default"


@dataclass(frozen=True, slots=True)
class _Header:
    """What a file says before its data."""

    count: int
    degree: int
    center: tuple[float, float, float]
    size: tuple[float, float, float]

    def sections(self) -> list[tuple[StreamLayout, int]]:
        """Return the streams and where they start."""
        sections, offset = [], _HEADER.size
        for layout in Description(layout="spark", count=self.count, degree=self.degree).stream_layouts():
            sections.append((layout, offset))
            offset += self.count * layout.row_bytes
        return sections

    def file_length(self) -> int:
        """Return the bytes that such a file has."""
        layout, offset = self.sections()[-1]
        return offset + self.count * layout.row_bytes


def matches(head: bytes) -> bool:
    """Whether a file that starts with these bytes is GSCC."""
    return head.startswith(MAGIC)


def _parse(stream: BinaryIO) -> _Header:
    """Return the header after holding it against the size of the file."""
    size = stream_size(stream)
    stream.seek(0)
    magic, version, count, degree, zeros, *box = _HEADER.unpack(read_exactly(stream, _HEADER.size, field="header"))
    if magic != MAGIC:
        raise CorruptDataError(f"expected {MAGIC!r}, found {magic!r}", field="magic", offset=0)
    if version != VERSION:
        raise UnsupportedVersionError(
            f"version {version} is not known; this reader knows version {VERSION}", field="version", offset=4
        )
    if degree > MAX_SH_DEGREE or any(zeros):
        raise CorruptDataError(
            f"expected 0 to {MAX_SH_DEGREE} SH bands and zeros, found {degree} and {zeros!r}", field="bands", offset=12
        )
    if not np.isfinite(box).all():
        raise CorruptDataError(f"expected finite numbers, found {box}", field="bounds", offset=16)
    header = _Header(count, degree, (box[0], box[1], box[2]), (box[3], box[4], box[5]))
    expected = header.file_length()
    if size < expected:
        raise TruncatedDataError(
            f"{count} splats of degree {degree} take {expected} bytes but the file has {size}", field="count", offset=8
        )
    check_splats(count, degree, None, field="count", offset=8)
    if size > expected:
        raise CorruptDataError(
            f"{count} splats of degree {degree} take {expected} bytes but the file has {size}", field="count", offset=8
        )
    return header


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what the header says.

    Raises
    ------
    FormatError
        The header contradicts itself or the size of the file.
    """
    header = _parse(stream)
    low = [center - size / 2 for center, size in zip(header.center, header.size, strict=True)]
    high = [center + size / 2 for center, size in zip(header.center, header.size, strict=True)]
    return FileInfo(
        version=str(VERSION),
        splats=header.count,
        sh_degree=header.degree,
        coordinate_system=AXES,
        bounds=(low, high) if header.count else None,
        encoding={"layout": "spark", "splat_encoding": SplatEncoding().to_json()},
    )


def read_chunks(stream: BinaryIO, _options: Any = None) -> CloudChunks:
    """Return the cloud in chunks.

    Raises
    ------
    FormatError
        The header contradicts itself or the size of the file.
    """
    header = _parse(stream)
    encoding = SplatEncoding()

    def iterate() -> Iterator[GaussianCloud]:
        for start, stop in blocks(header.count, _CHUNK):
            rows = {}
            for layout, offset in header.sections():
                stream.seek(offset + start * layout.row_bytes)
                data = read_exactly(stream, (stop - start) * layout.row_bytes, field=layout.name)
                rows[layout.name] = np.frombuffer(data, "<u4").reshape(stop - start, *layout.columns)
            pack = words.SparkPack(**rows, encoding=encoding, metadata={"coordinate_system": AXES})  # type: ignore[arg-type]
            yield words.decode(pack)

    template = empty_cloud(0, header.degree).replace(coordinate_system=AXES)
    return CloudChunks(header.count, template, iterate)


def read(stream: BinaryIO, _options: Any = None) -> GaussianCloud:
    """Read the whole cloud.

    Raises
    ------
    FormatError
        The header contradicts itself or the size of the file.
    """
    return read_chunks(stream).read()


def write(scene: Scene, stream: BinaryIO, options: GsccOptions) -> None:
    """Write a cloud or chunks, whose axes must be RUF.

    Raises
    ------
    CapabilityError
        The axes are known and not RUF, the ranges are not the defaults, the scene is a sequence, has too many splats,
        or finite positions are beyond the range of half precision.
    CloudError
        A value is not a number.

    Warns
    -----
    LossyConversionWarning
        Values out of range were clamped, or scales below e^-30 became flat.
    """
    if isinstance(scene, GaussianSequence):
        raise CapabilityError("a GSCC file holds one moment; choose one with --time or --frame")
    if options.spark_encoding != "default":
        raise CapabilityError("GSCC holds no ranges, gsplat-unity has Spark's defaults built in; use --spark-encoding default")
    chunks = as_chunks(scene)
    system = chunks.template.coordinate_system
    if system not in (AXES, "unknown"):
        raise CapabilityError(
            f"GSCC data are {AXES}, this cloud is {system}; use --target-coordinates {AXES}", field="coordinate_system"
        )
    if chunks.num_splats >= 1 << 32:
        raise CapabilityError(f"GSCC holds at most 2^32 - 1 splats, this scene has {chunks.num_splats}")
    encoding = SplatEncoding()
    clamps, boxes = words.ClampTally(encoding), BoxTally()
    header = _Header(chunks.num_splats, chunks.sh_degree, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    stream.seek(0)
    stream.write(bytes(_HEADER.size))
    start = 0
    for chunk in chunks:
        if start + len(chunk) > header.count:
            raise CloudError(f"the scene announced {header.count} splats but its chunks hold more")
        rows = words.encode_rows(chunk, encoding, options.rotation, clamps)
        boxes.add(words.stored_positions(rows["packed"]), chunk)
        for layout, offset in header.sections():
            stream.seek(offset + start * layout.row_bytes)
            stream.write(np.ascontiguousarray(rows[layout.name], "<u4").tobytes())
        start += len(chunk)
    if start != header.count:
        raise CloudError(f"the scene announced {header.count} splats but its chunks hold {start}")
    clamps.finish()
    low, high = (np.array(corner) for corner in boxes.box() or ([0.0] * 3, [0.0] * 3))
    stream.seek(0)
    stream.write(_HEADER.pack(MAGIC, VERSION, header.count, header.degree, bytes(3), *((low + high) / 2), *(high - low)))
    stream.seek(header.file_length())


def bounds(source: GaussianCloud, _stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that the layout allows for the splats of `source`."""
    from gsplat_tools.formats.pack import limits

    return limits.spark_bounds(source, SplatEncoding())


FORMAT = Format(
    id="gscc",
    title="gsplat-unity's cache (.gscc)",
    extensions=(".gscc",),
    spec="docs/formats/gscc.md",
    max_sh_degree=4,
    matches=matches,
    inspect=inspect,
    read=read,
    read_chunks=read_chunks,
    write=write,
    bounds=bounds,
    streams=True,
    required_coordinates=AXES,
    position_type="f16",
    write_options=GsccOptions,
    presets={"fast": {"rotation": "reference"}, "balanced": {}, "best": {}, "exact": {}},
    knobs={**general_knobs(4), "rotation": Knob(values=("small", "best"), stream="rotations")},
    model=("unity", None),
)
