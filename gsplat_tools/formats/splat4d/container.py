"""Header, section table and META of .splat4d version 2: everything that is said about bytes, checked before any is read.

| bytes | header field |
|---|---|
| 0-7 | magic "SPL4DV02" |
| 8-39 | u32 version 2, headerSize 64, sectionCount, recordSize 64, splatCount, shBands 0..3, timeModel 1 or 2, frameCount |
| 40-47 | u64 sectionTableOffset |
| 48-63 | 0 |

Section table: "SECT", u32 version 1, u32 sectionCount, u32 0, then entries of 32 bytes: fourcc, u32 band, u32 startFrame,
u32 frameCount, u64 offset, u64 length.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import BinaryIO, Literal

from gsplat_tools.cloud import TimeModel
from gsplat_tools.constants import TEMPORAL_CUTOFF
from gsplat_tools.errors import CorruptDataError, GsplatWarning, TruncatedDataError, UnsupportedVersionError
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._stream import read_exactly, stream_size

MAGIC = b"SPL4DV02"
FAMILY = b"SPL4DV"
RECORD_BYTES = 64
HEADER = struct.Struct("<8s8IQ16x")
TABLE_HEADER = struct.Struct("<4s3I")
ENTRY = struct.Struct("<4s3I2Q")
META = struct.Struct("<IfII12I")
BAND_COEFFICIENTS = (3, 5, 7)
TIME_MODELS: dict[int, TimeModel] = {1: "window", 2: "gaussian"}
CENTROID_TYPES = {1: "<f2", 2: "<f4"}
FULL, DELTA = 1, 2
assert HEADER.size == 64
assert ENTRY.size == 32
assert META.size == 64


@dataclass(frozen=True, slots=True)
class Section:
    """An entry of the section table."""

    kind: str
    band: int
    start_frame: int
    frame_count: int
    offset: int
    length: int

    @property
    def name(self) -> str:
        """Kind, band and segment, for messages."""
        if self.kind not in {"SHCT", "SHLB", "SHDL"}:
            return self.kind
        return f"{self.kind} band {self.band}" + (f" frame {self.start_frame}" if self.frame_count else "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """How one SH band is stored; base labels and deltas by segment, one pair for full labels with no delta."""

    number: int
    count: int
    centroids_type: str
    centroids: Section
    labels: tuple[Section, ...]
    deltas: tuple[Section, ...]

    @property
    def labels_encoding(self) -> Literal["full", "delta-v1"]:
        """How labels are stored."""
        return "delta-v1" if self.deltas else "full"


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """What a version 2 file says it holds, checked against its size."""

    splat_count: int
    sh_bands: int
    time_model: TimeModel
    frame_count: int
    temporal_cutoff: float
    delta_segment_length: int
    records: Section
    bands: tuple[Band, ...]
    sections: tuple[Section, ...]
    has_odd_cutoff: bool = False


def parse(stream: BinaryIO) -> Contents:
    """Read header, section table and META of a version 2 file.

    Raises
    ------
    UnsupportedVersionError
        The version of the header, the table or META is another.
    TruncatedDataError
        A section, or the table, ends behind the end of the file.
    CorruptDataError
        Counts, lengths or segments contradict each other, or sections overlap.

    Warns
    -----
    GsplatWarning
        The temporal cutoff is not between 0 and 1, so that 0.01 is used, as the fork does.
    """
    size = stream_size(stream)
    stream.seek(0)
    magic, version, header_size, section_count, record_size, splat_count, bands, model, frames, table_offset = HEADER.unpack(
        read_exactly(stream, HEADER.size, field="header")
    )
    if magic != MAGIC or version != 2:
        message = f"expected {MAGIC!r} of version 2, found {magic!r} of version {version}"
        raise UnsupportedVersionError(message, offset=8, field="version")
    for name, offset, expected, found in (("headerSize", 12, 64, header_size), ("recordSize", 20, RECORD_BYTES, record_size)):
        if found != expected:
            raise CorruptDataError(f"expected {expected}, found {found}", offset=offset, field=name)
    if bands > len(BAND_COEFFICIENTS):
        raise CorruptDataError(f"expected 0 to 3, found {bands}", offset=28, field="shBands")
    if model not in TIME_MODELS:
        raise CorruptDataError(f"expected 1 (window) or 2 (gaussian), found {model}", offset=32, field="timeModel")
    sections = _read_table(stream, size, table_offset, section_count)
    check_splats(splat_count, bands, None, field="splatCount", offset=24, has_motion=True)
    records = _only(sections, "RECS", 0)
    _check_length(records, splat_count * RECORD_BYTES, f"{splat_count} records")
    meta = _only(sections, "META", 0)
    _check_length(meta, META.size, "META version 1")
    stream.seek(meta.offset)
    meta_version, cutoff, segment_length, _, *infos = META.unpack(read_exactly(stream, META.size, field="META"))
    if meta_version != 1:
        raise UnsupportedVersionError(f"expected version 1, found {meta_version}", offset=meta.offset, field="metaVersion")
    has_odd_cutoff = TIME_MODELS[model] == "gaussian" and not 0 < cutoff < 1
    if has_odd_cutoff:
        message = f"expected a temporalGaussianCutoff between 0 and 1, found {cutoff:g}: {TEMPORAL_CUTOFF:g} is used"
        warnings.warn(GsplatWarning(message, code="temporal-cutoff"), stacklevel=2)
    return Contents(
        splat_count=splat_count,
        sh_bands=bands,
        time_model=TIME_MODELS[model],
        frame_count=frames,
        temporal_cutoff=cutoff if TIME_MODELS[model] == "gaussian" and not has_odd_cutoff else TEMPORAL_CUTOFF,
        delta_segment_length=segment_length,
        records=records,
        bands=tuple(
            _band(sections, band, infos[4 * band - 4 : 4 * band], meta.offset + 16 * band, splat_count, frames)
            for band in range(1, bands + 1)
        ),
        sections=sections,
        has_odd_cutoff=has_odd_cutoff,
    )


def _read_table(stream: BinaryIO, size: int, offset: int, count: int) -> tuple[Section, ...]:
    """Return the sections of a table that fits into the file, after checking where they lie."""
    table_size = TABLE_HEADER.size + count * ENTRY.size
    if offset < HEADER.size:
        raise CorruptDataError(f"expected the table behind the header, found offset {offset}", offset=40, field="section table")
    if offset + table_size > size:
        raise TruncatedDataError(
            f"a table of {count} sections needs bytes {offset} to {offset + table_size} of a file of {size} bytes",
            offset=40,
            field="section table",
        )
    stream.seek(offset)
    data = read_exactly(stream, table_size, field="section table")
    magic, version, found, _ = TABLE_HEADER.unpack_from(data)
    if magic != b"SECT":
        raise CorruptDataError(f"expected b'SECT', found {magic!r}", offset=offset, field="section table")
    if version != 1:
        raise UnsupportedVersionError(f"expected version 1, found {version}", offset=offset + 4, field="section table")
    if found != count:
        raise CorruptDataError(
            f"the header counts {count} sections, the table {found}", offset=offset + 8, field="sectionCount"
        )
    sections = tuple(
        Section(kind.decode("latin-1"), *numbers) for kind, *numbers in ENTRY.iter_unpack(data[TABLE_HEADER.size :])
    )
    for index, section in enumerate(sections):
        if section.offset + section.length > size:
            raise TruncatedDataError(
                f"{section.name} is bytes {section.offset} to {section.offset + section.length} of a file of {size} bytes",
                offset=offset + TABLE_HEADER.size + index * ENTRY.size + 16,
                field=section.kind,
            )
    _check_overlaps(sections, offset, table_size)
    return sections


def _check_overlaps(sections: tuple[Section, ...], table_offset: int, table_size: int) -> None:
    """Refuse sections that share bytes with others, the header or the table."""
    spans = [
        Section("header", 0, 0, 0, 0, HEADER.size),
        Section("section table", 0, 0, 0, table_offset, table_size),
        *(section for section in sections if section.length),
    ]
    spans.sort(key=lambda section: (section.offset, section.length))
    for one, other in pairwise(spans):
        # Exporters of the fork stored labels that never change once and named them in every segment.
        is_same = (one.offset, one.length) == (other.offset, other.length)
        if is_same and one.kind == other.kind == "SHLB":
            continue
        if other.offset < one.offset + one.length:
            raise CorruptDataError(
                f"{one.name} is bytes {one.offset} to {one.offset + one.length} and {other.name} bytes {other.offset} to "
                f"{other.offset + other.length}: they overlap",
                offset=other.offset,
                field=other.kind,
            )


def _only(sections: tuple[Section, ...], kind: str, band: int) -> Section:
    """Return the one section of that kind and band."""
    found = [section for section in sections if section.kind == kind and section.band == band]
    if len(found) != 1:
        name = f"{kind} of band {band}" if band else kind
        raise CorruptDataError(f"expected one section {name}, found {len(found)}", field=kind)
    return found[0]


def _check_length(section: Section, expected: int, what: str) -> None:
    if section.length != expected:
        raise CorruptDataError(
            f"{section.name} needs {expected} bytes for {what}, found {section.length}",
            offset=section.offset,
            field=section.kind,
        )


def _band(sections: tuple[Section, ...], band: int, info: list[int], offset: int, splat_count: int, frame_count: int) -> Band:
    """Return how a band is stored, after checking every length and that segments cover all frames."""
    count, centroids_type, encoding, _ = info
    field = f"META sh{band}"
    if not 1 <= count <= 1 << 16:
        raise CorruptDataError(f"expected 1 to 65536 codebook entries, found {count}", offset=offset, field=field)
    if centroids_type not in CENTROID_TYPES:
        message = f"expected centroidsType 1 (f16) or 2 (f32), found {centroids_type}"
        raise CorruptDataError(message, offset=offset + 4, field=field)
    if encoding not in {FULL, DELTA}:
        message = f"expected labelsEncoding 1 (full) or 2 (delta-v1), found {encoding}"
        raise CorruptDataError(message, offset=offset + 8, field=field)
    dtype = CENTROID_TYPES[centroids_type]
    centroids = _only(sections, "SHCT", band)
    scalars = 3 * BAND_COEFFICIENTS[band - 1]
    _check_length(centroids, count * scalars * int(dtype[-1]), f"{count} entries of {scalars} numbers")
    labels = sorted((s for s in sections if (s.kind, s.band) == ("SHLB", band)), key=lambda s: s.start_frame)
    deltas = sorted((s for s in sections if (s.kind, s.band) == ("SHDL", band)), key=lambda s: s.start_frame)
    if encoding == FULL:
        labels, deltas = [_only(sections, "SHLB", band)], []
    else:
        _check_segments(labels, deltas, band, frame_count)
    for section in labels:
        _check_length(section, 2 * splat_count, f"{splat_count} labels")
    return Band(number=band, count=count, centroids_type=dtype, centroids=centroids, labels=tuple(labels), deltas=tuple(deltas))


def _check_segments(labels: list[Section], deltas: list[Section], band: int, frame_count: int) -> None:
    """Refuse segments that do not cover the frames one after the other, or that lack labels or changes."""
    if frame_count == 0:
        raise CorruptDataError("delta-v1 labels need at least one frame, found 0", offset=36, field="frameCount")
    if [(s.start_frame, s.frame_count) for s in labels] != [(s.start_frame, s.frame_count) for s in deltas] or not labels:
        raise CorruptDataError(
            f"expected an SHLB and an SHDL for every segment of band {band}, found {len(labels)} and {len(deltas)}",
            field="SHDL",
        )
    expected = 0
    for section in labels:
        if section.start_frame != expected or section.frame_count == 0:
            raise CorruptDataError(
                f"expected a segment of band {band} from frame {expected}, found {section.frame_count} frames from "
                f"{section.start_frame}",
                field="SHLB",
            )
        expected += section.frame_count
    if expected != frame_count:
        raise CorruptDataError(f"segments of band {band} cover {expected} of {frame_count} frames", field="SHLB")
