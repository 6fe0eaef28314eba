"""Which property of a PLY feeds which attribute, and what a file is that has none of them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import REST_COEFFICIENTS
from gsplat_tools.errors import CorruptDataError, FormatError
from gsplat_tools.formats._ply_header import PlyElement, PlyHeader, PlyProperty

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
OPACITY = "opacity"
REQUIRED = (*MEANS, *SH0, OPACITY, *SCALES[:2], *QUATS)

MOTION = {
    "velocities": (("vx", "velocity_x"), ("vy", "velocity_y"), ("vz", "velocity_z")),
    "times": (("time", "t"),),
    "durations": (("duration", "dt"),),
}
"""Both spellings of each motion property, the one that is written first."""

MOTION_DEFAULTS = {"velocities": 0.0, "times": 0.0, "durations": 1.0}

_REST_NAME = re.compile(r"f_rest_([0-9]{1,4})")
# Positions of these types are exact in float32 as they are.
_NARROW_TYPES = {("f", 4), ("i", 1), ("u", 1), ("i", 2), ("u", 2)}


@dataclass(frozen=True, slots=True)
class SplatLayout:
    """What the vertex element holds.

    Parameters
    ----------
    vertex
        The element.
    splat_columns
        14 + 3 (K - 1) property names: x y z, scale_0..2, rot_0..3, opacity, f_dc_0..2, then f_rest channel by channel;
        scale_2 may be None.
    sh_degree
        Highest band.
    motion
        Property names per motion attribute, None where one is missing; empty without motion.
    normals
        Those of nx ny nz that are there.
    extras
        Other scalar properties.
    lists
        Properties with lists, which no splat attribute takes.
    """

    vertex: PlyElement
    splat_columns: tuple[str | None, ...]
    sh_degree: int
    motion: dict[str, tuple[str | None, ...]]
    normals: tuple[str, ...]
    extras: tuple[str, ...]
    lists: tuple[str, ...]

    def find(self, name: str) -> PlyProperty:
        """Return the property of that name."""
        return self.vertex.by_name[name]

    @property
    def has_wide_positions(self) -> bool:
        """Whether positions are of a type that float32 may not hold."""
        kinds = [self.find(name).dtype for name in MEANS]
        return any((kind.kind, kind.itemsize) not in _NARROW_TYPES for kind in kinds)

    def float32_columns(self, names: tuple[str | None, ...]) -> NDArray[np.int64] | None:
        """Return the columns of properties in rows seen as float32 (-1 for None), or None where rows cannot be seen so."""
        if self.lists or self.vertex.min_row_bytes % 4:
            return None
        fields = self.vertex.row_dtype.fields
        assert fields is not None
        columns = []
        for name in names:
            if name is None:
                columns.append(-1)
                continue
            dtype, offset = fields[name][:2]
            if dtype != np.dtype("<f4") or not dtype.isnative or offset % 4:
                return None
            columns.append(offset // 4)
        return np.array(columns, np.int64)


def splat_layout(header: PlyHeader) -> SplatLayout:
    """Return which property feeds which attribute.

    Raises
    ------
    FormatError
        This is no splat file; the message says what is missing, what was found and what it may be.
    CorruptDataError
        The f_rest properties are not numbered 0 to n - 1, or n belongs to no SH degree.
    """
    vertex = header.element("vertex")
    if vertex is None or not {prop.name for prop in vertex.properties if prop.count_dtype is None} >= set(REQUIRED):
        raise _not_splats(header, vertex)
    scalars = [prop.name for prop in vertex.properties if prop.count_dtype is None]
    rest = _rest_names(vertex, scalars)
    scale_2 = SCALES[2] if SCALES[2] in scalars else None
    columns = (*MEANS, *SCALES[:2], scale_2, *QUATS, OPACITY, *SH0, *rest)
    motion = {
        name: tuple(next((spelling for spelling in spellings if spelling in scalars), None) for spellings in properties)
        for name, properties in MOTION.items()
    }
    motion_names = [name for names in motion.values() for name in names if name is not None]
    taken = {*columns, *motion_names, *NORMALS}
    return SplatLayout(
        vertex=vertex,
        splat_columns=columns,
        sh_degree=REST_COEFFICIENTS.index(len(rest) // 3),
        motion=motion if motion_names else {},
        normals=tuple(name for name in NORMALS if name in scalars),
        extras=tuple(name for name in scalars if name not in taken),
        lists=tuple(prop.name for prop in vertex.properties if prop.count_dtype is not None),
    )


def _rest_names(vertex: PlyElement, scalars: list[str]) -> list[str]:
    """Return the f_rest properties ordered by the integer in the name."""
    numbered = sorted((int(match[1]), name) for name in scalars if (match := _REST_NAME.fullmatch(name)))
    counts = [3 * coefficients for coefficients in REST_COEFFICIENTS]
    if len(numbered) not in counts:
        raise CorruptDataError(
            f"found {len(numbered)} f_rest properties; SH degree 0 to 4 has {', '.join(map(str, counts))}; export whole bands",
            field="f_rest",
            offset=vertex.line_offset,
        )
    for expected, (number, name) in enumerate(numbered):
        if number != expected:
            raise CorruptDataError(
                f"the {len(numbered)} f_rest properties must be numbered 0 to {len(numbered) - 1}; expected f_rest_{expected}, "
                f"found {name}",
                field="f_rest",
                offset=vertex.line_offset,
            )
    return [name for _, name in numbered]


def _not_splats(header: PlyHeader, vertex: PlyElement | None) -> FormatError:
    """Say what is missing, what was found, and what the file may be instead."""
    if vertex is None:
        found = ", ".join(element.name for element in header.elements) or "none"
        return FormatError(f"not a splat file: there is no element 'vertex'; the elements are: {found}", field="vertex")
    names = vertex.property_names()
    missing = [name for name in REQUIRED if name not in names]
    if not missing:
        lists = [prop.name for prop in vertex.properties if prop.count_dtype is not None and prop.name in REQUIRED]
        return FormatError(
            f"not a splat file: expected scalars, found lists: {', '.join(lists)}", field="vertex", offset=vertex.line_offset
        )
    shown = ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
    return FormatError(
        f"not a splat file: vertex lacks {', '.join(missing)}; found {shown or 'no properties'}{_guess(header, names)}",
        field="vertex",
        offset=vertex.line_offset,
    )


def _guess(header: PlyHeader, names: list[str]) -> str:
    """Return what a file that holds no splats may be, as the end of a sentence."""
    if "packed_position" in names or header.element("chunk") is not None:
        return "; this is the packed compressed-ply format: name it .compressed.ply"
    if {"scale_x", "scale_y"} & set(names) or {"alpha", "rot_w", "qw", "rot_x", "qx"} & set(names):
        return (
            "; it may hold activated values under other names: expected are log scales (scale_0..2), "
            "a logit opacity and a quaternion w x y z (rot_0..3)"
        )
    if any(element.name in {"face", "tristrips"} and element.count for element in header.elements):
        return "; it looks like a mesh: train or sample splats from it first"
    colors = {"red", "green", "blue", "diffuse_red", "r", "g", "b", "intensity"}
    if colors & set(names) or set(names) <= {*MEANS, *NORMALS}:
        return "; it looks like a point cloud (the input of a training, not its output)"
    return ""
