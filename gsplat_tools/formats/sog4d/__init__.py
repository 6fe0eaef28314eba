"""The .sog4d keyframe sequence bundle of the raiscui/gsplat-unity fork: a ZIP of meta.json, images and palettes.

meta.json names the streams; each frame is a set of lossless RGBA8 WebP images whose pixel i, row by row, is splat i:
position_hi and position_lo (16-bit codes in the frame's range), scale_indices (into a codebook of linear triples),
rotation (bytes w x y z), sh0 (three codebook indices, opacity), and labels into SH palettes, as images or as changes.
The table of fields and rules is docs/formats/sog4d.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.formats._issues import Issue, raise_errors
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats._webp import Image
from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.base import Bounds, FileInfo, Format
from gsplat_tools.formats.sog4d.bundle import REPEATABLE, Bundle, check_layout, read_meta
from gsplat_tools.formats.sog4d.decode import read
from gsplat_tools.formats.sog4d.encode import write
from gsplat_tools.formats.sog4d.options import KNOBS, Sog4dOptions, Sog4dReadOptions
from gsplat_tools.formats.sog4d.rules import RULES

__all__ = ["FORMAT", "RULES", "Sog4dOptions", "Sog4dReadOptions", "inspect", "matches", "planes", "read", "write"]


def planes(path: str | Path, frame: int) -> dict[str, Image]:
    """Return the raw images of one frame by stream name.

    Parameters
    ----------
    path
        A .sog4d file.
    frame
        Index of the frame.

    Returns
    -------
    dict[str, Image]
        (height, width, 4) RGBA bytes under "position_hi", "position_lo", "scale_indices", "rotation", "sh0", and
        "shN_labels" (version 1) or "sh1_labels" to "sh3_labels" (version 2); labels of delta segments are expanded.

    Raises
    ------
    FormatError
        The bundle breaks a rule of docs/formats/sog4d.md.
    CloudError
        There is no such frame.
    """
    from gsplat_tools.formats.loading import located  # which imports all formats

    with located(Path(path)), Path(path).open("rb") as stream:
        bundle = Bundle(stream)
        if not 0 <= frame < bundle.meta.frame_count:
            raise CloudError(f"expected a frame in 0..{bundle.meta.frame_count - 1}, found {frame}", path=path, frame=frame)
        return bundle.planes(frame)


def matches(head: bytes) -> bool:
    """Whether a file begins like a bundle whose first entry is an image of a frame; others are known by extension."""
    return head[:4] == b"PK\x03\x04" and head[30:37] == b"frames/"


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what meta.json says; no image is decoded.

    Raises
    ------
    FormatError
        The bundle breaks a rule of the archive or of meta.json.
    """
    archive = ZipReader(stream, repeatable=REPEATABLE)
    meta, _ = read_meta(archive)
    raise_errors(check_layout(meta, stream_size(stream)), RULES)
    palettes = {
        palette.name: {
            "entries": palette.count,
            "centroids": palette.centroids_type,
            "labels": "full" if palette.labels_path is not None else "delta-v1",
            "segments": len(palette.segments),
        }
        for palette in meta.palettes
    }
    low, high = meta.range_min.min(axis=0), meta.range_max.max(axis=0)
    return FileInfo(
        version=str(meta.version),
        splats=meta.splat_count,
        sh_degree=meta.bands,
        frames=meta.frame_count,
        bounds=(low.astype(np.float64).tolist(), high.astype(np.float64).tolist()),
        encoding={
            "layout": [meta.width, meta.height],
            "time_mapping": "uniform" if meta.frame_times is None else "explicit",
            "scale_codebook": len(meta.scale_codebook),
            "palettes": palettes,
            "generator": meta.generator,
            "entries": len(archive.names),
            "stored_bytes": sum(archive.stored_size(name) for name in archive.names),
        },
    )


def _bounds(source: GaussianCloud, stream: BinaryIO, frame: int) -> Bounds:
    from gsplat_tools.formats.sog4d.bounds import bounds

    return bounds(source, stream, frame)


def _check(stream: BinaryIO) -> Iterator[Issue]:
    from gsplat_tools.formats.sog4d.validate import check

    return check(stream)


def _repair(source: BinaryIO, target: BinaryIO) -> list[str]:
    from gsplat_tools.formats.sog4d.repair import repair

    return repair(source, target)


def _sizes(cloud: GaussianCloud, options: Sog4dOptions) -> dict[str, int]:
    """Return the entries of codebook and palettes, as far as they are known before a visual tolerance is applied."""
    from gsplat_tools.formats.sog4d.codebooks import sizes

    found = sizes(len(cloud), options)
    if options.visual_tolerance > 0 and options.scale_codebook_size is None:
        del found["scale_codebook_size"]
    return found


FORMAT = Format(
    id="sog4d",
    title=".sog4d sequence bundle",
    extensions=(".sog4d",),
    spec="docs/formats/sog4d.md",
    max_sh_degree=3,
    min_splats=1,
    matches=matches,
    inspect=inspect,
    read=read,
    write=write,
    bounds=_bounds,
    check=_check,
    rules=RULES,
    repair=_repair,
    holds_sequences=True,
    order="morton",
    position_type="fixed",
    read_options=Sog4dReadOptions,
    write_options=Sog4dOptions,
    presets={
        "fast": {"webp_effort": 1, "palette_rounds": 1, "detail": 0.5},
        "balanced": {},
        "best": {"detail": 2.0, "rotation": "best", "sh0_entries": 256, "palette_rounds": 8, "webp_effort": 7},
        "exact": {
            "version": 2,
            "detail": 4.0,
            "rotation": "best",
            "sh0_entries": 256,
            "palette_rounds": 8,
            "keep_tolerance": 0.0,
            "centroids": "f32",
            "webp_effort": 7,
        },
    },
    knobs=KNOBS,
    sizes=_sizes,
    model=("unity", "fork-4d"),
)
