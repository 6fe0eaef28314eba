"""Spark's packed splats, 16 bytes each and SH in words, in a .gspk (docs/formats/spark.md)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.formats.pack import gspk, words
from gsplat_tools.formats.pack.container_writing import Codec, Rows
from gsplat_tools.formats.pack.encoding import SplatEncoding, fit_encoding
from gsplat_tools.formats.pack.words import Rotation, SparkPack, decode, encode, encode_values
from gsplat_tools.sequence import GaussianSequence

__all__ = ["FORMAT", "SparkOptions", "SparkPack", "SplatEncoding", "decode", "encode", "encode_values", "fit_encoding", "write"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SparkOptions:
    """Choices of the Spark layout.

    Parameters
    ----------
    rotation
        Frame of each rotation: "reference" as Spark's own encoder, to the bit; "best" the smallest decoded error;
        "small" the frame whose bytes compress best.
    spark_encoding
        Ranges of the quantized fields: "default" as Spark has them, "fit" the tightest for the scene, which needs a
        pass over it beforehand.
    codec
        "zstd", or "none" for files that are mapped into memory.
    zstd_level
        1 to 22.
    """

    rotation: Rotation = "best"
    spark_encoding: Literal["default", "fit"] = "default"
    codec: Codec = "zstd"
    zstd_level: int = 3


def write(scene: Scene, stream: BinaryIO, options: SparkOptions) -> None:
    """Write a cloud or chunks.

    Raises
    ------
    CapabilityError
        Finite positions are beyond the range of half precision, or the scene is a sequence.
    CloudError
        A value is not a number.

    Warns
    -----
    LossyConversionWarning
        Values out of range were clamped, or scales below e^-30 became flat.
    """
    encoding = choose_encoding(scene, options.spark_encoding)
    tally = words.ClampTally(encoding)

    def encode_chunk(chunk: GaussianCloud) -> tuple[Rows, NDArray[np.floating[Any]]]:
        rows = words.encode_rows(chunk, encoding, options.rotation, tally)
        return rows, words.stored_positions(rows["packed"])

    def describe(chunks: CloudChunks) -> Any:
        return gspk.facts_of(chunks, "spark", encoding=encoding, rotation=options.rotation)

    gspk.write(scene, stream, describe, encode_chunk, tally.finish, codec=options.codec, level=options.zstd_level)


def choose_encoding(scene: Scene, spark_encoding: str) -> SplatEncoding:
    """Return the ranges that an option names.

    Raises
    ------
    CapabilityError
        The option is unknown.
    """
    if spark_encoding == "default" or isinstance(scene, GaussianSequence):
        return SplatEncoding()
    if spark_encoding == "fit":
        return fit_encoding(as_chunks(scene))
    raise CapabilityError(f"spark_encoding must be 'default' or 'fit', got {spark_encoding!r}")


FORMAT = Format(
    id="spark",
    title="Spark packed splats (.gspk)",
    extensions=(".gspk",),
    spec="docs/formats/spark.md",
    max_sh_degree=4,
    matches=partial(gspk.matches, layout="spark"),
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
    position_type="f16",
    write_options=SparkOptions,
    presets={
        "fast": {"rotation": "reference", "zstd_level": 1},
        "balanced": {},
        "best": {"spark_encoding": "fit", "zstd_level": 12},
        "exact": {"spark_encoding": "fit", "zstd_level": 12},
    },
    knobs={
        **general_knobs(4),
        "rotation": Knob(values=("small", "best"), stream="rotations"),
        "spark_encoding": Knob(values=("default", "fit"), stream="ranges"),
        "zstd_level": Knob(values=(3, 12, 19), stream="container"),
        "order": Knob(values=("none", "morton"), stream="container"),
    },
    model=("unity", None),
)
