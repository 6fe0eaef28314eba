"""A written file against what it was written from: every value within its bound, and pictures alike."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import AttributeTally, compare_rendered, paired, sample
from gsplat_tools.comparison.rendered import MAX_RENDERED
from gsplat_tools.errors import CapabilityError, GsplatWarning, ValidationError
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import open_as, open_scene
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.measuring import Workbench

VALIDATION_VIEWS = 2
VALIDATION_SIZE = (320, 180)
VALIDATED_FRAMES = 3
"""Frames of a sequence that are rendered: the first, the middle and the last; the bounds hold for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """How a written file is checked before it replaces its target.

    Parameters
    ----------
    views, size
        Automatic views and their width and height, px.
    model
        Rendering model; by default the one that stands for the target.
    min_psnr
        Lowest acceptable PSNR of the worst view, dB.
    """

    views: int = VALIDATION_VIEWS
    size: tuple[int, int] = VALIDATION_SIZE
    model: str | None = None
    min_psnr: float | None = None


DEFAULT_VALIDATION = Validation()

Pair = tuple[str, GaussianCloud, GaussianCloud]
"""Name of a frame, what was given to the writer, and what came back."""


def verify(path: Path, source: Scene, target: Format, how: Validation, bench: Workbench | None = None) -> dict[str, Any]:
    """Read a file back, hold every value against its bound, draw both sides, and judge.

    Parameters
    ----------
    path
        The written file, or its temporary name.
    source
        What was given to the writer.
    target
        Format of the file.
    how
        Views and the lowest PSNR.
    bench
        The scene as it was before options reduced it; pictures are then compared with it, not with `source`.

    Returns
    -------
    dict
        `validation` of `gsplat-convert --json`.

    Raises
    ------
    CapabilityError
        The format has no reader.
    ValidationError
        A bound is exceeded, or the worst view is below `min_psnr`.
    """
    if target.read is None:
        raise CapabilityError(f"{target.title} cannot be read back; use --no-validate")
    tally = AttributeTally()
    in_chunks = not isinstance(source, GaussianSequence)
    with warnings.catch_warnings():
        # What a reader has to say of this file was asked for, or the writer has said it.
        warnings.simplefilter("ignore", GsplatWarning)
        with open_scene(path, in_chunks=in_chunks, as_format=target.id) as decoded, open_as(path, target) as header:
            if isinstance(source, GaussianSequence) or isinstance(decoded, GaussianSequence):
                pairs = _hold_frames(source, decoded, target, header, tally)
            else:
                most = MAX_RENDERED if bench is None else max(1, len(source))
                pairs = _hold_still(source, decoded, target, header, tally, most)
    exceeded = tally.exceeded()
    if exceeded:
        raise ValidationError(f"what was written leaves its derived bounds: {'; '.join(exceeded)}")
    if bench is not None and pairs:
        frames = bench.source_frames(pairs[0][1].coordinate_system)
        pairs = [(label, frame, after) for frame, (label, _, after) in zip(frames, pairs, strict=True)]
    drawn = _draw([pair for pair in pairs if len(pair[1])], target, how)
    level = drawn["psnr_min"]
    if how.min_psnr is not None and level is not None and level < how.min_psnr:
        raise ValidationError(
            f"the worst view has {level:.2f} dB, below --min-psnr {how.min_psnr:g}; the target is left as it was. "
            "Use --preset best or a lower --min-psnr"
        )
    return {**drawn, "attributes": tally.to_json(), "passed": True}


def _hold_frames(source: Scene, decoded: Scene, target: Format, header: BinaryIO, tally: AttributeTally) -> list[Pair]:
    """Hold every frame of a sequence against its bounds and return those to draw."""
    if not isinstance(decoded, GaussianSequence):
        raise ValidationError("a sequence was written but a single frame was read back")
    if not isinstance(source, GaussianSequence):
        source = _still_sequence(source)
    rendered = set(np.linspace(0, len(source) - 1, VALIDATED_FRAMES).round().astype(int).tolist())
    pairs = []
    with stage("checking", len(source), "frames") as progress:
        for frame_id in range(len(source)):
            a, b = source.frame(frame_id), decoded.frame(frame_id)
            tally.add(a, b, None if target.bounds is None else target.bounds(a, header, frame_id))
            if frame_id in rendered:
                pairs.append((f"frame {frame_id} " if len(source) > 1 else "", a, b))
            progress.advance(1)
    return pairs


def _hold_still(
    source: GaussianCloud | CloudChunks,
    decoded: GaussianCloud | CloudChunks,
    target: Format,
    header: BinaryIO,
    tally: AttributeTally,
    limit: int,
) -> list[Pair]:
    """Hold a still scene against its bounds, chunk by chunk, and return at most `limit` splats of it to draw."""
    if len(source) != len(decoded):
        raise ValidationError(f"{len(source)} splats were written but {len(decoded)} read back")
    with stage("checking", len(source)) as progress:
        for a, b in paired(source, decoded):
            tally.add(a, b, None if target.bounds is None else target.bounds(a, header, 0))
            progress.advance(len(a))
    return [("", sample(source, limit), sample(decoded, limit))]


def _draw(pairs: list[Pair], target: Format, how: Validation) -> dict[str, Any]:
    """Draw both sides and return how far apart the pictures are."""
    from gsplat_tools.reference.auto_cameras import auto_cameras

    if not pairs or how.views == 0:
        return {"psnr_min": None, "psnr_mean": None, "ssim_mean": None, "max_abs": None, "views": 0}
    model = (how.model, None) if how.model is not None else target.model
    cameras = auto_cameras(pairs[0][1], views=how.views, size=how.size)
    report = compare_rendered(pairs, cameras, model, num_pairs=len(pairs))
    names = ("psnr_min", "psnr_mean", "ssim_mean", "max_abs", "identical", "worst_view", "model", "rendered_splats")
    return {**{name: getattr(report, name) for name in names}, "views": how.views}


def _still_sequence(scene: GaussianCloud | CloudChunks) -> GaussianSequence:
    """Return a still scene as a sequence of one frame."""
    cloud = scene.read() if isinstance(scene, CloudChunks) else scene
    return GaussianSequence(lambda _frame: cloud, num_splats=len(cloud), sh_degree=cloud.sh_degree, num_frames=1)
