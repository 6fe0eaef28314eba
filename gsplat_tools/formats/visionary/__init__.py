"""Buffers of Visionary's pipeline in a .vis with a JSON sidecar: its own f32 and f16, and an int8 of ours.

Layouts and decisions are in docs/formats/visionary.md.
"""

from __future__ import annotations

from functools import partial
from typing import Any, BinaryIO

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.visionary_buffers import MAX_SH_DEGREE, Precision
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.knobs import Knob, general_knobs
from gsplat_tools.formats.visionary import buffers, int8
from gsplat_tools.formats.visionary.buffers import BufferOptions
from gsplat_tools.formats.visionary.int8 import Int8Options
from gsplat_tools.formats.visionary.sidecar import IDS, ModelOptions

__all__ = ["FORMATS", "BufferOptions", "Int8Options", "ModelOptions"]

_SPEC = "docs/formats/visionary.md"


def _no_match(_head: bytes) -> bool:
    """Whether plain buffers are recognized by their first bytes: nothing tells."""
    return False


def _read(stream: BinaryIO, _options: Any, precision: Precision) -> GaussianCloud:
    """Read the whole cloud; values are as stored, invalid ones included."""
    return buffers.read_chunks(stream, precision).read()


def _read_chunks(stream: BinaryIO, _options: Any, precision: Precision) -> CloudChunks:
    """Return the cloud in chunks."""
    return buffers.read_chunks(stream, precision)


def _record(precision: Precision, title: str) -> Format:
    """Return the format of plain buffers."""
    return Format(
        id=IDS[precision],
        title=title,
        extensions=(".vis",),
        spec=_SPEC,
        max_sh_degree=MAX_SH_DEGREE,
        matches=_no_match,
        claims=lambda companion: companion.get("format") == IDS[precision],
        inspect=partial(buffers.inspect, precision=precision),
        read=partial(_read, precision=precision),
        read_chunks=partial(_read_chunks, precision=precision),
        write=partial(buffers.write, precision=precision),
        bounds=partial(buffers.bounds, precision=precision),
        min_splats=1,
        stores_origin=True,
        precise=precision == "f32",
        streams=True,
        position_type=precision,
        write_options=BufferOptions,
        presets={"fast": {}, "balanced": {}, "best": {}, "exact": {}},
        knobs=general_knobs(MAX_SH_DEGREE),
        model=("visionary", None),
    )


FORMATS = (
    _record("f16", "Visionary buffers, f16"),
    _record("f32", "Visionary buffers, f32"),
    Format(
        id=IDS["i8"],
        title="Visionary int8 (ours)",
        extensions=(".vis",),
        spec=_SPEC,
        max_sh_degree=MAX_SH_DEGREE,
        matches=int8.matches,
        claims=lambda companion: companion.get("format") == IDS["i8"],
        inspect=int8.inspect,
        read=int8.read,
        write=int8.write,
        bounds=int8.bounds,
        stores_origin=True,
        order="morton",
        position_type="fixed",
        write_options=Int8Options,
        presets={"fast": {"clip": 0.0}, "balanced": {}, "best": {}, "exact": {}},
        knobs={**general_knobs(MAX_SH_DEGREE), "position_bits": Knob(values=(8, 16), stream="positions")},
        model=("visionary", None),
    ),
)
"""In the order that an extension alone is taken for: Visionary's loaders store f16."""
