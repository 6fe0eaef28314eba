"""Float32 arrays as gsplat-unity's uncompressed assets have them, in a .gspk (docs/formats/uncompressed.md)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.formats.pack import arrays, gspk
from gsplat_tools.formats.pack.arrays import UncompressedPack, decode, encode
from gsplat_tools.formats.pack.container_writing import Codec, Rows

__all__ = ["FORMAT", "UncompressedOptions", "UncompressedPack", "decode", "encode", "write"]


@dataclass(frozen=True, slots=True, kw_only=True)
class UncompressedOptions:
    """Choices of the uncompressed layout.

    Parameters
    ----------
    codec
        "zstd", or "none" for files that are mapped into memory.
    zstd_level
        1 to 22.
    """

    codec: Codec = "zstd"
    zstd_level: int = 3


def write(scene: Scene, stream: BinaryIO, options: UncompressedOptions) -> None:
    """Write a cloud or chunks.

    Raises
    ------
    CapabilityError
        The scene is a sequence.
    CloudError
        A position is not finite.

    Warns
    -----
    LossyConversionWarning
        Scales beyond float32 were clamped or became flat.
    """
    tally = arrays.RangeTally()

    def encode_chunk(chunk: GaussianCloud) -> tuple[Rows, NDArray[np.floating[Any]]]:
        return arrays.encode_rows(chunk, tally), chunk.means

    def describe(chunks: CloudChunks) -> Any:
        return gspk.facts_of(chunks, "uncompressed")

    gspk.write(scene, stream, describe, encode_chunk, tally.finish, codec=options.codec, level=options.zstd_level)


FORMAT = Format(
    id="uncompressed",
    precise=True,
    title="Uncompressed float32 arrays (.gspk)",
    extensions=(".gspk",),
    spec="docs/formats/uncompressed.md",
    max_sh_degree=4,
    matches=partial(gspk.matches, layout="uncompressed"),
    inspect=gspk.inspect,
    read=gspk.read,
    read_chunks=gspk.read_chunks,
    write=write,
    bounds=gspk.bounds,
    holds_motion=True,
    stores_origin=True,
    stores_coordinates=True,
    stores_splat_model=True,
    streams=True,
    write_options=UncompressedOptions,
    presets={"fast": {"zstd_level": 1}, "balanced": {}, "best": {"zstd_level": 12}, "exact": {"zstd_level": 12}},
    knobs={
        **general_knobs(4),
        "zstd_level": Knob(values=(3, 12, 19), stream="container"),
        "order": Knob(values=("none", "morton"), stream="container"),
    },
    model=("unity", None),
)
