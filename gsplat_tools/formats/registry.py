"""Every format, in the order in which a file's first bytes are tried."""

from __future__ import annotations

from pathlib import Path

from gsplat_tools.errors import CapabilityError, UnknownFormatError
from gsplat_tools.formats import compressed_ply, ply, sog, sog4d, splat, splat4d, spz, visionary
from gsplat_tools.formats.base import SNIFF_BYTES, Format
from gsplat_tools.formats.pack import gscc, spark, uncompressed

_MODULES: tuple[Format, ...] = (
    compressed_ply.FORMAT,
    ply.FORMAT,
    spark.FORMAT,
    uncompressed.FORMAT,
    gscc.FORMAT,
    sog.FORMAT,
    sog4d.FORMAT,
    spz.FORMAT,
    splat.FORMAT,
    splat4d.FORMAT,
    *visionary.FORMATS,
)

FORMATS: dict[str, Format] = {record.id: record for record in _MODULES}


def find_format(format_id: str) -> Format:
    """Return the format of that id.

    Raises
    ------
    CapabilityError
        There is none.
    """
    try:
        return FORMATS[format_id]
    except KeyError:
        raise CapabilityError(f"unknown format {format_id!r}; known are {', '.join(FORMATS)}") from None


def format_of_extension(path: Path) -> Format | None:
    """Return the first format whose extension ends the file's name; the longest extension wins."""
    name = path.name.lower()
    candidates = [
        (len(extension), -index, record)
        for index, record in enumerate(FORMATS.values())
        for extension in record.extensions
        if name.endswith(extension)
    ]
    return max(candidates, key=lambda c: c[:2])[2] if candidates else None


def detect(head: bytes, path: Path | None = None) -> Format:
    """Return the format of a file from its first bytes, then from its name.

    Parameters
    ----------
    head
        The first SNIFF_BYTES bytes of the file, or all of a shorter one.
    path
        Name of the file, for formats without a signature.

    Raises
    ------
    UnknownFormatError
        Neither the bytes nor the extension belong to a format.
    """
    for record in FORMATS.values():
        if record.matches(head[:SNIFF_BYTES]):
            return record
    record_by_name = None if path is None else format_of_extension(path)
    if record_by_name is not None:
        return record_by_name
    known = sorted({extension for record in FORMATS.values() for extension in record.extensions})
    raise UnknownFormatError(
        f"no format claims this file (it starts with {head[:8]!r}); known extensions are {', '.join(known)}", path=path
    )
