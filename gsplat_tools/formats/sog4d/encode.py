"""Cloud or sequence to bundle: fit what is shared, then encode, compress and write frame after frame."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats._webp import MAX_SIDE, Image
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.sog4d.codebooks import Palette, Shared, check_finite, fit_shared
from gsplat_tools.formats.sog4d.decode import GENERATOR
from gsplat_tools.formats.sog4d.meta import FRAME_TOKEN, Meta, PaletteMeta, Segment, frame_path, meta_text
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.sampling import draw_sample
from gsplat_tools.formats.sog4d.segments import (
    PATHS,
    SegmentFacts,
    choose_segments,
    compress_image,
    data_compression,
    delta_path,
    has_deltas,
    image_compression,
    segment_images,
)
from gsplat_tools.parallel import map_ordered
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

Float32 = NDArray[np.float32]


def write(scene: GaussianCloud | GaussianSequence, stream: BinaryIO, options: Sog4dOptions) -> None:
    """Write a bundle; peak memory is a few frames and the sample, however many frames there are.

    Raises
    ------
    CapabilityError
        The format cannot hold the scene: no splat, a band above 3, a layout too small, times of the wrong length.
    CloudError
        Values are not finite, or a frame differs from the first in count or degree.
    """
    frames = Frames(scene)
    layout = choose_layout(frames.num_splats, options)
    times = choose_times(scene, len(frames), options)
    with stage("fitting codebooks", len(frames), "frames") as progress:
        sample = draw_sample((frames[i] for i in _counted(len(frames), progress)), len(frames), options.seed)
        shared = fit_shared(sample, frames[0], options, layout)
    del sample
    segments = choose_segments(len(frames), options.delta_segment_length)
    uses_deltas = has_deltas(len(frames), options)
    archive = ZipWriter(stream)
    facts: list[SegmentFacts] = []

    def images() -> Iterator[tuple[str, Image]]:
        for segment in segments:
            gathered = SegmentFacts()
            yield from segment_images(frames.__getitem__, segment, shared, gathered, uses_deltas=uses_deltas)
            facts.append(gathered)

    with stage("encoding", len(frames), "frames") as progress:
        for name, data in map_ordered(partial(compress_image, effort=options.webp_effort), images()):
            archive.add(name, data, image_compression(options))
            if name.endswith("/sh0.webp"):
                progress.advance(1)
    entries = last_entries(shared, frames.num_splats, segments, times, facts, uses_deltas=uses_deltas)
    for each in facts:
        entries |= each.deltas
    for name in sorted(entries):
        archive.add(name, entries[name], data_compression(options))
    archive.close()
    warn_clipped(facts)


def last_entries(
    shared: Shared,
    num_splats: int,
    segments: list[tuple[int, int]],
    times: NDArray[np.float64] | None,
    facts: Sequence[SegmentFacts],
    *,
    uses_deltas: bool,
) -> dict[str, bytes]:
    """Return meta.json and the palettes, by name: what stands behind all frames, beside the delta files.

    Parameters
    ----------
    shared
        What all frames share.
    num_splats
        Splats in a frame.
    segments
        (start, number of frames) of all.
    times
        Explicit times, or None.
    facts
        What encoding left of each segment, in their order.
    uses_deltas
        Whether labels are stored as changes.
    """
    ranges = [each for fact in facts for each in fact.ranges]
    meta = _meta(shared, num_splats, segments if uses_deltas else None, times, ranges)
    lossy = " and ".join(sorted({source for fact in facts for source in fact.sources} - {""}))
    meta = replace(meta, generator=f"{meta.generator} from {lossy}") if lossy else meta
    return {
        "meta.json": meta_text(meta),
        **{_centroids_path(palette): _centroid_bytes(palette, shared.options) for palette in shared.palettes},
    }


def warn_clipped(facts: Sequence[SegmentFacts]) -> None:
    """Warn of colors that the sh0 codebook could not reach, in frames as a whole."""
    count = sum(fact.clipped.get("sh0", 0) for fact in facts)
    if count:
        message = f"colors of {count} splats lie outside the sh0 codebook and were clamped; use --sh0-codebook fit"
        warnings.warn(LossyConversionWarning(message, code="clamped-sh0"), stacklevel=4)


class Frames:
    """Frames of a scene, each checked when it is loaded; the last one is kept."""

    def __init__(self, scene: GaussianCloud | GaussianSequence) -> None:
        self._scene = scene
        self._degree = scene.sh_degree
        self.num_splats = scene.num_splats if isinstance(scene, GaussianSequence) else len(scene)
        self._kept: tuple[int, GaussianCloud] | None = None
        if self.num_splats == 0:
            raise CapabilityError("a .sog4d bundle needs at least one splat, the scene has none")
        if self._degree > 3:
            raise CapabilityError(f"a .sog4d bundle holds SH bands up to 3, the scene has {self._degree}")

    def __len__(self) -> int:
        return len(self._scene) if isinstance(self._scene, GaussianSequence) else 1

    def __getitem__(self, frame_id: int) -> GaussianCloud:
        if self._kept is not None and self._kept[0] == frame_id:
            return self._kept[1]
        cloud = self._scene.frame(frame_id) if isinstance(self._scene, GaussianSequence) else self._scene
        for what, found, expected in (
            ("splats", len(cloud), self.num_splats),
            ("as its SH degree", cloud.sh_degree, self._degree),
        ):
            if found != expected:
                message = f"every frame needs {expected} {what} like the first, this one has {found}"
                raise CloudError(message, frame=frame_id)
        check_finite(cloud, frame_id)
        self._kept = (frame_id, cloud)
        return cloud


def _counted(count: int, progress: Any) -> Iterator[int]:
    for i in range(count):
        yield i
        progress.advance(1)


def choose_layout(count: int, options: Sog4dOptions) -> tuple[int, int]:
    """Return the layout that was asked for, completed, or a nearly square one."""
    from gsplat_tools.ops.ordering import image_layout

    width, height = options.width, options.height
    if width is None and height is None:
        width, height = image_layout(count)
    elif width is None:
        assert height is not None
        width = -(-count // height)
    elif height is None:
        height = -(-count // width)
    if width * height < count or width > MAX_SIDE or height > MAX_SIDE:
        raise CapabilityError(
            f"a layout of {width} x {height} does not hold {count} splats in images of at most {MAX_SIDE} x {MAX_SIDE}; "
            "leave width and height out"
        )
    return width, height


def choose_times(scene: GaussianCloud | GaussianSequence, num_frames: int, options: Sog4dOptions) -> NDArray[np.float64] | None:
    """Return explicit times, or None for the uniform mapping."""
    if options.time_mapping == "uniform":
        return None
    is_explicit = options.time_mapping == "explicit"
    times: NDArray[np.float64]
    if options.frame_times is not None:
        times = np.asarray(options.frame_times, np.float64)
    elif isinstance(scene, GaussianSequence) and (is_explicit or not scene.is_uniform):
        times = scene.frame_times
    elif is_explicit:
        times = np.zeros(1)
    else:
        return None
    if times.shape != (num_frames,):
        raise CapabilityError(f"frame_times needs one time a frame, {num_frames}, and has {times.size}")
    if not np.isfinite(times).all() or times.min() < 0 or times.max() > 1 or (np.diff(times) < 0).any():
        raise CapabilityError("frame_times must be finite, in [0, 1], and not decrease")
    return times


def _centroids_path(palette: Palette) -> str:
    return f"sh/{palette.name}_centroids.bin"


def _centroid_bytes(palette: Palette, options: Sog4dOptions) -> bytes:
    return palette.centroids.astype("<f2" if options.centroids == "f16" else "<f4").tobytes()


def _meta(
    shared: Shared,
    splat_count: int,
    segments: list[tuple[int, int]] | None,
    times: NDArray[np.float64] | None,
    ranges: list[tuple[Float32, Float32]],
) -> Meta:
    """Return meta.json for what was written."""
    from gsplat_tools import __version__

    palettes = []
    for palette in shared.palettes:
        template = f"frames/{FRAME_TOKEN}/{palette.name}_labels.webp"
        palettes.append(
            PaletteMeta(
                name=palette.name,
                coefficients=palette.coefficients,
                count=len(palette.centroids),
                centroids_type=shared.options.centroids,
                centroids_path=_centroids_path(palette),
                labels_path=template if segments is None else None,
                segments=tuple(
                    Segment(start, count, frame_path(template, start), delta_path(palette.name, start))
                    for start, count in segments or ()
                ),
            )
        )
    return Meta(
        version=shared.options.version,
        splat_count=splat_count,
        frame_count=len(ranges),
        frame_times=times,
        width=shared.width,
        height=shared.height,
        # Adding 0 leaves one zero of the two: which of them is the least depends on what comes first.
        range_min=np.array([low for low, _ in ranges]) + np.float32(0),
        range_max=np.array([high for _, high in ranges]) + np.float32(0),
        position_hi_path=PATHS["position_hi"],
        position_lo_path=PATHS["position_lo"],
        scale_codebook=shared.scale_codebook,
        scale_indices_path=PATHS["scale_indices"],
        rotation_path=PATHS["rotation"],
        bands=shared.bands,
        sh0_path=PATHS["sh0"],
        sh0_codebook=shared.sh0_codebook,
        palettes=tuple(palettes),
        generator=f"{GENERATOR} {__version__}",
        tolerance=shared.tolerance,
    )
