"""Assembles .gspk files from docs/formats/gspk.md, apart from the package's writer, so that they can be wrong on purpose."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

ALIGNMENT = 64
SPARE = 1024
"""Bytes left free behind the description: its length must not depend on the offsets in it, and tests make it longer."""


def build_gspk(
    arrays: Mapping[str, NDArray[Any]],
    *,
    layout: str = "spark",
    degree: int = 0,
    codec: str = "zstd",
    frame_rows: int = 65536,
    **description: Any,
) -> bytes:
    """Return a pack of `arrays`, f32 or u32 with N rows each; `description` adds to the JSON or replaces what is in it."""
    count = len(next(iter(arrays.values())))
    streams, stored = [], []
    for name, array in arrays.items():
        frames = [array[start : start + frame_rows].tobytes() for start in range(0, count, frame_rows)]
        kept = frames if codec == "none" else [zstandard.ZstdCompressor().compress(frame) for frame in frames]
        streams.append(
            {
                "name": name,
                "dtype": {"f": "f32", "u": "u32"}[array.dtype.kind],
                "shape": list(array.shape),
                "offset": 0,
                "raw_length": array.nbytes,
                "stored_length": sum(map(len, kept)),
                "codec": codec,
                "frames": [len(frame) for frame in kept],
                "crc32": [zlib.crc32(frame) for frame in frames],
            }
        )
        stored.append(b"".join(kept))
    content = {"layout": layout, "count": count, "degree": degree, "frame_rows": frame_rows, "streams": streams, **description}
    place = _align(ALIGNMENT + len(json.dumps(content)) + SPARE)
    body = b""
    for stream, data in zip(streams, stored, strict=True):
        stream["offset"] = place + len(body)
        body += data + b"\0" * (_align(len(data)) - len(data))
    return assemble(content, body, place)


def assemble(content: Mapping[str, Any], body: bytes, place: int) -> bytes:
    """Return a file with this description, and `body` from byte `place` on."""
    text = json.dumps(content).encode()
    padding = b"\0" * (place - ALIGNMENT - len(text))
    layout = int(content["layout"] == "uncompressed")
    header = struct.pack("<4sIQQQII24x", b"GSPK", 1, place + len(body), ALIGNMENT, len(text), zlib.crc32(text), layout)
    return header + text + padding + body


def change_description(file: bytes, change: Any) -> bytes:
    """Return `file` with its description changed in place by the function `change`, checksum and lengths included."""
    (length,) = struct.unpack_from("<Q", file, 24)
    content = json.loads(file[ALIGNMENT : ALIGNMENT + length])
    place = min((stream["offset"] for stream in content["streams"]), default=len(file))
    change(content)
    return assemble(content, file[place:], place)


def make_words(
    rng: np.random.Generator, num_splats: int, degree: int, *, scale_bytes: tuple[int, int]
) -> dict[str, NDArray[np.uint32]]:
    """Return random words of the Spark layout, each a splat within a few units of the origin."""
    rows = rng.integers(0, 256, (num_splats, 16), np.uint8)
    rows[:, 4:10] = rng.normal(0, 0.8, (num_splats, 3)).astype("<f2").view(np.uint8)
    rows[:, 12:15] = rng.integers(*scale_bytes, (num_splats, 3))
    words = {"packed": rows.view("<u4").copy()}
    for band in range(1, degree + 1):
        words[f"sh{band}"] = rng.integers(0, 2**32, (num_splats, 2 if band == 1 else 4), np.uint32)
    return words


def _align(length: int) -> int:
    """Round up to where a stream may start."""
    return -(-length // ALIGNMENT) * ALIGNMENT
