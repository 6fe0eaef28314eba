"""What can be chosen when a .splat4d is written or read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsplat_tools.cloud import TimeModel
from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats.knobs import SIZES, Knob, general_knobs

MAX_PALETTE = 65535
"""Entries that a label of 16 bits can name, one fewer than there are codes, as in .sog4d."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Splat4dReadOptions:
    """How a file is read.

    Parameters
    ----------
    time_model
        "window" or "gaussian"; by default what version 2 says, and what the times of version 1 look like.
    frame
        Frame whose SH labels are taken where labels change over time.
    """

    time_model: TimeModel | None = None
    frame: int = 0

    def __post_init__(self) -> None:
        _check_choice("time_model", self.time_model, (None, "window", "gaussian"))
        _check_range("frame", self.frame, 0, 0xFFFFFFFE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Splat4dOptions:
    """How a file is written.

    Parameters
    ----------
    version
        2, or 1: records alone, window model, no SH above the constant term.
    sh_palette_size
        Entries of each band's codebook, at most 65,535; by default chosen from the number of splats.
    centroids
        Numbers in codebooks: "f16" or "f32".
    labels
        "full", or "delta-v1": labels of the first frame of each segment and the changes after it. A 4D asset has one set of
        labels for all time, so that nothing changes; some players only take this form.
    frame_count
        Frames that "delta-v1" speaks of.
    delta_segment_length
        Frames in a segment; 0 for one segment.
    rotation
        "best": smallest error, over all ways to name the axes; "small": axes named so that the turn is smallest;
        "reference": the unit quaternion rounded.
    """

    version: Literal[1, 2] = 2
    sh_palette_size: int | None = None
    centroids: Literal["f16", "f32"] = "f16"
    labels: Literal["full", "delta-v1"] = "full"
    frame_count: int = 1
    delta_segment_length: int = 0
    rotation: Literal["best", "small", "reference"] = "best"

    def __post_init__(self) -> None:
        _check_choice("version", self.version, (1, 2))
        _check_choice("centroids", self.centroids, ("f16", "f32"))
        _check_choice("labels", self.labels, ("full", "delta-v1"))
        _check_choice("rotation", self.rotation, ("best", "small", "reference"))
        _check_range("sh_palette_size", self.sh_palette_size, 1, MAX_PALETTE)
        _check_range("frame_count", self.frame_count, 1, 1 << 20)
        _check_range("delta_segment_length", self.delta_segment_length, 0, 1 << 20)


KNOBS: dict[str, Knob] = {
    **general_knobs(3),
    "sh_palette_size": Knob(values=SIZES, stream="sh", graded=True, needs={"sh_degree": (1, 2, 3)}),
    "centroids": Knob(values=("f16", "f32"), stream="sh", needs={"sh_degree": (1, 2, 3)}),
    "rotation": Knob(values=("small", "best"), stream="rotations"),
}


def _check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    if value not in choices:
        raise CapabilityError(f"{name} must be one of {', '.join(map(str, choices))}, got {value!r}")


def _check_range(name: str, value: int | None, low: int, high: int) -> None:
    if value is not None and not low <= value <= high:
        raise CapabilityError(f"{name} must be {low} to {high}, got {value}")
