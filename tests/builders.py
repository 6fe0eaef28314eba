"""Files assembled by hand with struct, independent of the package's writers."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

PLY_CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"} | {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass
class PlyElement:
    """An element: per property its PLY type ("float", or "list uchar int") and one value, or list of values, a row."""

    name: str
    columns: dict[str, tuple[str, Sequence[Any]]]
    count: int | None = None
    comments: Sequence[str] = field(default_factory=list)

    def rows(self) -> list[list[tuple[str, Any]]]:
        """Return rows of (type, value)."""
        return [
            [(kind, value) for kind, value in zip([k for k, _ in self.columns.values()], row, strict=True)]
            for row in zip(*[values for _, values in self.columns.values()], strict=True)
        ]


def ply_file(
    *elements: PlyElement,
    encoding: str = "binary_little_endian",
    comments: Sequence[str] = (),
    obj_info: Sequence[str] = (),
    newline: bytes = b"\n",
) -> bytes:
    """Return the bytes of a PLY."""
    lines = ["ply", f"format {encoding} 1.0", *[f"comment {c}" for c in comments], *[f"obj_info {c}" for c in obj_info]]
    for element in elements:
        rows = element.rows()
        lines.append(f"element {element.name} {len(rows) if element.count is None else element.count}")
        lines += [f"comment {c}" for c in element.comments]
        lines += [f"property {kind} {name}" for name, (kind, _) in element.columns.items()]
    header = newline.join(line.encode("utf-8") for line in [*lines, "end_header"]) + newline
    body = [ply_row(row, encoding, newline) for element in elements for row in element.rows()]
    return header + b"".join(body)


def ply_row(row: list[tuple[str, Any]], encoding: str, newline: bytes = b"\n") -> bytes:
    """Return the bytes of a row of (type, value)."""
    scalars: list[tuple[str, Any]] = []
    for kind, value in row:
        words = kind.split()
        if words[0] == "list":
            scalars += [(words[1], len(value)), *[(words[2], item) for item in value]]
        else:
            scalars.append((kind, value))
    if encoding == "ascii":
        is_real = {kind: PLY_CODES[kind] in "fd" for kind, _ in scalars}
        return " ".join(repr(float(v)) if is_real[k] else str(int(v)) for k, v in scalars).encode() + newline
    order = "<" if encoding == "binary_little_endian" else ">"
    return struct.pack(order + "".join(PLY_CODES[kind] for kind, _ in scalars), *[value for _, value in scalars])


def splat_columns(
    count: int = 3, sh_degree: int = 0, *, seed: int = 0, kind: str = "float", normals: bool = True
) -> dict[str, tuple[str, Sequence[Any]]]:
    """Return random columns of a 3DGS PLY, in the order of the reference code; values are float32 numbers."""
    rng = np.random.default_rng(seed)
    names = ["x", "y", "z", *(["nx", "ny", "nz"] if normals else []), "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((sh_degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return {
        name: (kind, [0.0] * count if name in ("nx", "ny", "nz") else rng.standard_normal(count).astype(np.float32).tolist())
        for name in names
    }


def splat_arrays(columns: Mapping[str, tuple[str, Sequence[Any]]]) -> dict[str, np.ndarray]:
    """Return what the columns mean, attribute by attribute, as plain indexing says it."""
    values = {name: np.array(column, np.float32) for name, (_, column) in columns.items()}
    stack = lambda *names: np.stack([values[name] for name in names], axis=1)  # noqa: E731
    num_rest = sum(name.startswith("f_rest_") for name in values) // 3
    count = len(values["x"])
    rest = np.empty((count, num_rest, 3), np.float32)
    for channel in range(3):
        for k in range(num_rest):
            rest[:, k, channel] = values[f"f_rest_{channel * num_rest + k}"]
    return {
        "means": stack("x", "y", "z"),
        "log_scales": stack("scale_0", "scale_1", "scale_2"),
        "quats": stack("rot_0", "rot_1", "rot_2", "rot_3"),
        "opacity_logits": values["opacity"],
        "sh0": stack("f_dc_0", "f_dc_1", "f_dc_2"),
        "shN": rest,
    }
