"""Every obligation of a .sog4d bundle under its code; docs/formats/sog4d.md prints this table."""

from __future__ import annotations

from gsplat_tools.errors import CorruptDataError, LimitExceededError, UnsupportedVersionError
from gsplat_tools.formats import _label_delta, _zip
from gsplat_tools.formats._issues import Rule

MAX_CODEBOOK = 65535
"""Most entries of a scale codebook that are written; readers take indices of 16 bits."""

MAX_PALETTE = 65535
"""Most entries of an SH palette."""

SH0_ENTRIES = 256
BAND_COEFFICIENTS = (3, 5, 7)
"""Coefficients of SH bands 1, 2 and 3."""


def _error(meaning: str) -> Rule:
    return Rule(severity="error", meaning=meaning, error=CorruptDataError)


RULES: dict[str, Rule] = {
    **_zip.RULES,
    "meta-missing": _error("meta.json lies at the root of the archive."),
    "meta-encoding": _error("meta.json is UTF-8."),
    "meta-json": _error("meta.json is a JSON object."),
    "missing-field": _error("Required fields are there."),
    "wrong-type": _error("Fields have the type that the format says."),
    "format": _error('"format" is "sog4d".'),
    "version": Rule(severity="error", meaning='"version" is 1 or 2.', error=UnsupportedVersionError),
    "count": _error("splatCount and frameCount are positive."),
    "layout-type": _error('The layout is "row-major" with positive sides.'),
    "layout-small": _error("The layout has a pixel for every splat."),
    "layout-limit": Rule(severity="error", meaning="The layout fits WebP and the size of the file.", error=LimitExceededError),
    "time-type": _error('The time mapping is "uniform" or "explicit".'),
    "time-length": _error("There is one explicit time a frame."),
    "time-value": _error("Explicit times are finite, in [0, 1], and do not decrease."),
    "path": _error("Paths are relative, with / between parts, without :, backslash, empty parts, . or .. ."),
    "path-template": _error("Paths of single frames contain {frame}."),
    "range-length": _error("rangeMin and rangeMax have one vector a frame."),
    "range-value": _error("Position ranges are finite, and min <= max."),
    "codebook-empty": _error("The scale codebook has an entry."),
    "codebook-value": _error("Scale codebook entries are finite and not negative."),
    "sh0-codebook-length": _error("sh0Codebook has 256 entries."),
    "sh0-codebook-value": _error("sh0Codebook entries are finite."),
    "bands": _error("bands is 0 to 3."),
    "palette-count": _error(f"SH palettes have 1 to {MAX_PALETTE} entries."),
    "centroids-type": _error('Centroids are "f16" or "f32".'),
    "labels-encoding": _error('Labels are "full" or "delta-v1".'),
    "segments": _error("Delta segments start at frame 0, follow each other without a gap and cover all frames."),
    "file-missing": _error("Every file that is named is in the archive."),
    "image-format": _error("Images are still lossless WebP."),
    "image-size": _error("Images have the size of the layout."),
    "index-range": _error("Scale indices are below the length of the codebook."),
    "label-range": _error("SH labels are below the number of palette entries."),
    "centroids-size": _error("A centroid file holds exactly its entries."),
    "centroids-value": _error("Centroids are finite."),
    **_label_delta.RULES,
    "vector-list": Rule(
        severity="warning", meaning="Vectors are objects with x, y and z; lists are not read by Unity (normalize repairs)."
    ),
    "json-null": Rule(severity="warning", meaning="No field is null; Unity's reader does not take it."),
    "rotation-zero": Rule(severity="warning", meaning="No rotation is 128 128 128 128, which has no direction."),
    "foreign-sh": Rule(
        severity="info",
        meaning="SH of bundles that this package did not write may be in channel-major order (the existing tool's slip).",
    ),
    "unreferenced-file": Rule(severity="hint", meaning="Files that nothing names only take room."),
}
