"""SOG, the images of PlayCanvas: a ZIP, or a folder, of meta.json and lossless RGBA8 WebP whose pixel i is splat i.

means_l and means_u hold the low and high bytes of 16-bit codes of sign(x) ln(1 + |x|); scales three indices into a
codebook of log scales; quats three components and the index of the fourth; sh0 three indices and the opacity; shN_labels
16-bit labels into shN_centroids, a palette of SH rows whose bytes index a third codebook. The fields and rules are in
docs/formats/sog.md.
"""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats.base import Bounds, FileInfo, Format
from gsplat_tools.formats.sog import lod
from gsplat_tools.formats.sog.bundle import Bundle, open_bundle
from gsplat_tools.formats.sog.decode import read
from gsplat_tools.formats.sog.encode import write
from gsplat_tools.formats.sog.folder import FOLDER
from gsplat_tools.formats.sog.options import KNOBS, SogOptions, SogReadOptions
from gsplat_tools.formats.sog.rules import RULES

__all__ = ["FORMAT", "RULES", "SogOptions", "SogReadOptions", "inspect", "matches", "read", "write"]

_STREAM_NAMES = (b"means_", b"quats.", b"scales.", b"sh0.", b"shN_")


def matches(head: bytes) -> bool:
    """Whether a file begins like a bundle whose first entry is an image, a meta.json or a lod-meta.json.

    A ZIP that starts with meta.json may be of any kind and is known by its extension.
    """
    if head[:4] == b"PK\x03\x04":
        return head[30:].startswith(_STREAM_NAMES)
    if not head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return False
    if b'"lodLevels"' in head or re.search(rb'"tree"\s*:\s*\{\s*"bound"', head):
        return True
    return re.search(rb'"means"\s*:\s*\{', head) is not None and b'"format"' not in head


def inspect(stream: BinaryIO) -> FileInfo:
    """Return what meta.json says; no image is decoded.

    Raises
    ------
    FormatError
        The bundle breaks a rule of the archive or of meta.json.
    """
    size = stream_size(stream)
    bundle, folder = open_bundle(stream)
    if bundle is not None:
        degree = bundle.sh_degree()
        meta = bundle.meta
        return FileInfo(
            version=str(meta.version),
            splats=meta.count,
            sh_degree=degree,
            splat_model=meta.splat_model,
            bounds=_box([bundle]),
            encoding={
                "generator": meta.generator,
                "sh_palette": meta.palette_count if meta.palette_count is not None else "as many as the image holds",
                "codebooks": {name: table.shape[-1] for name, table in (("scales", meta.scales), ("sh0", meta.sh0))},
                "files": meta.files,
                "stored_bytes": size,
            },
        )
    assert folder is not None
    scene = lod.parse_lod(lod.read_text(stream), folder)
    bundles = [bundle for bundle, _ in scene.bundles(0)]
    return FileInfo(
        version="lod 1",
        splats=sum(piece.count for _, pieces in scene.bundles(0) for piece in pieces),
        sh_degree=max((bundle.sh_degree() for bundle in bundles), default=0),
        splat_model=bundles[0].meta.splat_model if bundles else "default",
        bounds=_box(bundles),
        encoding=lod.facts(scene),
    )


def _box(bundles: list[Bundle]) -> tuple[list[float], list[float]] | None:
    """Return the smallest and largest position that the ranges allow."""
    ranges = [(b.meta.means_low, b.meta.means_high) for b in bundles if b.meta.count]
    if not ranges:
        return None
    low, high = np.min([r[0] for r in ranges], axis=0), np.max([r[1] for r in ranges], axis=0)
    corners = np.copysign(np.expm1(np.abs(np.stack([low, high]))), np.stack([low, high]))
    return corners[0].tolist(), corners[1].tolist()


def _bounds(source: GaussianCloud, stream: BinaryIO, _frame: int) -> Bounds:
    from gsplat_tools.formats.sog.bounds import bounds

    return bounds(source, stream)


def _sizes(cloud: GaussianCloud, options: SogOptions) -> dict[str, int]:
    """Return the entries of the SH palette, which follow from what they leave."""
    from gsplat_tools.formats.sog.codebooks import chosen_palette_size

    return {"sh_palette_size": chosen_palette_size(cloud, options)} if cloud.sh_degree else {}


FORMAT = Format(
    id="sog",
    title="SOG bundle",
    extensions=(".sog",),
    spec="docs/formats/sog.md",
    max_sh_degree=3,
    min_splats=1,
    matches=matches,
    inspect=inspect,
    read=read,
    write=write,
    rules=RULES,
    folder=FOLDER,
    bounds=_bounds,
    stores_splat_model=True,
    order="morton",
    position_type="fixed",
    read_options=SogReadOptions,
    write_options=SogOptions,
    presets={
        "fast": {"webp_effort": 1, "palette_rounds": 1},
        "balanced": {},
        "best": {"rotation": "best", "palette_rounds": 8, "webp_effort": 9},
        "exact": {"rotation": "best", "sh_palette_size": 65536, "palette_rounds": 8, "webp_effort": 9},
    },
    knobs=KNOBS,
    sizes=_sizes,
    model=("spark", None),
)
