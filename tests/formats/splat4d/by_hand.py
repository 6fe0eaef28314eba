"""Files of .splat4d assembled with struct from the byte tables, independent of the package's writer."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field


def record(
    *,
    mean: Sequence[float] = (1, 2, 3),
    scale: Sequence[float] = (0.5, 0.25, 2),
    rgba: Sequence[int] = (255, 0, 51, 204),
    quat: Sequence[int] = (128, 255, 128, 128),
    velocity: Sequence[float] = (0.5, 0, -1),
    time: float = 0.25,
    duration: float = 0.5,
) -> bytes:
    return struct.pack("<6f8B3f2f12x", *mean, *scale, *rgba, *quat, *velocity, time, duration)


def delta(
    start: int, frames: int, splats: int, labels: int, blocks: Sequence[Sequence[tuple[int, int]]], **changes: bytes
) -> bytes:
    """A label delta; `magic` and `tail` may be changed."""
    data = changes.get("magic", b"SPL4DLB1") + struct.pack("<5I", 1, start, frames, splats, labels)
    for block in blocks:
        data += struct.pack("<I", len(block)) + b"".join(struct.pack("<IHH", *update, 0) for update in block)
    return data + changes.get("tail", b"")


@dataclass
class Section:
    kind: bytes
    data: bytes
    band: int = 0
    start: int = 0
    frames: int = 0
    offset: int | None = None
    length: int | None = None
    shared_with: int | None = None


@dataclass
class File:
    """A version 2 file; every field may be made to lie."""

    sections: list[Section]
    splats: int
    bands: int = 0
    time_model: int = 1
    frames: int = 0
    magic: bytes = b"SPL4DV02"
    version: int = 2
    header_size: int = 64
    record_size: int = 64
    section_count: int | None = None
    table_count: int | None = None
    table_magic: bytes = b"SECT"
    table_version: int = 1
    table_offset: int | None = None
    gaps: list[int] = field(default_factory=list)

    def build(self) -> bytes:
        body, entries, places = b"", b"", list[int]()
        for section in self.sections:
            if section.shared_with is None:
                body += bytes(-len(body) % 4)
                places.append(64 + len(body))
                body += section.data
            else:
                places.append(places[section.shared_with])
            offset = places[-1] if section.offset is None else section.offset
            length = len(section.data) if section.length is None else section.length
            entries += section.kind + struct.pack("<3I2Q", section.band, section.start, section.frames, offset, length)
        count = len(self.sections)
        table = self.table_magic + struct.pack(
            "<3I", self.table_version, count if self.table_count is None else self.table_count, 0
        )
        header = self.magic + struct.pack(
            "<8IQ16x",
            self.version,
            self.header_size,
            count if self.section_count is None else self.section_count,
            self.record_size,
            self.splats,
            self.bands,
            self.time_model,
            self.frames,
            64 + len(body) if self.table_offset is None else self.table_offset,
        )
        return header + body + table + entries


def meta(*infos: tuple[int, int, int], cutoff: float = 0.01, version: int = 1, segment_length: int = 0) -> Section:
    """META with (codebookCount, centroidsType, labelsEncoding) of the bands that there are."""
    padded = [*infos, *[(0, 0, 0)] * (3 - len(infos))]
    numbers = [number for info in padded for number in (*info, 0)]
    return Section(b"META", struct.pack("<IfII12I", version, cutoff, segment_length, 0, *numbers))


def plain(*records: bytes, **changes: object) -> File:
    """A file without SH."""
    rows = records or (record(),)
    return File([Section(b"RECS", b"".join(rows)), meta()], len(rows), **changes)  # type: ignore[arg-type]


SPLATS = 3
BAND_1 = [[float(entry * 10 + i) for i in range(9)] for entry in range(2)]
LABELS = [1, 0, 1]


def with_band(labels: Sequence[int] = LABELS, **changes: object) -> File:
    """Three splats with one band: two entries in float32, labels stored whole."""
    sections = [
        Section(b"RECS", record() * SPLATS),
        meta((2, 2, 1)),
        Section(b"SHCT", b"".join(struct.pack("<9f", *entry) for entry in BAND_1), 1),
        Section(b"SHLB", struct.pack(f"<{SPLATS}H", *labels), 1),
    ]
    return File(sections, SPLATS, bands=1, **changes)  # type: ignore[arg-type]


def with_deltas(shares_labels: bool = False) -> File:
    """Three splats, one band, five frames in segments of three and two; labels change in frames 2 and 4.

    Labels by frame: 101, 101, 001, 110, 111; with `shares_labels` all segments start from 101 and nothing changes.
    """
    blocks = [[[], []], [[]]] if shares_labels else [[[], [(0, 0)]], [[(2, 1)]]]
    starts = [LABELS, LABELS if shares_labels else [1, 1, 0]]
    sections = with_band().sections[:3]
    sections[1] = meta((2, 2, 2), segment_length=3)
    for index, (start, frames) in enumerate(((0, 3), (3, 2))):
        whole = struct.pack(f"<{SPLATS}H", *starts[index])
        shared = 3 if shares_labels and index else None
        sections.append(Section(b"SHLB", whole, 1, start, frames, shared_with=shared))
        magic = (b"SPL4DLB1", b"SOG4DLB1")[index]
        sections.append(Section(b"SHDL", delta(start, frames, SPLATS, 2, blocks[index], magic=magic), 1, start, frames))
    return File(sections, SPLATS, bands=1, frames=5)
