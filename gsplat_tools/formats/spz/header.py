"""Headers and extension records of .spz; the byte tables are docs/formats/spz.md."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from gsplat_tools.attributes.coordinate_systems import UNKNOWN, Y_UP_OR_DOWN, Z_UP_OR_DOWN
from gsplat_tools.cloud import REST_COEFFICIENTS
from gsplat_tools.constants import MAX_SH_DEGREE
from gsplat_tools.errors import CapabilityError, CorruptDataError, LimitExceededError, UnsupportedVersionError
from gsplat_tools.formats._limits import check_splats

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
READ_VERSIONS = (1, 2, 3, 4)
WRITE_VERSIONS = (2, 3, 4)
FIRST_ZSTD_VERSION = 4
FIRST_SMALLEST_THREE_VERSION = 3

LEGACY_HEADER = struct.Struct("<4sIIBBBB")
ZSTD_HEADER = struct.Struct("<4sIIBBBBI12s")
assert (LEGACY_HEADER.size, ZSTD_HEADER.size) == (16, 32)

ANTIALIASED, HAS_EXTENSIONS = 1, 2
MAX_SPLATS = (1 << 31) - 1
MAX_FRACTIONAL_BITS = 24
"""More would leave whole numbers out; the reference reader has the same limit or one bit less."""

COORDINATE_SYSTEM = 0xADBE0003
SAFE_ORBIT_CAMERA = 0xADBE0002
SYSTEMS = (UNKNOWN, *Y_UP_OR_DOWN, *Z_UP_OR_DOWN)
"""Coordinate systems by their number in the extension."""

_RECORD = struct.Struct("<II")


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What a file says before its data.

    Parameters
    ----------
    version, num_splats, sh_degree, fractional_bits, flags
        As in the file.
    extensions
        (type, payload) of the records, in order.
    """

    version: int
    num_splats: int
    sh_degree: int
    fractional_bits: int
    flags: int
    extensions: tuple[tuple[int, bytes], ...] = ()

    def attributes(self) -> dict[str, int]:
        """Return the bytes a splat of every attribute, in the order of the file."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colors": 3,
            "scales": 3,
            "rotations": 4 if self.version >= FIRST_SMALLEST_THREE_VERSION else 3,
            "sh": 3 * REST_COEFFICIENTS[self.sh_degree],
        }

    def raw_length(self) -> int:
        """Return the bytes of all attributes."""
        return self.num_splats * sum(self.attributes().values())

    @property
    def splat_model(self) -> str:
        """Splat model that the flags state."""
        return "antialiased" if self.flags & ANTIALIASED else "default"

    @property
    def coordinate_system(self) -> str:
        """Axis letters that the extension states, or "unknown"."""
        for kind, payload in self.extensions:
            if kind == COORDINATE_SYSTEM:
                return SYSTEMS[int.from_bytes(payload, "little")]
        return UNKNOWN


def check_fields(header: Header, *, available: int) -> None:
    """Hold the fields against what the format allows and the bytes that are there.

    Raises
    ------
    CorruptDataError, LimitExceededError
        A field is out of range, or claims far more than `available` bytes can hold.
    """
    if header.num_splats > MAX_SPLATS:
        raise LimitExceededError(
            f"expected at most {MAX_SPLATS} splats, found {header.num_splats}", field="numPoints", offset=8
        )
    if header.sh_degree > MAX_SH_DEGREE:
        raise CorruptDataError(f"expected 0 to {MAX_SH_DEGREE}, found {header.sh_degree}", field="shDegree", offset=12)
    if header.version > 1 and header.fractional_bits > MAX_FRACTIONAL_BITS:
        raise CorruptDataError(
            f"expected at most {MAX_FRACTIONAL_BITS}, found {header.fractional_bits}", field="fractionalBits", offset=13
        )
    check_splats(header.num_splats, header.sh_degree, available, field="numPoints", offset=8)


def check_version(version: int, known: tuple[int, ...], how: str) -> None:
    """Refuse a version that does not belong to this kind of container."""
    if version not in known:
        raise UnsupportedVersionError(
            f"version {version} is not known; {how} files have version {' to '.join(map(str, {known[0]: 0, known[-1]: 0}))}",
            field="version",
            offset=4,
        )


def parse_extensions(block: bytes, offset: int) -> tuple[tuple[int, bytes], ...]:
    """Return the records of an extension block that starts at `offset` of the (uncompressed) file.

    Raises
    ------
    CorruptDataError
        A record does not end within the block, or the coordinate system is none of the sixteen.
    """
    records = []
    position = 0
    while position < len(block):
        start = position + _RECORD.size
        if start > len(block):
            raise CorruptDataError(
                f"{len(block) - position} bytes are left, a record has at least {_RECORD.size}",
                field="extensions",
                offset=offset + position,
            )
        kind, length = _RECORD.unpack_from(block, position)
        if length > len(block) - start:
            raise CorruptDataError(
                f"record 0x{kind:08x} claims {length} bytes and {len(block) - start} are left",
                field="extensions",
                offset=offset + position,
            )
        payload = block[start : start + length]
        if kind == COORDINATE_SYSTEM and (length != 4 or int.from_bytes(payload, "little") >= len(SYSTEMS)):
            raise CorruptDataError(
                f"expected the number of a coordinate system, 0 to {len(SYSTEMS) - 1} in 4 bytes, found {payload.hex()}",
                field="extensions",
                offset=offset + start,
            )
        records.append((kind, payload))
        position = start + length
    return tuple(records)


def coordinate_record(system: str) -> bytes:
    """Return the extension block that names a coordinate system; nothing for an unknown one.

    Raises
    ------
    CapabilityError
        SPZ has no number for it.
    """
    if system == UNKNOWN:
        return b""
    if system not in SYSTEMS:
        raise CapabilityError(
            f"SPZ can name {', '.join(SYSTEMS[1:])}, not {system}; use --target-coordinates RUB", field="coordinate_system"
        )
    return _RECORD.pack(COORDINATE_SYSTEM, 4) + SYSTEMS.index(system).to_bytes(4, "little")
