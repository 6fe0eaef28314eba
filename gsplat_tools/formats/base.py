"""What a format is: a record of capabilities and functions. Readers and writers see streams, never paths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats._issues import Issue, Rule
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.sequence import GaussianSequence

SNIFF_BYTES = 4096
"""Bytes from the start of a file that are enough to recognize every format; PLY dialects differ behind the comments."""

Scene = GaussianCloud | GaussianSequence | CloudChunks
"""What a writer takes; only formats with `streams` take chunks, only those with `holds_sequences` take sequences."""

Bounds = dict[str, NDArray[np.floating[Any]]]
"""Largest error that an encoding allows, per attribute, each broadcastable to the array it is about:

means (N, 3) world units · scales (N, 3) of the sorted log scales · covariances (N,) Frobenius norm relative to
that of the source · opacities (N,) after the sigmoid · sh0 (N, 3) · shN (N, K - 1, 3) · velocities (N, 3) ·
times (N,) · durations (N,). An attribute that is left out is measured but has no bound known before encoding.
"""


@dataclass(frozen=True, slots=True)
class NoOptions:
    """A format without choices."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FileInfo:
    """Header facts of a file, known without decoding where the format allows.

    Parameters
    ----------
    version
        Version of the format, as text; empty where it has none.
    splats
        Splats in a frame, as the header states.
    sh_degree
        Highest SH band.
    frames
        Frames; 1 for a still scene.
    coordinate_system, origin, splat_model
        As `GaussianCloud` has them.
    bounds
        (min, max) of the world positions, or None where the header does not tell.
    motion_bounds
        The same, grown by what motion may add, or None.
    encoding
        Everything else that the header says: ranges, layouts, codecs, properties.
    """

    version: str
    splats: int
    sh_degree: int
    frames: int = 1
    coordinate_system: str = "unknown"
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    splat_model: str = "default"
    bounds: tuple[list[float], list[float]] | None = None
    motion_bounds: tuple[list[float], list[float]] | None = None
    encoding: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderLayout:
    """How a bundle becomes the files of a folder.

    Parameters
    ----------
    index
        Name of the file that stands for the folder.
    unpack
        From the stream of a bundle, and a function from the wanted name and the bytes of a file to the name that it gets,
        to the bytes of the index.
    named_files
        From the bytes of an index to the names of the files that it needs.
    """

    index: str
    unpack: Callable[[BinaryIO, Callable[[str, bytes], str]], bytes]
    named_files: Callable[[bytes], list[str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One file format: capabilities as data, that help, documents and tests read, and its functions.

    Parameters
    ----------
    id, title, extensions, spec
        Name for `--to`; name for people; lower-case file name endings; page in docs/.
    max_sh_degree
        Highest SH band that the format holds.
    min_splats
        Fewest splats that a file may hold.
    lossless
        Whether every attribute comes back with the same bits.
    precise
        Whether nothing changes but roundings of float32; values from other formats that are not lossless have lost more.
    holds_sequences, holds_motion, holds_extra
        Whether several frames, velocities with times, and other properties can be stored.
    fits_sequences
        Whether a sequence is fitted to one 4D asset where none of its frames was asked for.
    stores_origin, stores_coordinates, stores_splat_model
        Whether these facts about the cloud are stored.
    streams
        Whether `write` takes `CloudChunks` and needs no more memory than a chunk.
    order
        Order of splats that `save` chooses when none is asked for: "none" keeps the source's.
    required_coordinates
        Axis letters that the format is always in, or None where it takes any.
    position_type
        How positions are stored, for the advice on recentering: "f32", "f16" or "fixed".
    matches
        Whether a file that starts with these bytes (at most SNIFF_BYTES) is of this format.
    read
        Stream and read options to a scene; the stream can seek and starts at 0.
    read_chunks
        The same in chunks, for formats that allow it; the stream stays open while chunks are read.
    write
        Scene, stream that can seek, and write options; returns nothing.
    inspect
        Stream to header facts; must not import numba.
    bounds
        Source cloud (as given to `write`), stream of the written file, frame index: the largest errors that the
        encoding allows, derived from the ranges and bit depths in that file.
    check
        Stream to everything that is wrong with it, data decoded; None where reading the file is all there is to check.
    rules
        Every code that `check` may give, with its severity.
    folder
        How a target can be a folder's files, which one of a fixed name stands for; None where a target is one file.
    repair
        Stream of a file and stream to write: a file of today's spelling with the same content; None where there is
        nothing to repair.
    claims
        Whether a companion (a JSON object beside the file, see `_companion`) is of this format; None for formats
        without companions. Files that say themselves what they are do not need theirs to be read.
    read_options, write_options
        Frozen dataclasses whose defaults are the balanced choice.
    presets
        Changes to the write options for "fast", "balanced" and "best".
    knobs
        Options that trade bytes for accuracy, each with its values from coarsest to finest.
    sizes
        Valid cloud and write options to the entries of codebooks that it will be written with, by option; a part of a scene
        that stands for the whole takes its share of them.
    model
        Reference rendering model and variant that stands for what the format's users see.
    """

    id: str
    title: str
    extensions: tuple[str, ...]
    spec: str
    max_sh_degree: int
    matches: Callable[[bytes], bool]
    inspect: Callable[[BinaryIO], FileInfo]
    read: Callable[[BinaryIO, Any], GaussianCloud | GaussianSequence] | None = None
    read_chunks: Callable[[BinaryIO, Any], CloudChunks] | None = None
    write: Callable[[Any, BinaryIO, Any], None] | None = None
    bounds: Callable[[GaussianCloud, BinaryIO, int], Bounds] | None = None
    min_splats: int = 0
    check: Callable[[BinaryIO], Iterator[Issue]] | None = None
    rules: Mapping[str, Rule] = field(default_factory=dict)
    folder: FolderLayout | None = None
    repair: Callable[[BinaryIO, BinaryIO], list[str]] | None = None
    claims: Callable[[Mapping[str, Any]], bool] | None = None
    lossless: bool = False
    precise: bool = False
    holds_sequences: bool = False
    holds_motion: bool = False
    holds_extra: bool = False
    fits_sequences: bool = False
    stores_origin: bool = False
    stores_coordinates: bool = False
    stores_splat_model: bool = False
    streams: bool = False
    order: Literal["morton", "hilbert2d", "none"] = "none"
    required_coordinates: str | None = None
    position_type: str = "f32"
    read_options: type = NoOptions
    write_options: type = NoOptions
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    knobs: Mapping[str, Knob] = field(default_factory=general_knobs)
    sizes: Callable[[GaussianCloud, Any], Mapping[str, int]] | None = None
    model: tuple[str, str | None] = ("inria", None)

    @property
    def is_lossy(self) -> bool:
        """Whether values are quantized."""
        return not (self.lossless or self.precise)
