"""What can be chosen when a SOG bundle is written or read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats._webp import DEFAULT_EFFORT
from gsplat_tools.formats.knobs import SIZES, TOLERANCES, Knob, general_knobs
from gsplat_tools.formats.sog.rules import MAX_PALETTE
from gsplat_tools.ops.visibility import MAX_PIXELS

RotationMode = Literal["best", "small", "reference"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SogReadOptions:
    """How a scene is read.

    Parameters
    ----------
    lod
        Level of detail of a lod-meta.json, 0 the finest; other scenes have level 0 only.
    """

    lod: int = 0

    def __post_init__(self) -> None:
        _check_range("lod", self.lod, 0, 1 << 20)


@dataclass(frozen=True, slots=True, kw_only=True)
class SogOptions:
    """How a bundle is written.

    Parameters
    ----------
    sh_palette_size
        Entries of the SH palette, at most 65,536; by default chosen from the number of splats.
    rotation
        How the axes of a splat are named, which changes no picture: "best" for the smallest error, "small" for the
        smallest file, "reference" as they are.
    palette_rounds
        Rounds of k-means for the SH palette at most.
    webp_effort
        0 (fastest) to 9 (smallest).
    visual_tolerance
        Pixels, 0 for none: codes move to neighbors that compress better where that shows no more than a bit's worth, the
        shift of an opaque round splat by so many pixels in a picture in which the scene spans 1,000.
    seed
        Of the sample that codebooks are fitted on, where there are too many splats to take all.
    """

    sh_palette_size: int | None = None
    rotation: RotationMode = "small"
    palette_rounds: int = 5
    webp_effort: int = DEFAULT_EFFORT
    visual_tolerance: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rotation not in get_args(RotationMode):
            raise CapabilityError(f"rotation must be one of {', '.join(get_args(RotationMode))}, got {self.rotation!r}")
        _check_range("sh_palette_size", self.sh_palette_size, 1, MAX_PALETTE)
        _check_range("palette_rounds", self.palette_rounds, 0, 100)
        _check_range("webp_effort", self.webp_effort, 0, 9)
        if not 0 <= self.visual_tolerance <= MAX_PIXELS:
            raise CapabilityError(f"visual_tolerance must be 0 to {MAX_PIXELS:g} pixels, got {self.visual_tolerance}")


KNOBS: dict[str, Knob] = {
    **general_knobs(3),
    "sh_palette_size": Knob(values=SIZES, stream="sh", graded=True, needs={"sh_degree": (1, 2, 3)}),
    "rotation": Knob(values=("small", "best"), stream="rotations"),
    "visual_tolerance": Knob(values=TOLERANCES, stream="codes", graded=True),
    "webp_effort": Knob(values=(1, 3, 9), stream="container"),
}


def _check_range(name: str, value: int | None, low: int, high: int) -> None:
    if value is not None and not low <= value <= high:
        raise CapabilityError(f"{name} must be {low} to {high}, got {value}")
