"""Clouds to rows: binary little-endian, float32, every bit kept."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, LossyConversionWarning
from gsplat_tools.formats._ply_comments import comment_lines
from gsplat_tools.formats.base import NoOptions
from gsplat_tools.formats.ply.layout import MEANS, MOTION, OPACITY, QUATS, SCALES, SH0
from gsplat_tools.parallel import run_blocks

_TYPE_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
# Types without a name in PLY that another type holds exactly.
_EXACT_TYPES = {"b1": "u1", "f2": "f4"}


def write(scene: GaussianCloud | CloudChunks, stream: BinaryIO, _options: NoOptions | None = None) -> None:
    """Write a 3DGS PLY, binary little-endian.

    Parameters
    ----------
    scene
        Cloud or chunks; memory is bounded by a chunk.
    stream
        Written from its position on.

    Raises
    ------
    CapabilityError
        An extra property has a name that PLY cannot hold or that means something else there.

    Warns
    -----
    LossyConversionWarning
        Extras of a type that PLY lacks, or third scales of flat splats that are not -inf, were dropped.
    """
    chunks = as_chunks(scene)
    template = chunks.template
    num_scales = 2 if template.splat_model == "2dgs" else 3
    extras = _extra_columns(template)
    splat_names = _splat_names(template, num_scales)
    motion_names = [names[0] for properties in MOTION.values() for names in properties] if template.has_motion else []
    _check_names(set(splat_names) | {*SCALES}, motion_names, [name for name, _, _ in extras])
    tail = [(name, np.dtype("<f4")) for name in motion_names] + [(name, dtype) for name, dtype, _ in extras]
    stream.write(_header(template, len(chunks), splat_names, tail))
    dtype = np.dtype([("splat", "<f4", (len(splat_names),)), *tail])
    num_lost = 0
    for chunk in chunks:
        stream.write(_rows(chunk, dtype, num_scales, extras).data)
        if num_scales == 2:
            num_lost += int(np.count_nonzero(chunk.log_scales[:, 2] != -np.inf))
    if num_lost:
        warnings.warn(
            LossyConversionWarning(
                f"flat splats are stored without a third scale: dropped that of {num_lost} splats", code="dropped-scales"
            ),
            stacklevel=2,
        )


def _splat_names(template: GaussianCloud, num_scales: int) -> list[str]:
    """Return the properties of static attributes in the order of the rows."""
    rest = [f"f_rest_{i}" for i in range(3 * template.shN.shape[1])]
    return [*MEANS, *SH0, *rest, OPACITY, *SCALES[:num_scales], *QUATS]


def _extra_columns(template: GaussianCloud) -> list[tuple[str, np.dtype[Any], tuple[str, int | None]]]:
    """Return (property, type in the file, (key of extra, column or None)); arrays of several columns get numbered names."""
    columns: list[tuple[str, np.dtype[Any], tuple[str, int | None]]] = []
    dropped = []
    for key, values in template.extra.items():
        code = _EXACT_TYPES.get(values.dtype.str[1:], values.dtype.str[1:])
        if code not in _TYPE_NAMES:
            dropped.append(f"{key} ({values.dtype})")
            continue
        dtype = np.dtype(f"<{code}")
        if values.ndim == 1:
            columns.append((key, dtype, (key, None)))
        else:
            width = int(np.prod(values.shape[1:]))
            columns += [(f"{key}_{column}", dtype, (key, column)) for column in range(width)]
    if dropped:
        warnings.warn(
            LossyConversionWarning(f"PLY has no type for {', '.join(dropped)}: dropped", code="dropped-extra"), stacklevel=3
        )
    return columns


def _check_names(splat_names: set[str], motion_names: list[str], names: list[str]) -> None:
    """Refuse extras whose names a reader would take for something else."""
    motion_aliases = {name for properties in MOTION.values() for spellings in properties for name in spellings}
    # Where the motion is written, an alias of it is left alone by the reader.
    reserved = splat_names | (set(motion_names) if motion_names else motion_aliases)
    seen: set[str] = set()
    for name in names:
        if not re.fullmatch(r"[!-~]+", name):
            raise CapabilityError(f"PLY names are ASCII without spaces, found {name!r}; rename it", field="extra")
        if name in reserved or name in seen or re.fullmatch(r"f_rest_[0-9]{1,4}", name):
            raise CapabilityError(f"the extra property {name!r} would be read as something else; rename it", field="extra")
        seen.add(name)


def _header(template: GaussianCloud, count: int, splat_names: list[str], tail: list[tuple[str, np.dtype[Any]]]) -> bytes:
    """Return the header; the metadata stands in comments."""
    lines = ["ply", "format binary_little_endian 1.0", *comment_lines(template)]
    lines.append(f"element vertex {count}")
    lines += [f"property float {name}" for name in splat_names]
    lines += [f"property {_TYPE_NAMES[dtype.str[1:]]} {name}" for name, dtype in tail]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def _rows(
    chunk: GaussianCloud,
    dtype: np.dtype[Any],
    num_scales: int,
    extras: list[tuple[str, np.dtype[Any], tuple[str, int | None]]],
) -> NDArray[np.uint8]:
    """Return the bytes of the rows of a chunk."""
    from gsplat_tools.kernels.columns import gather_rows

    width = dtype["splat"].itemsize // 4
    packed = np.empty((len(chunk), width), np.float32)

    def fill(start: int, stop: int) -> None:
        part = chunk.take(slice(start, stop))
        gather_rows(
            part.means, part.log_scales, part.quats, part.opacity_logits, part.sh0, part.shN, num_scales, packed[start:stop]
        )

    run_blocks(fill, len(chunk))
    packed = packed.astype("<f4", copy=False)
    if dtype.names == ("splat",):
        return packed.view(np.uint8).reshape(-1)
    records = np.empty(len(chunk), dtype)
    records["splat"] = packed
    for name, values in _tail_columns(chunk, extras):
        records[name] = values
    return records.view(np.uint8)


def _tail_columns(
    chunk: GaussianCloud, extras: list[tuple[str, np.dtype[Any], tuple[str, int | None]]]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the columns after the static attributes: motion, then extras."""
    if chunk.has_motion:
        for attribute, properties in MOTION.items():
            values = getattr(chunk, attribute).reshape(len(chunk), len(properties))
            for column, spellings in enumerate(properties):
                yield spellings[0], values[:, column]
    for name, _, (key, column_or_none) in extras:
        values = chunk.extra[key]
        yield (
            name,
            values if column_or_none is None else values.reshape(len(chunk), int(np.prod(values.shape[1:])))[:, column_or_none],
        )
