"""What can be chosen when a .sog4d bundle is written or read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats._webp import DEFAULT_EFFORT, MAX_SIDE
from gsplat_tools.formats.knobs import SIZES, TOLERANCES, Knob, general_knobs
from gsplat_tools.formats.sog4d.rules import MAX_CODEBOOK, MAX_PALETTE
from gsplat_tools.ops.visibility import MAX_PIXELS

LabelEncoding = Literal["auto", "full", "delta-v1"]
RotationMode = Literal["best", "small", "reference"]
ZipMode = Literal["auto", "stored", "deflated"]
ShnOrder = Literal["interleaved", "channel-major"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sog4dReadOptions:
    """How a bundle is read.

    Parameters
    ----------
    shn_order
        Order of the numbers in an SH palette entry: "interleaved" as the format says, or "channel-major" for bundles of
        ply_sequence_to_sog4d.py, which stores f_rest in the order of the PLY file.
    """

    shn_order: ShnOrder = "interleaved"

    def __post_init__(self) -> None:
        _check_choice("shn_order", self.shn_order, get_args(ShnOrder))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sog4dOptions:
    """How a bundle is written.

    Parameters
    ----------
    version
        1: one SH palette over all bands; 2: one a band (smaller error, a label image more for each).
    labels
        "full" label images for every frame, "delta-v1" images and changes by segment, or "auto": delta-v1 for more than
        one frame.
    delta_segment_length
        Frames in a segment. Segments do not depend on each other, also with full labels: nothing is kept over from the
        frame before at their start.
    scale_codebook_size
        Entries of the codebook of scale triples, at most 65,535; by default chosen from the number of splats.
    sh_palette_size
        Entries of each SH palette, at most 65,535; by default chosen from the number of splats.
    detail
        Factor of the default sizes of codebook and palettes, 0.1 to 4.
    centroids
        Numbers in SH palettes: "f16" or "f32".
    sh0_codebook
        "fit": the optimum for the data; "base-rgb": the fixed table of 256 colors in [0, 1].
    sh0_entries
        Entries of the codebook that are used, 2 to 256; fewer make smaller files. By default 128.
    webp_effort
        0 (fastest) to 9 (smallest).
    zip
        "stored", "deflated", or "auto": images stored, the rest deflated.
    rotation
        "best": smallest error; "small": smallest file; "reference": the unit quaternion rounded. But for "reference" the
        axes of a splat are named so that its scales fall, once for all frames.
    rotation_steps
        With "small", the byte steps of w, 16 to 127; the error is at most atan(sqrt(3) / 2 / steps) times two, and fewer
        steps make smaller files. By default 64.
    palette_rounds
        Rounds of k-means for SH palettes at most.
    keep_tolerance
        In sequences a splat keeps its scale and SH labels of the frame before as long as that adds no more than this
        share of the palette's own mean squared error.
    visual_tolerance
        Pixels, 0 for none: codes move to neighbors that compress better where that shows no more than a bit's worth, the
        shift of an opaque round splat by so many pixels in a picture in which the scene spans 1,000. The size of the scale
        codebook, the entries of the color codebook and the steps of rotations, where they are not given, follow from it.
    time_mapping
        "uniform", "explicit", or "auto": as the source has it.
    frame_times
        Explicit times in [0, 1], one a frame; by default those of the source.
    width, height
        Layout of the images; by default the smallest that is nearly square.
    seed
        Of the sample that codebooks are fitted on, where there are too many splats to take all.
    """

    version: Literal[1, 2] = 1
    labels: LabelEncoding = "auto"
    delta_segment_length: int = 32
    scale_codebook_size: int | None = None
    sh_palette_size: int | None = None
    detail: float = 1.0
    centroids: Literal["f16", "f32"] = "f16"
    sh0_codebook: Literal["fit", "base-rgb"] = "fit"
    sh0_entries: int | None = None
    webp_effort: int = DEFAULT_EFFORT
    zip: ZipMode = "auto"
    rotation: RotationMode = "small"
    rotation_steps: int | None = None
    palette_rounds: int = 5
    keep_tolerance: float = 0.05
    visual_tolerance: float = 0.0
    time_mapping: Literal["auto", "uniform", "explicit"] = "auto"
    frame_times: Sequence[float] | None = None
    width: int | None = None
    height: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _check_choice("version", self.version, (1, 2))
        _check_choice("labels", self.labels, get_args(LabelEncoding))
        _check_choice("centroids", self.centroids, ("f16", "f32"))
        _check_choice("sh0_codebook", self.sh0_codebook, ("fit", "base-rgb"))
        _check_choice("zip", self.zip, get_args(ZipMode))
        _check_choice("rotation", self.rotation, get_args(RotationMode))
        _check_choice("time_mapping", self.time_mapping, ("auto", "uniform", "explicit"))
        _check_range("delta_segment_length", self.delta_segment_length, 1, 1 << 31)
        _check_range("scale_codebook_size", self.scale_codebook_size, 1, MAX_CODEBOOK)
        _check_range("sh_palette_size", self.sh_palette_size, 1, MAX_PALETTE)
        _check_range("sh0_entries", self.sh0_entries, 2, 256)
        _check_range("rotation_steps", self.rotation_steps, 16, 127)
        _check_range("palette_rounds", self.palette_rounds, 0, 100)
        _check_range("webp_effort", self.webp_effort, 0, 9)
        _check_range("width", self.width, 1, MAX_SIDE)
        _check_range("height", self.height, 1, MAX_SIDE)
        if not 0.1 <= self.detail <= 4:
            raise CapabilityError(f"detail must be 0.1 to 4, got {self.detail}")
        if not 0 <= self.keep_tolerance <= 1:
            raise CapabilityError(f"keep_tolerance must be 0 to 1, got {self.keep_tolerance}")
        if not 0 <= self.visual_tolerance <= MAX_PIXELS:
            raise CapabilityError(f"visual_tolerance must be 0 to {MAX_PIXELS:g} pixels, got {self.visual_tolerance}")


KNOBS: dict[str, Knob] = {
    **general_knobs(3),
    "version": Knob(values=(1, 2), stream="sh", needs={"sh_degree": (2, 3)}),
    "sh_palette_size": Knob(values=SIZES, stream="sh", graded=True, needs={"sh_degree": (1, 2, 3)}),
    "scale_codebook_size": Knob(values=SIZES, stream="scales", graded=True),
    "sh0_entries": Knob(
        values=(4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 96, 128, 160, 192, 224, 256), stream="colors", graded=True
    ),
    "rotation": Knob(values=("small", "best"), stream="rotations"),
    "rotation_steps": Knob(
        values=(16, 18, 20, 24, 28, 32, 40, 48, 56, 64, 80, 96, 112, 127),
        stream="rotations",
        graded=True,
        needs={"rotation": ("small",)},
    ),
    "keep_tolerance": Knob(values=(0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 0.0), stream="labels", sequences_only=True),
    "visual_tolerance": Knob(values=TOLERANCES, stream="codes", graded=True),
    "webp_effort": Knob(values=(1, 3, 7), stream="container"),
}


def _check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    if value not in choices:
        raise CapabilityError(f"{name} must be one of {', '.join(map(str, choices))}, got {value!r}")


def _check_range(name: str, value: int | None, low: int, high: int) -> None:
    if value is not None and not low <= value <= high:
        raise CapabilityError(f"{name} must be {low} to {high}, got {value}")
