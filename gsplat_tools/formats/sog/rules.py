"""Every obligation of a SOG bundle under its code; docs/formats/sog.md prints this table."""

from __future__ import annotations

from gsplat_tools.errors import CorruptDataError, FormatError, LimitExceededError, UnsupportedVersionError
from gsplat_tools.formats import _zip
from gsplat_tools.formats._issues import Issue, Rule, refuse

MAX_PALETTE = 1 << 16
"""Most entries of an SH palette: labels have 16 bits."""

PALETTE_COLUMNS = 64
"""Palette entries side by side in a row of the image of centroids."""

CODEBOOK_SIZE = 256


def _error(meaning: str) -> Rule:
    return Rule(severity="error", meaning=meaning, error=CorruptDataError)


RULES: dict[str, Rule] = {
    **_zip.RULES,
    "meta-missing": _error("meta.json lies at the root of the archive."),
    "meta-json": _error("meta.json is a JSON object in UTF-8."),
    "missing-field": _error("Required fields are there."),
    "wrong-type": _error("Fields have the type that the format says."),
    "version": Rule(
        severity="error", meaning='"version" is 2, or missing in version 1 (1 in lod-meta.json).', error=UnsupportedVersionError
    ),
    "count": _error("Counts are whole numbers that agree with each other."),
    "number": _error("Ranges and codebooks hold finite numbers."),
    "range": _error("Position ranges have min <= max and are those of logarithms: at most 88.73 in size."),
    "codebook-length": _error(f"Codebooks have 1 to {CODEBOOK_SIZE} entries."),
    "codebook-index": _error("Indices are below the length of their codebook."),
    "files": _error("Each attribute names its files, in the order of the format."),
    "path": _error("Files are named by relative paths, with / between parts, without :, backslash, empty parts, . or .. ."),
    "file-missing": _error("Every file that is named is there."),
    "quats-encoding": Rule(
        severity="error", meaning='Rotations of version 1 are "quaternion_packed".', error=UnsupportedVersionError
    ),
    "bands": _error("bands is 0 to 3."),
    "palette-count": _error(f"The SH palette has 1 to {MAX_PALETTE} entries."),
    "palette-size": _error(f"The image of centroids is {PALETTE_COLUMNS} times the coefficients wide and holds all entries."),
    "image-format": _error("Images are still lossless WebP that decompress."),
    "image-size": _error("Every image has a pixel for every splat."),
    "image-limit": Rule(
        severity="error",
        meaning="Images are not far larger than the splats need, and splats claim no more than files can hold.",
        error=LimitExceededError,
    ),
    "lod-tree": _error("The tree of lod-meta.json refers to files, levels and rows that are there."),
    "label-range": Rule(severity="warning", meaning="SH labels are below the number of palette entries; others give no SH."),
    "unknown-model": Rule(severity="warning", meaning='"model" is "default", "antialiased" or "2dgs"; others read as default.'),
    "model-conflict": Rule(severity="warning", meaning='"model" and "antialias" say the same.'),
}


def fault(code: str, message: str, field: str | None = None) -> FormatError:
    """Return the exception for a broken rule."""
    return refuse(Issue(code=code, message=message, field=field), RULES)
