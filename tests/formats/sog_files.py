"""SOG scenes assembled by hand with json, zipfile and Pillow, independent of the package's writer."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Pixels = list[tuple[int, int, int, int]]

COUNT = 5


def webp(pixels: Pixels, width: int | None = None) -> bytes:
    """Return a lossless image of RGBA pixels, row by row."""
    width = width or len(pixels)
    height = -(-len(pixels) // width)
    rows = np.zeros((height * width, 4), np.uint8)
    rows[: len(pixels)] = pixels
    target = io.BytesIO()
    Image.fromarray(rows.reshape(height, width, 4), "RGBA").save(target, "WEBP", lossless=True, exact=True)
    return target.getvalue()


def palette_image(entries: dict[int, list[tuple[int, int, int]]], count: int, coefficients: int) -> bytes:
    """Return an image of centroids, 64 entries a row; those that are not given index 0."""
    pixels: Pixels = [(0, 0, 0, 255)] * (-(-count // 64) * 64 * coefficients)
    for entry, colors in entries.items():
        for j, color in enumerate(colors):
            row, column = divmod(entry, 64)
            pixels[row * 64 * coefficients + column * coefficients + j] = (*color, 255)
    return webp(pixels, 64 * coefficients)


MEANS_L: Pixels = [(0, 255, 0, 255), (255, 0, 128, 255), (52, 1, 2, 255), (0, 0, 0, 255), (255, 255, 255, 255)]
MEANS_U: Pixels = [(0, 255, 0, 255), (255, 0, 128, 255), (18, 0, 0, 255), (128, 128, 128, 255), (255, 255, 255, 255)]
QUATS: Pixels = [(0, 128, 255, 252), (1, 2, 3, 253), (200, 100, 50, 254), (128, 127, 128, 255), (9, 9, 9, 251)]
SCALES: Pixels = [(0, 1, 2, 255), (255, 254, 253, 255), (3, 3, 3, 255), (0, 0, 0, 255), (9, 8, 7, 255)]
COLORS: Pixels = [(0, 1, 2, 0), (255, 0, 128, 255), (5, 6, 7, 128), (1, 1, 1, 1), (2, 2, 2, 254)]


def version_2(bands: int = 1, **changes: Any) -> dict[str, bytes]:
    """Return the files of a scene of five splats; changes go into meta.json."""
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "by hand"},
        "count": COUNT,
        "means": {"mins": [-1.0, 0.0, -2.0], "maxs": [1.0, 3.0, 2.0], "files": ["low.webp", "high.webp"]},
        "scales": {"codebook": [-12 + i / 16 for i in range(256)], "files": ["s.webp"]},
        "quats": {"files": ["q.webp"]},
        "sh0": {"codebook": [-2 + i / 64 for i in range(256)], "files": ["c.webp"]},
    }
    files = {
        "low.webp": webp(MEANS_L, 3),
        "high.webp": webp(MEANS_U, 2),
        "s.webp": webp(SCALES),
        "q.webp": webp(QUATS),
        "c.webp": webp(COLORS),
    }
    if bands:
        coefficients = (3, 8, 15)[bands - 1]
        meta["shN"] = {
            "count": 70,
            "bands": bands,
            "codebook": [-1 + i / 128 for i in range(256)],
            "files": ["p.webp", "l.webp"],
        }
        colors = [(10 * j, 10 * j + 1, 10 * j + 2) for j in range(coefficients)]
        files["p.webp"] = palette_image({0: [(128, 128, 128)] * coefficients, 69: colors}, 70, coefficients)
        files["l.webp"] = webp([(69, 0, 0, 255), (0, 0, 0, 255), (70, 0, 0, 255), (0, 1, 0, 255), (69, 0, 0, 255)])
    meta |= changes
    return files | {"meta.json": json.dumps(meta).encode()}


def version_1(bands: int = 2) -> dict[str, bytes]:
    """Return the files of the same splats in version 1."""
    coefficients = (3, 8, 15)[bands - 1]
    meta = {
        "means": {
            "shape": [COUNT, 3], "dtype": "float32", "mins": [-1.0, 0.0, -2.0], "maxs": [1.0, 3.0, 2.0],
            "files": ["low.webp", "high.webp"],
        },
        "scales": {"shape": [COUNT, 3], "mins": [-8.0, -9.0, -10.0], "maxs": [0.0, 1.0, 2.0], "files": ["s.webp"]},
        "quats": {"shape": [COUNT, 4], "encoding": "quaternion_packed", "files": ["q.webp"]},
        "sh0": {"shape": [COUNT, 1, 4], "mins": [-1, -2, -3, -6], "maxs": [1, 2, 3, 12], "files": ["c.webp"]},
        "shN": {"shape": [COUNT, coefficients], "mins": -0.5, "maxs": 0.5, "quantization": 8, "files": ["p.webp", "l.webp"]},
    }  # fmt: skip
    files = version_2(bands)
    return files | {"meta.json": json.dumps(meta).encode()}


def archive(files: dict[str, bytes], *, deflated: bool = False, prefix: str = "") -> bytes:
    """Return a ZIP of the files, in their order."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED if deflated else zipfile.ZIP_STORED) as bundle:
        for name, data in files.items():
            bundle.writestr(prefix + name, data)
    return target.getvalue()


def folder(files: dict[str, bytes], root: Path) -> Path:
    """Write the files below a folder and return the path of its meta.json."""
    for name, data in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(data)
    return root / "meta.json"


def edited(files: dict[str, bytes], path: str, value: Any) -> dict[str, bytes]:
    """Return the files with one field of meta.json, "a.b", replaced, or removed where the value is `...`."""
    meta = json.loads(files["meta.json"])
    *parents, name = path.split(".")
    node = meta
    for parent in parents:
        node = node[parent]
    if value is ...:
        del node[name]
    else:
        node[name] = value
    return files | {"meta.json": json.dumps(meta).encode()}
