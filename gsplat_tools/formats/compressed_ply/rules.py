"""Every obligation of a compressed.ply under its code; docs/formats/compressed-ply.md prints this table."""

from __future__ import annotations

from gsplat_tools.errors import UnsupportedVersionError
from gsplat_tools.formats._issues import Rule

RULES: dict[str, Rule] = {
    "binary": Rule(severity="error", meaning="The file is binary.", error=UnsupportedVersionError),
    "header": Rule(severity="error", meaning="The header is a PLY header, to its end."),
    "chunk": Rule(severity="error", meaning="There is a box, of floats, for every 256 splats, and its rows are there."),
    "vertex": Rule(severity="error", meaning="There are four uint words a splat, and their rows are there."),
    "sh": Rule(severity="error", meaning="SH has 9, 24, 45 or 72 uchar values a splat, and their rows are there."),
    "left-out-elements": Rule(severity="warning", meaning="There are no other elements and properties; they are left out."),
    "box": Rule(severity="warning", meaning="Boxes are finite and min <= max."),
}

CODES = {
    "format": "binary",
    "element": "header",
    "header": "header",
    "end_header": "header",
    "chunk": "chunk",
    "vertex": "vertex",
    "sh": "sh",
}
"""Rule by the first word of the field that a refusal is about."""
