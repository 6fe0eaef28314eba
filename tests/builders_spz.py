"""SPZ files assembled by hand with struct, zlib and zstd, independent of the package's writer."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import zstandard

REST = (0, 3, 8, 15, 24)


@dataclass
class SpzFile:
    """Attributes as bytes, N rows each, and what the headers say."""

    version: int = 4
    sh_degree: int = 0
    fractional_bits: int = 12
    flags: int = 0
    positions: bytes = b""
    alphas: bytes = b""
    colors: bytes = b""
    scales: bytes = b""
    rotations: bytes = b""
    sh: bytes = b""
    extensions: Sequence[tuple[int, bytes]] = field(default_factory=list)
    count: int | None = None
    streams: int | None = None

    @property
    def attributes(self) -> list[bytes]:
        return [self.positions, self.alphas, self.colors, self.scales, self.rotations, self.sh]

    def extension_block(self) -> bytes:
        return b"".join(struct.pack("<II", kind, len(payload)) + payload for kind, payload in self.extensions)

    def header(self) -> bytes:
        count = len(self.alphas) if self.count is None else self.count
        return struct.pack("<4sIIBBB", b"NGSP", self.version, count, self.sh_degree, self.fractional_bits, self.flags)

    def raw(self) -> bytes:
        """Versions 1 to 3 before compression."""
        return self.header() + b"\0" + b"".join(self.attributes) + self.extension_block()

    def legacy(self) -> bytes:
        compressor = zlib.compressobj(6, zlib.DEFLATED, 31)
        return compressor.compress(self.raw()) + compressor.flush()

    def zstd(self) -> bytes:
        present = [data for data in self.attributes if data]
        frames = [zstandard.ZstdCompressor(level=1).compress(data) for data in present]
        block = self.extension_block()
        number = len(present) if self.streams is None else self.streams
        fixed = self.header() + struct.pack("<BI12s", number, 32 + len(block), bytes(12))
        table = b"".join(struct.pack("<QQ", len(f), len(d)) for f, d in zip(frames, present, strict=True))
        return fixed + block + table + b"".join(frames)

    def data(self) -> bytes:
        return self.zstd() if self.version >= 4 else self.legacy()


def fixed24(values: Sequence[int]) -> bytes:
    """24-bit little-endian numbers, two's complement."""
    return b"".join(struct.pack("<i", value)[:3] for value in values)


def random_file(count: int, *, version: int = 4, sh_degree: int = 0, seed: int = 0) -> SpzFile:
    """Bytes at random."""
    rng = np.random.default_rng(seed)

    def data(width: int) -> bytes:
        return bytes(rng.integers(0, 256, count * width, np.uint8))

    file = SpzFile(version=version, sh_degree=sh_degree)
    halves = rng.normal(size=3 * count).astype("<f2").tobytes()
    return replace(
        file,
        positions=halves if version == 1 else data(9),
        alphas=data(1),
        colors=data(3),
        scales=data(3),
        rotations=data(4 if version >= 3 else 3),
        sh=data(3 * REST[sh_degree]),
    )
