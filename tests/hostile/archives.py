"""ZIP archives whose every field may lie, and WebP and zstd data that lie about their sizes."""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from random import Random
from typing import Any

import numpy as np
from PIL import Image

from tests.hostile.mutations import json_change, json_fields
from tests.hostile.seed import Span

NAMES = (
    b"/etc/passwd", b"../meta.json", b"a/../../b", b"C:\\x", b"a\\b", b"", b".", b"a//b", b"meta.json", b"x\0y", b"\xff\xfe",
    b"n" * 65535, b"sub/meta.json", b"META.JSON", b"folder/", "é.webp".encode(), b"\x1b[31m", b"frames/00000/hi.webp",
)  # fmt: skip
METHODS = (1, 8, 9, 12, 14, 93, 95, 98, 99, 0xFFFF)


@dataclass(frozen=True)
class Entry:
    """A file in an archive; what is None is what it should be."""

    name: bytes
    data: bytes
    method: int = 0
    flags: int = 0
    stored: bytes | None = None
    crc: int | None = None
    size: int | None = None
    stored_size: int | None = None
    offset: int | None = None
    local_name: bytes | None = None
    extra: bytes = b""
    local_extra: int = 0  # how long the local header says that its extra field is; the data follow at once


def deflated(data: bytes) -> bytes:
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    return compressor.compress(data) + compressor.flush()


def zip_file(
    entries: Sequence[Entry],
    *,
    head: bytes = b"",
    comment: bytes = b"",
    count: int | None = None,
    directory_size: int | None = None,
    directory_offset: int | None = None,
    zip64: bytes = b"",
) -> bytes:
    """Return an archive."""
    body, directory = bytearray(head), b""
    for entry in entries:
        stored = entry.stored if entry.stored is not None else deflated(entry.data) if entry.method == 8 else entry.data
        crc = zlib.crc32(entry.data) if entry.crc is None else entry.crc
        size = len(entry.data) if entry.size is None else entry.size
        stored_size = len(stored) if entry.stored_size is None else entry.stored_size
        sizes = struct.pack("<III", crc, stored_size & 0xFFFFFFFF, size & 0xFFFFFFFF)
        offset = len(body) if entry.offset is None else entry.offset
        name = entry.name if entry.local_name is None else entry.local_name
        fields = struct.pack("<HHHH", entry.flags, entry.method, 0, 0x21) + sizes
        body += (
            b"PK\x03\x04" + struct.pack("<H", 20) + fields + struct.pack("<HH", len(name), entry.local_extra) + name + stored
        )
        lengths = struct.pack("<HHHHHII", len(entry.name), len(entry.extra), 0, 0, 0, 0, offset & 0xFFFFFFFF)
        directory += b"PK\x01\x02" + struct.pack("<HH", 20, 20) + fields + lengths + entry.name + entry.extra
    number = len(entries) if count is None else count
    start = len(body) if directory_offset is None else directory_offset
    length = len(directory) if directory_size is None else directory_size
    end = struct.pack("<HHHHIIH", 0, 0, number & 0xFFFF, number & 0xFFFF, length & 0xFFFFFFFF, start & 0xFFFFFFFF, len(comment))
    return bytes(body) + directory + zip64 + b"PK\x05\x06" + end + comment


def entries_of(data: bytes) -> list[Entry]:
    """Return the files of a sound archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [Entry(info.filename.encode(), archive.read(info), 8 * (info.compress_type == 8)) for info in archive.infolist()]


def spans_of(data: bytes, text: str = "meta.json") -> tuple[Span, ...]:
    """Return local headers, the first bytes of binary entries, text entries, and the directory."""
    spans = []
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for info in archive.infolist():
            name_length, extra_length = struct.unpack_from("<HH", data, info.header_offset + 26)
            start = info.header_offset + 30 + name_length + extra_length
            spans.append(Span(info.header_offset, start))
            stop = start + info.compress_size
            spans += text_spans(data, start, stop) if info.filename.endswith(text) else [Span(start, min(stop, start + 32))]
        spans.append(Span(archive.start_dir, len(data)))
    return tuple(span for span in spans if span.stop > span.start)


def text_spans(data: bytes, start: int, stop: int) -> list[Span]:
    """Return the spans of a JSON text; of long lists of numbers the first and the last, which stand for the others."""
    spans, position = [], start
    for match in re.finditer(rb"\[[-+.eE0-9, ]{120,}\]", data[start:stop]):
        spans.append(Span(position, start + match.start() + 24, "text"))
        position = start + match.end() - 24
    return [*spans, Span(position, stop, "text")]


def seal(data: bytes) -> bytes:
    """Make the checksums of stored entries right, in the directory and before the data, as far as they can be found."""
    changed = bytearray(data)
    place = data.find(b"PK\x01\x02")
    while 0 <= place <= len(data) - 46:
        flags_method = struct.unpack_from("<HH", data, place + 8)
        size, _, name_length, extra_length, comment_length = struct.unpack_from("<IIHHH", data, place + 20)
        (offset,) = struct.unpack_from("<I", data, place + 42)
        if flags_method[1] == 0 and offset + 30 <= len(data):
            lengths = struct.unpack_from("<HH", data, offset + 26)
            start = offset + 30 + sum(lengths)
            if start + size <= len(data):
                crc = struct.pack("<I", zlib.crc32(data[start : start + size]))
                changed[place + 16 : place + 20] = changed[offset + 14 : offset + 18] = crc
        place = data.find(b"PK\x01\x02", place + 46 + name_length + extra_length + comment_length)
    return bytes(changed[: len(data)])


def zip_rebuilder(data: bytes) -> Callable[[Random], bytes]:
    """Return a function that assembles relatives of an archive."""
    sound = entries_of(data)

    def rebuild(rng: Random) -> bytes:
        entries = list(sound)
        whole: dict[str, Any] = {}
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            if rng.random() < 0.6:
                index = rng.randrange(len(entries))
                entries[index] = replace(entries[index], data=changed_content(entries[index], rng))
            elif rng.random() < 0.7:
                index = rng.randrange(len(entries))
                entries[index] = _lying_entry(entries[index], entries, rng)
            else:
                _lie_about_all(entries, whole, rng)
            if not entries:
                break
        return zip_file(entries, **whole)

    return rebuild


def zip_relatives(data: bytes, *more: Mapping[str, Callable[[], bytes]]) -> Callable[[], Iterator[tuple[str, bytes]]]:
    """Return a function that yields an archive with every field of its meta.json changed, and files that break a rule."""

    def relatives() -> Iterator[tuple[str, bytes]]:
        for files in more:
            for name, build in files.items():
                yield name, build()
        sound = entries_of(data)
        index = next(i for i, entry in enumerate(sound) if entry.name.endswith(b"meta.json"))
        for what, text in json_fields(sound[index].data):
            yield what, zip_file([*sound[:index], replace(sound[index], data=text), *sound[index + 1 :]])

    return relatives


def changed_content(entry: Entry, rng: Random) -> bytes:
    """Return other contents of an entry: other JSON, another image, other bytes."""
    if entry.name.endswith(b".json"):
        try:
            return json_change(entry.data, rng)
        except ValueError:
            return entry.data
    if entry.data[:4] == b"RIFF":
        return webp_change(entry.data, rng)
    kind = rng.randrange(4)
    if kind == 0:
        return entry.data[: rng.randrange(len(entry.data) + 1)]
    if kind == 1:
        return entry.data + rng.randbytes(rng.randint(1, 9))
    position = rng.randrange(len(entry.data) + 1)
    return (
        entry.data[:position]
        + rng.choice((b"\xff\xff\xff\xff", rng.randbytes(2), b"\0\0\xc0\x7f"))
        + entry.data[position + 4 :]
    )


def _lying_entry(entry: Entry, entries: list[Entry], rng: Random) -> Entry:
    kind = rng.randrange(12)
    if kind == 0:
        return replace(entry, name=rng.choice(NAMES))
    if kind == 1:
        return replace(entry, local_name=rng.choice((b"", b"x", *NAMES[:3])))
    if kind == 2:
        return replace(entry, flags=rng.choice((1, 8, 0x20, 0x40, 0x800, 0x2000, 0xFFFF)))
    if kind == 3:
        return replace(entry, method=rng.choice(METHODS), stored=entry.data)
    if kind == 4:
        return replace(entry, size=rng.choice((0, 1, len(entry.data) + 1, 1 << 20, 1 << 31, 0xFFFFFFFF)))
    if kind == 5:
        return replace(entry, stored_size=rng.choice((0, 1, len(entry.data) + 1, 1 << 31, 0xFFFFFFFF)))
    if kind == 6:
        return replace(entry, offset=rng.choice((0, 1, 30, 1 << 31, 0xFFFFFFFE, 0xFFFFFFFF)))
    if kind == 7:
        return replace(entry, crc=rng.getrandbits(32))
    if kind == 8:  # more than it says, or as much as it says: a bomb either way
        return replace(
            entry, method=8, stored=bomb(), size=rng.choice((10, 1 << 24, BOMB_BYTES)), data=b"", crc=rng.getrandbits(32)
        )
    if kind == 9:
        sizes = struct.pack("<QQQ", *(rng.choice((0, 1, len(entry.data), 1 << 40, (1 << 64) - 1)) for _ in range(3)))
        extra = struct.pack("<HH", 1, rng.choice((0, 4, 8, 16, 24, 60000))) + sizes[: rng.choice((0, 3, 8, 24))]
        return replace(entry, extra=extra, size=rng.choice((None, 0xFFFFFFFF)), stored_size=rng.choice((None, 0xFFFFFFFF)))
    if kind == 10:
        return replace(entry, data=rng.choice(entries).data)
    return replace(entry, extra=rng.randbytes(rng.randint(1, 30)))


def _lie_about_all(entries: list[Entry], whole: dict[str, Any], rng: Random) -> None:
    kind = rng.randrange(9)
    if kind == 0:
        entries.insert(rng.randrange(len(entries) + 1), rng.choice(entries))
    elif kind == 1:
        del entries[rng.randrange(len(entries))]
    elif kind == 2:
        rng.shuffle(entries)
    elif kind == 3:
        whole["comment"] = rng.choice((b"x", b"PK\x05\x06" + bytes(18), b"c" * 65535))
    elif kind == 4:
        whole["head"] = rng.choice((b"#!/bin/sh\n", b"PK\x03\x04", bytes(100)))
    elif kind == 5:
        whole["count"] = rng.choice((0, 1, 65535, len(entries) + 1))
    elif kind == 6:
        whole["directory_size"] = rng.choice((0, 1, 46, 1 << 31, 0xFFFFFFFF))
    elif kind == 7:
        whole["directory_offset"] = rng.choice((0, 1, 1 << 31, 0xFFFFFFFF))
    else:
        record = b"PK\x06\x06" + struct.pack(
            "<QHHIIQQQQ", 44, 45, 45, 0, 0, *(rng.choice((0, 1, 1 << 62, 50)) for _ in range(4))
        )
        whole["zip64"] = record + b"PK\x06\x07" + struct.pack("<IQI", 0, rng.choice((0, 1 << 62, 500)), 1)
        whole["directory_offset"] = whole["count"] = 0xFFFFFFFF


BOMB_BYTES = 256 << 20


@lru_cache(maxsize=1)
def bomb() -> bytes:
    """256 MiB of zeros, deflated."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    part = bytes(1 << 20)
    return b"".join(compressor.compress(part) for _ in range(BOMB_BYTES >> 20)) + compressor.flush()


@lru_cache(maxsize=64)
def picture(width: int, height: int, kind: str = "lossless") -> bytes:
    """Encode an image of one color: lossless, lossy or animated."""
    image = Image.fromarray(np.full((height, width, 4), 7, np.uint8), "RGBA")
    target = io.BytesIO()
    if kind == "animated":
        other = Image.fromarray(np.full((height, width, 4), 200, np.uint8), "RGBA")
        image.save(target, "WEBP", lossless=True, save_all=True, append_images=[other])
    else:
        image.save(target, "WEBP", lossless=kind == "lossless")
    return target.getvalue()


def riff(*chunks: tuple[bytes, bytes]) -> bytes:
    """Assemble a WebP file of chunks."""
    body = b"WEBP" + b"".join(name + struct.pack("<I", len(data)) + data + bytes(len(data) & 1) for name, data in chunks)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def extended(width: int, height: int, data: bytes, flags: int = 0x10) -> bytes:
    """Return the image chunk of a simple file under a VP8X header that says another size."""
    head = bytes([flags, 0, 0, 0]) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    (length,) = struct.unpack_from("<I", data, 16)
    return riff((b"VP8X", head), (data[12:16], data[20 : 20 + length]))


def webp_change(data: bytes, rng: Random) -> bytes:
    """Return another image, or one whose headers lie."""
    kind = rng.randrange(9)
    if kind == 0:
        return data[: rng.randrange(len(data))]
    if kind == 1:
        sides = rng.choice(((1, 1), (2, 2), (3, 2), (64, 1), (5, 5), (600, 400), (192, 2), (16383, 1)))
        return picture(*sides, rng.choice(("lossless", "lossless", "lossy", "animated")))
    if kind == 2:
        return data[:4] + struct.pack("<I", rng.choice((0, 12, len(data), 1 << 31, 0xFFFFFFFF))) + data[8:]
    if kind == 3:
        return data[:12] + rng.choice((b"VP8 ", b"VP8X", b"ANIM", b"ALPH", b"\0\0\0\0")) + data[16:]
    if kind == 4:
        return data[:16] + struct.pack("<I", rng.choice((0, 4, 5, len(data), 0xFFFFFFFF))) + data[20:]
    if kind == 5 and data[12:16] == b"VP8L":  # 14 bits of width, 14 of height, alpha and version
        bits = rng.choice(
            (0, 0xFFFFFFFF, 0x0FFFFFFF, rng.getrandbits(32), struct.unpack_from("<I", data, 21)[0] ^ (1 << rng.randrange(32)))
        )
        return data[:21] + struct.pack("<I", bits) + data[25:]
    if kind == 6 and data[12:16] == b"VP8L":
        width, height = rng.choice(((1, 1), (3, 2), (1 << 24, 1 << 24), (16384, 16384), (5, 1)))
        return extended(width, height, data, rng.choice((0, 0x10, 0x02, 0x12, 0xFF)))
    if kind == 7:
        return rng.choice((b"", b"RIFF", b"RIFF\0\0\0\0WEBP", b"GIF89a" + bytes(20), b"\x89PNG\r\n\x1a\n" + bytes(30)))
    position = rng.randrange(len(data))
    return data[:position] + bytes([rng.randrange(256)]) + data[position + 1 :]
