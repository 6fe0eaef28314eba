"""Every obligation of an SPZ file under its code; docs/formats/spz.md prints this table."""

from __future__ import annotations

import numpy as np

from gsplat_tools.errors import CorruptDataError, FormatError, LimitExceededError, TruncatedDataError, UnsupportedVersionError
from gsplat_tools.formats._issues import Issue, Rule
from gsplat_tools.formats.spz.header import Header
from gsplat_tools.formats.spz.payload import Payload


def _error(meaning: str, error: type[FormatError] = CorruptDataError) -> Rule:
    return Rule(severity="error", meaning=meaning, error=error)


RULES: dict[str, Rule] = {
    "header": _error("The header is there.", TruncatedDataError),
    "magic": _error("It starts with NGSP."),
    "version": _error("1 to 3 in gzip, 4 without.", UnsupportedVersionError),
    "count": _error("No more splats than 2^31 - 1 and than the bytes can hold.", LimitExceededError),
    "degree": _error("The SH degree is 0 to 4."),
    "fractional-bits": _error("At most 24 bits lie behind the point."),
    "streams": _error("There is a stream for each attribute that has bytes."),
    "table": _error("The table of contents is there, and its streams end with the file."),
    "extensions": _error("Extension records end with their block; a coordinate system is one of the sixteen."),
    "attribute": _error("Every attribute decompresses to its length."),
    "left-out-extensions": Rule(severity="warning", meaning="Extensions are understood; others, and cameras, are left out."),
    "position-ends": Rule(
        severity="warning", meaning="Positions stay off the ends of 24 bits, where writers clamp, or wrap around."
    ),
}

CODES = {
    "header": "header",
    "magic": "magic",
    "version": "version",
    "numPoints": "count",
    "shDegree": "degree",
    "fractionalBits": "fractional-bits",
    "numStreams": "streams",
    "tocByteOffset": "table",
    "table of contents": "table",
    "extensions": "extensions",
    **dict.fromkeys(("positions", "alphas", "colors", "scales", "rotations", "sh"), "attribute"),
}
"""Rule by the field that a refusal is about."""

_HIGHEST, _LOWEST = (1 << 23) - 1, -(1 << 23)


def remarks(header: Header, payload: Payload) -> list[Issue]:
    """Return what is odd about bytes that can be read."""
    if header.version == 1 or not header.num_splats:
        return []
    parts = payload["positions"].reshape(header.num_splats, 3, 3)
    codes = (
        parts[..., 0].astype(np.int32)
        | parts[..., 1].astype(np.int32) << 8
        | parts[..., 2].view(np.int8).astype(np.int32) << 16
    )
    is_end = ((codes == _HIGHEST) | (codes == _LOWEST)).any(axis=1)
    count = int(np.count_nonzero(is_end))
    if not count:
        return []
    message = f"{count} splats lie at an end of 24 bits, {_HIGHEST * 0.5**header.fractional_bits:.6g} from the origin"
    return [Issue(code="position-ends", message=message, field="positions", splat=int(np.argmax(is_end)), count=count)]
