"""Relatives of valid files assembled field by field, with fields that lie."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import zstandard

from tests.builders import PlyElement, ply_file, splat_columns
from tests.builders_spz import random_file
from tests.formats.pack.gspk_by_hand import assemble, spark_description
from tests.formats.splat4d import by_hand as splat4d_by_hand
from tests.hostile.mutations import U32, json_change

TYPES = (
    "char",
    "uchar",
    "short",
    "ushort",
    "int",
    "uint",
    "float",
    "double",
    "int8",
    "float32",
    "list uchar int",
    "list char float",
)


def text(sound: bytes) -> Callable[[Random], bytes]:
    """Return a function that changes a JSON file."""

    def rebuild(rng: Random) -> bytes:
        try:
            return json_change(sound, rng)
        except ValueError:
            return sound

    return rebuild


def ply(rng: Random) -> bytes:
    """Return a PLY of another dialect, with other types and counts, and names that are missing or doubled."""
    count = rng.choice((0, 1, 2, 5))
    columns: dict[str, Any] = dict(
        splat_columns(count, rng.choice((0, 1, 2)), kind=rng.choice(("float", "double")), normals=rng.random() < 0.5)
    )
    for _ in range(rng.randrange(4)):
        kind = rng.choice(TYPES)
        values = (
            [[1] * rng.randrange(3) for _ in range(count)]
            if kind.startswith("list")
            else [rng.randrange(100) for _ in range(count)]
        )
        columns[rng.choice((*columns, "vx", "time", "t", "duration", "label", "f_rest_9", "f_rest_0", "scale_2"))] = (
            kind,
            values,
        )
    for _ in range(rng.randrange(3)):
        del columns[rng.choice(list(columns))]
    if rng.random() < 0.3:
        value = rng.choice((float("nan"), float("inf"), -float("inf"), 3e38, 1e-40))
        name = rng.choice(list(columns))
        kind, values = columns[name]
        if kind in {"float", "double"}:
            columns[name] = (kind, [value] * count)
    vertex = PlyElement("vertex", columns, count=rng.choice((None, None, None, count + 1, 0, 1 << 31, 10**17)))
    elements = [vertex]
    if rng.random() < 0.3:
        elements.insert(
            rng.randrange(2), PlyElement(rng.choice(("face", "vertex", "chunk", "sh")), {"i": (rng.choice(TYPES[:9]), [1, 2])})
        )
    comments = rng.sample(
        (
            "origin 1 2 3",
            "origin nan 0 0",
            "origin 1e400 0 0",
            "antialiased 1",
            "time_model gaussian",
            "temporal_cutoff 2",
            "x" * 3000,
            "é",
        ),
        rng.randrange(4),
    )
    encoding = rng.choice(("ascii", "binary_little_endian", "binary_big_endian"))
    return ply_file(*elements, encoding=encoding, comments=comments, newline=rng.choice((b"\n", b"\n", b"\r\n", b"\r")))


def gspk_file(
    layout: str,
    *,
    count: int = 3,
    degree: int = 1,
    facts: dict[str, Any] | None = None,
    arrays: dict[str, Any] | None = None,
    **changes: Any,
) -> bytes:
    """Return a sound file of either layout; `facts` and `arrays` come on top."""
    rng = np.random.default_rng(7)
    description: dict[str, Any] = spark_description(count, degree, layout=layout) | (facts or {})
    bands = {1: 2, 2: 4, 3: 4, 4: 4}
    if layout == "spark":
        streams = {"packed": ("u32", rng.integers(0, 1 << 28, (count, 4)))}
        streams |= {f"sh{band}": ("u32", rng.integers(0, 1 << 28, (count, bands[band]))) for band in range(1, degree + 1)}
    else:
        widths = {"positions": 3, "colors": 4, "scales": 3, "rotations": 4}
        streams = {name: ("f32", rng.random((count, width))) for name, width in widths.items()}
        streams |= {"shs": ("f32", rng.random((count, (degree + 1) ** 2 - 1, 3)))} if degree else {}
    return assemble(description, streams | (arrays or {}), **changes)


def gspk(layout: str) -> Callable[[Random], bytes]:
    """Return a function that assembles a .gspk whose description or frames lie."""

    def rebuild(rng: Random) -> bytes:
        changes: dict[str, Any] = {"codec": rng.choice(("zstd", "zstd", "none")), "json_last": True}
        if rng.random() < 0.4:
            name = rng.choice(("packed", "sh1") if layout == "spark" else ("positions", "shs"))
            changes["raw_change"] = {(name, rng.randrange(2)): zstd_frame(rng, rng.choice((8, 16, 24, 36, 72)))}

        def change(description: dict[str, Any]) -> None:
            if rng.random() < 0.75:
                try:
                    changed = json.loads(json_change(json.dumps(description).encode(), rng))
                except (ValueError, RecursionError):
                    return
                if isinstance(changed, dict):
                    description.clear()
                    description.update(changed)

        try:
            return gspk_file(layout, change=change, **changes)
        except RecursionError:  # of the encoder
            return gspk_file(layout, **changes)

    return rebuild


def zstd_frame(rng: Random, size: int) -> bytes:
    """Return a frame, or frames, that may hold `size` bytes."""
    raw = rng.randbytes(size)
    kind = rng.randrange(9)
    if kind == 0:
        return zstandard.ZstdCompressor(write_content_size=False).compress(raw)
    if kind == 1:
        return zstandard.ZstdCompressor(write_checksum=True).compress(raw)
    if kind == 2:  # a window of 128 MiB and no content size
        return bytes.fromhex("28b52ffd00") + bytes([17 << 3]) + (size << 3 | 1).to_bytes(3, "little") + raw
    if kind == 3:
        return zstandard.ZstdCompressor().compress(bytes(1 << 22))
    if kind == 4:
        return b"\x50\x2a\x4d\x18" + struct.pack("<I", rng.choice((0, 4, 1 << 31))) + bytes(4) + zstandard.compress(raw)
    if kind == 5:
        return zstandard.compress(raw) + zstandard.compress(raw)
    if kind == 6:  # says that it holds 2^62 bytes
        return (
            bytes.fromhex("28b52ffde0")
            + struct.pack("<Q", rng.choice((1 << 62, 1 << 31, size)))
            + (size << 3 | 1).to_bytes(3, "little")
            + raw
        )
    if kind == 7:
        return zstandard.compress(raw)[: rng.randrange(12)]
    frame = bytearray(zstandard.compress(raw))
    frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
    return bytes(frame)


def spz(rng: Random) -> bytes:
    """Return an SPZ of any version whose header, table or streams lie, as it is before gzip."""
    version = rng.choice((1, 2, 3))
    degree = rng.randrange(5)
    file = random_file(rng.choice((0, 1, 3)), version=version, sh_degree=degree)
    if rng.random() < 0.5:
        file.count = rng.choice((*U32, 4, 1 << 20))
    if rng.random() < 0.2:
        file.sh_degree = rng.randrange(7) if rng.random() < 0.2 else degree
    file.fractional_bits = rng.choice((0, 12, 24, 25, 31, 32, 255))
    file.flags = rng.choice((0, 1, 2, 3, 255))
    kinds = (0xADBE0003, 0xADBE0002, 0, 0xFFFFFFFF)
    file.extensions = [(rng.choice(kinds), rng.randbytes(rng.choice((0, 4, 4, 8)))) for _ in range(rng.randrange(3))]
    file = replace(file, version=rng.choice((version, version, version, 0, 4, 1 << 31)))
    return file.raw()


def spz_4(rng: Random) -> bytes:
    """Return an SPZ of version 4 whose header, table or streams lie."""
    file = random_file(rng.choice((0, 1, 3)), version=4, sh_degree=rng.randrange(5))
    names = [name for name in ("positions", "alphas", "colors", "scales", "rotations", "sh") if getattr(file, name)]
    data = bytearray(file.data())
    if not names:
        return bytes(data)
    frames = [zstandard.compress(getattr(file, name)) for name in names]
    lengths = [len(getattr(file, name)) for name in names]
    index = rng.randrange(len(names))
    if rng.random() < 0.7:
        frames[index] = zstd_frame(rng, lengths[index])
    if rng.random() < 0.3:
        lengths[index] = rng.choice((0, 1, lengths[index] + 1, 1 << 31, (1 << 64) - 1))
    table = b"".join(
        struct.pack("<QQ", len(frame) if rng.random() < 0.97 else rng.choice((0, 1 << 63, 5)), length)
        for frame, length in zip(frames, lengths, strict=True)
    )
    toc = 32 if rng.random() < 0.9 else rng.choice((0, 31, 33, 1 << 31, 0xFFFFFFFF))
    header = bytearray(data[:32])
    header[16:20] = struct.pack("<I", toc)
    if rng.random() < 0.2:
        header[rng.choice((8, 12, 13, 14, 15))] = rng.randrange(256)
    return bytes(header) + table + b"".join(frames) + (b"x" if rng.random() < 0.05 else b"")


def gzipped_spz_4(rng: Random) -> bytes:
    """Return a version 4 header where version 3 belongs."""
    return gzip.compress(spz_4(rng), 1, mtime=0)


def splat4d(rng: Random) -> bytes:
    """Return a .splat4d whose header, sections or META lie."""
    make = rng.choice((splat4d_by_hand.plain, splat4d_by_hand.with_band, splat4d_by_hand.with_deltas))
    file = make()
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.4:
            name = rng.choice(
                ("splats", "bands", "time_model", "frames", "section_count", "table_count", "table_version", "table_offset")
            )
            setattr(file, name, rng.choice((*U32, 2, 3, 4, 5, 64)))
            continue
        section = rng.choice(file.sections)
        kind = rng.randrange(7)
        if kind == 0:
            section.kind = rng.choice((b"RECS", b"META", b"SHCT", b"SHLB", b"SHDL", b"XXXX", b"\xff\0\xff\0"))
        elif kind == 1:
            section.band = rng.choice((0, 1, 2, 3, 4, 0xFFFFFFFF))
        elif kind == 2:
            section.start, section.frames = rng.choice((0, 1, 3, 0xFFFFFFFF)), rng.choice((0, 1, 2, 5, 0xFFFFFFFF))
        elif kind == 3:
            section.offset = rng.choice((0, 1, 64, 200, 1 << 31, (1 << 64) - 1))
        elif kind == 4:
            section.length = rng.choice((0, 1, 64, 200, 1 << 31, (1 << 64) - 1))
        elif kind == 5 and section.data:
            place = rng.randrange(len(section.data))
            section.data = (
                section.data[:place] + struct.pack("<I", rng.choice((*U32, 2, 0x7FC00000))) + section.data[place + 4 :]
            )
        else:
            file.sections = (
                [*file.sections, section]
                if rng.random() < 0.5
                else [s for s in file.sections if s is not section] or file.sections
            )
    return file.build()
