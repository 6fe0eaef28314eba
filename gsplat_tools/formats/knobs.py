"""What a search may turn: options that trade bytes for accuracy, as data beside the presets of each format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from gsplat_tools.constants import MAX_SH_DEGREE

Stream = Literal["splats", "positions", "scales", "rotations", "ranges", "colors", "sh", "labels", "codes", "container"]

ATTRIBUTES: Mapping[Stream, tuple[str, ...]] = {
    "splats": (),
    "positions": ("means",),
    "scales": ("log_scales", "quats"),
    "rotations": ("log_scales", "quats"),
    "ranges": ("log_scales", "quats", "sh0", "shN"),
    "colors": ("sh0",),
    "sh": ("shN",),
    "labels": ("log_scales", "quats", "shN"),
    "codes": ("means", "log_scales", "quats", "sh0", "shN"),
    "container": (),
}
"""Arrays of the cloud whose errors a stream decides. Scales and rotations go together, since encoders rename axes. "codes"
moves codes of all of them to cheap neighbors; "splats" decides which splats are there at all, "container" how bytes are
packed, which changes no value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Knob:
    """One option that trades bytes for accuracy (or, in the container, for time).

    Parameters
    ----------
    values
        What may be chosen, from the coarsest (or largest file) to the finest (or smallest).
    stream
        What it is about. Knobs of one stream are chosen together, streams one by one: their errors hardly meet.
    graded
        Whether bytes and errors lie on a curve over `values`, so that a value between two that were measured can be
        predicted.
    needs
        Values of other knobs of the same stream without which this one says nothing.
    sequences_only
        Whether it says nothing about a still scene.
    """

    values: tuple[Any, ...]
    stream: Stream
    graded: bool = False
    needs: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    sequences_only: bool = False

    def __iter__(self) -> Iterator[Any]:
        return iter(self.values)


INVISIBLE_OPACITY = 1 / 255
"""No renderer of 3DGS draws a splat whose opacity is below this: alpha is at most the opacity, and smaller alphas are
skipped. Source: the rasterizer of Kerbl et al. 2023."""

SIZES = tuple(round(2 ** (step / 2)) for step in range(10, 31))
"""Entries of codebooks and palettes, 32 to 32,768, each sqrt(2) times the one before."""


LIT_PIXELS = (*(round(1.25**step, 4) for step in range(24, -36, -1)), 0.0)
"""Below which splats are left out, `prune_faint`, 212 to 0.0004: dense, as formats with few other knobs have no finer step."""

TOLERANCES = (0.3, 0.2, 0.14, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.0)
"""Pixels of `visual_tolerance`."""


def general_knobs(max_sh_degree: int = MAX_SH_DEGREE) -> dict[str, Knob]:
    """Return the knobs of every format: SH bands, and the opacity below which splats are left out."""
    return {
        "prune_opacity": Knob(values=(INVISIBLE_OPACITY, 0.0), stream="splats"),
        "prune_faint": Knob(values=LIT_PIXELS, stream="splats", graded=True),
        "sh_degree": Knob(values=tuple(range(max_sh_degree + 1)), stream="sh"),
    }
