"""What comments of a PLY say about the cloud as a whole, read and written; shared by both dialects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.coordinate_systems import is_known
from gsplat_tools.cloud import GaussianCloud, SplatModel, TimeModel, source_format_of
from gsplat_tools.constants import TEMPORAL_CUTOFF
from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats._ply_header import PlyHeader

_MODEL_COMMENTS: dict[tuple[str, str], SplatModel] = {
    ("splatrendermode", "default"): "default",
    ("splatrendermode", "mip"): "antialiased",
    ("splatrendermode", "2dgs"): "2dgs",
    ("antialiased", "0"): "default",
    ("antialiased", "1"): "antialiased",
}


@dataclass(frozen=True, slots=True)
class SplatComments:
    """What comments say about the cloud as a whole."""

    splat_model: SplatModel = "default"
    coordinate_system: str = "unknown"
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    time_model: TimeModel | None = None
    temporal_cutoff: float = TEMPORAL_CUTOFF
    source_format: str = ""


def splat_comments(header: PlyHeader, *, is_flat: bool) -> SplatComments:
    """Return what the comments say; comments that are not understood say nothing.

    Parameters
    ----------
    header
        Of the file.
    is_flat
        Whether scale_2 is missing, which makes the model "2dgs".

    Raises
    ------
    CorruptDataError
        An origin that is not three finite numbers.

    Source
    ------
    `SplatRenderMode: default | mip | 2dgs` is Brush's comment, `antialiased 0 | 1` is Postshot's; the last one wins, as in
    splat-transform. origin, coordinate_system, time_model, temporal_cutoff and source_format are ours.
    """
    model: SplatModel = "default"
    system, origin = "unknown", np.zeros(3)
    time_model: TimeModel | None = None
    cutoff = TEMPORAL_CUTOFF
    source = ""
    for comment in header.comments:
        words = comment.replace(":", " ").split()
        key, values = (words[0].lower(), words[1:]) if words else ("", [])
        if key in {"splatrendermode", "antialiased"} and len(values) == 1:
            model = _MODEL_COMMENTS.get((key, values[0].lower()), model)
        elif key == "coordinate_system" and len(values) == 1 and is_known(values[0]):
            system = values[0]
        elif key == "time_model" and values in (["window"], ["gaussian"]):
            time_model = cast("Literal['window', 'gaussian']", values[0])
        elif key == "origin" and len(values) == 3:
            origin = _origin(values, origin)
        elif key == "temporal_cutoff" and len(values) == 1:
            cutoff = _cutoff(values[0], cutoff)
        elif key == "source_format" and len(values) == 1:
            source = source_format_of(values[0])
    return SplatComments("2dgs" if is_flat else model, system, origin, time_model, cutoff, source)


def _cutoff(word: str, otherwise: float) -> float:
    """Parse a cutoff comment; a word that is no number between 0 and 1 is somebody else's comment."""
    try:
        cutoff = float(word)
    except ValueError:
        return otherwise
    return cutoff if 0 < cutoff < 1 else otherwise


def _origin(words: list[str], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Parse the numbers of an origin comment; words that are no numbers are somebody else's comment."""
    try:
        origin = np.array([float(word) for word in words])
    except ValueError:
        return otherwise
    if not np.isfinite(origin).all():
        raise CorruptDataError(f"expected three finite numbers, found {' '.join(words)!r}", field="comment origin")
    return origin


def comment_lines(template: GaussianCloud) -> list[str]:
    """Return the header lines that say what `splat_comments` reads; the time model only where there is motion."""
    lines = []
    if template.splat_model == "antialiased":
        lines += ["comment SplatRenderMode: mip", "comment antialiased 1"]
    elif template.splat_model == "2dgs":
        lines.append("comment SplatRenderMode: 2dgs")
    if template.coordinate_system != "unknown":
        lines.append(f"comment coordinate_system {template.coordinate_system}")
    if template.source_format:
        lines.append(f"comment source_format {template.source_format}")
    if template.origin.any():
        lines.append("comment origin " + " ".join(repr(float(value)) for value in template.origin))
    if template.has_motion and template.time_model != "window":
        lines.append(f"comment time_model {template.time_model}")
        if template.temporal_cutoff != TEMPORAL_CUTOFF:
            lines.append(f"comment temporal_cutoff {template.temporal_cutoff!r}")
    return lines
