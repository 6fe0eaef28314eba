"""Segments of a bundle: frames that depend on each other through their labels, and on nothing else but what all share.

A segment is the unit that can be encoded elsewhere: the bytes of its entries follow from its frames and from `Shared`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats import _webp
from gsplat_tools.formats._webp import Image
from gsplat_tools.formats._zip import Compression
from gsplat_tools.formats.sog4d import labels as label_files
from gsplat_tools.formats.sog4d.codebooks import Shared
from gsplat_tools.formats.sog4d.frame import FramePlanes, Previous, encode_frame
from gsplat_tools.formats.sog4d.meta import FRAME_TOKEN
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.textures import rgba_image

PATHS = {
    name: f"frames/{FRAME_TOKEN}/{name}.webp" for name in ("position_hi", "position_lo", "scale_indices", "rotation", "sh0")
}


@dataclass(slots=True)
class SegmentFacts:
    """What encoding leaves of a segment besides its images.

    Parameters
    ----------
    ranges
        (min, max) of the positions of every frame, (3,) each.
    sources
        Lossy formats that the frames come from; "" for others.
    clipped
        Splats that a codebook could not reach, by the codebook.
    deltas
        Delta files by entry name.
    """

    ranges: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = field(default_factory=list)
    sources: set[str] = field(default_factory=set)
    clipped: dict[str, int] = field(default_factory=dict)
    deltas: dict[str, bytes] = field(default_factory=dict)


def choose_segments(num_frames: int, length: int) -> list[tuple[int, int]]:
    """Return (start, number of frames) of the segments."""
    return [(start, min(length, num_frames - start)) for start in range(0, num_frames, length)]


def has_deltas(num_frames: int, options: Sog4dOptions) -> bool:
    """Whether labels are stored as changes."""
    return options.labels == "delta-v1" or (options.labels == "auto" and num_frames > 1)


def delta_path(name: str, start: int) -> str:
    """Return the entry of the delta file of a palette and the segment that starts there."""
    return f"sh/{name}_delta_{start:05d}.bin"


def image_path(name: str, frame_id: int) -> str:
    """Return the entry of an image."""
    return f"frames/{frame_id:05d}/{name}.webp"


def segment_images(
    load: Callable[[int], GaussianCloud], segment: tuple[int, int], shared: Shared, facts: SegmentFacts, *, uses_deltas: bool
) -> Iterator[tuple[str, Image]]:
    """Yield the images of a segment with their entry names, in the order of the bundle.

    Parameters
    ----------
    load
        Returns a frame, splats in the order of the bundle.
    segment
        (start, number of frames).
    shared
        What all frames share.
    facts
        Filled while the images are taken; complete when there are no more.
    uses_deltas
        Whether labels are stored as changes, so that only the first frame has images of them.
    """
    start, count = segment
    previous: Previous | None = None
    changes: dict[str, list[NDArray[Any]]] = {palette.name: [] for palette in shared.palettes}
    for frame_id in range(start, start + count):
        cloud = load(frame_id)
        planes = encode_frame(cloud, shared, previous)
        _note(facts, cloud, planes)
        if uses_deltas and previous is not None:
            for name, blocks in changes.items():
                blocks.append(label_files.changes(previous.labels[name], planes.labels[name]))
        for name in sorted(planes.columns):
            if name in PATHS or not uses_deltas or frame_id == start:
                yield image_path(name, frame_id), rgba_image(planes.columns[name], shared.width, shared.height)
        previous = Previous(cloud, planes.labels)
    if uses_deltas and previous is not None:
        for palette in shared.palettes:
            facts.deltas[delta_path(palette.name, start)] = label_files.write_delta(
                segment, len(previous.cloud), len(palette.centroids), changes[palette.name]
            )


def _note(facts: SegmentFacts, cloud: GaussianCloud, planes: FramePlanes) -> None:
    """Keep what is needed of a frame after its images are written."""
    facts.ranges.append((planes.range_min, planes.range_max))
    facts.sources.add(cloud.source_format)
    for name, number in planes.clipped.items():
        facts.clipped[name] = facts.clipped.get(name, 0) + number


def compress_image(item: tuple[str, Image], *, effort: int) -> tuple[str, bytes]:
    """Return the name and the bytes of an image."""
    name, image = item
    return name, _webp.encode_rgba(image, effort)


def image_compression(options: Sog4dOptions) -> Compression:
    """Return how images are stored in the archive."""
    return "deflated" if options.zip == "deflated" else "stored"


def data_compression(options: Sog4dOptions) -> Compression:
    """Return how everything else is stored in the archive."""
    return "stored" if options.zip == "stored" else "deflated"
