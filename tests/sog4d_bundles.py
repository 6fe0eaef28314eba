"""Bundles assembled by hand with json, struct, zipfile and Pillow, and the one change that breaks each rule."""

from __future__ import annotations

import io
import json
import struct
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

Files = dict[str, bytes]
WIDTH, HEIGHT, SPLATS, FRAMES = 3, 2, 5, 3
SCALES = [(0.5, 0.25, 0.125), (1.0, 0.5, 0.01), (2.0, 2.0, 2.0)]
SH0 = [(i - 128) / 64 for i in range(256)]
LABELS = [[0, 1, 2, 0, 1], [0, 1, 2, 2, 1], [1, 1, 1, 1, 1]]
"""Labels of the three frames; the first two make a segment, the third another."""


def webp(pixels: np.ndarray, **options: Any) -> bytes:
    """Encode (H, W, 4) bytes."""
    target = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8), "RGBA").save(target, "WEBP", **{"lossless": True, "exact": True, **options})
    return target.getvalue()


def image(rows: list[tuple[int, ...]], width: int = WIDTH, height: int = HEIGHT) -> bytes:
    """Encode one tuple of bytes a splat; alpha is 255 where a tuple has no fourth byte."""
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    for i, row in enumerate(rows):
        pixels[i, : len(row)] = row
    return webp(pixels.reshape(height, width, 4))


def delta(
    start: int,
    count: int,
    blocks: list[list[tuple[int, int, int]]],
    *,
    magic: bytes = b"SOG4DLB1",
    version: int = 1,
    splats: int = SPLATS,
    labels: int = 3,
) -> bytes:
    """Assemble a delta file from blocks of (splatId, newLabel, reserved)."""
    parts = [magic, struct.pack("<5I", version, start, count, splats, labels)]
    for block in blocks:
        parts.append(struct.pack("<I", len(block)))
        parts += [struct.pack("<IHH", *record) for record in block]
    return b"".join(parts)


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def valid_meta() -> dict[str, Any]:
    """meta.json of version 1 with delta labels and explicit times."""
    template = "frames/{frame}/"
    return {
        "format": "sog4d",
        "version": 1,
        "generator": "gsplat_tools test",
        "splatCount": SPLATS,
        "frameCount": FRAMES,
        "timeMapping": {"type": "explicit", "frameTimesNormalized": [0.0, 0.25, 1.0]},
        "layout": {"type": "row-major", "width": WIDTH, "height": HEIGHT},
        "streams": {
            "position": {
                "rangeMin": [vector(f, -1, 0) for f in range(FRAMES)],
                "rangeMax": [vector(f + 1, 1, 0) for f in range(FRAMES)],
                "hiPath": template + "hi.webp",
                "loPath": template + "lo.webp",
            },
            "scale": {"codebook": [vector(*row) for row in SCALES], "indicesPath": template + "scale.webp"},
            "rotation": {"path": template + "rotation.webp"},
            "sh": {
                "bands": 1,
                "sh0Path": template + "sh0.webp",
                "sh0Codebook": list(SH0),
                "shNCount": 3,
                "shNCentroidsType": "f32",
                "shNCentroidsPath": "sh/centroids.bin",
                "shNLabelsEncoding": "delta-v1",
                "shNDeltaSegments": [
                    {"startFrame": 0, "frameCount": 2, "baseLabelsPath": "sh/base0.webp", "deltaPath": "sh/delta0.bin"},
                    {"startFrame": 2, "frameCount": 1, "baseLabelsPath": "sh/base2.webp", "deltaPath": "sh/delta2.bin"},
                ],
            },
        },
    }


def centroids() -> np.ndarray:
    """Three entries of three coefficients of RGB."""
    return (np.arange(27, dtype=np.float32).reshape(3, 3, 3) - 13) / 8


def valid_files() -> Files:
    """Every file but meta.json."""
    files: Files = {}
    for frame in range(FRAMES):
        folder = f"frames/{frame:05d}/"
        files[folder + "hi.webp"] = image([(51 * i, 10 * frame, 0) for i in range(SPLATS)])
        files[folder + "lo.webp"] = image([(i, 7, 0) for i in range(SPLATS)])
        files[folder + "scale.webp"] = image([((i + frame) % 3, 0, 0) for i in range(SPLATS)])
        files[folder + "rotation.webp"] = image([(255, 128, 128 + i, 128 - 9 * frame) for i in range(SPLATS)])
        files[folder + "sh0.webp"] = image([(i, 100 + frame, 255 - i, 51 * i) for i in range(SPLATS)])
    files["sh/centroids.bin"] = centroids().astype("<f4").tobytes()
    files["sh/base0.webp"] = image([(label, 0) for label in LABELS[0]])
    files["sh/delta0.bin"] = delta(0, 2, [[(3, 2, 0)]])
    files["sh/base2.webp"] = image([(label, 0) for label in LABELS[2]])
    files["sh/delta2.bin"] = delta(2, 1, [])
    return files


def archive(meta: Any, files: Files, *, compression: int = zipfile.ZIP_STORED) -> bytes:
    """Zip meta.json (an object, or bytes as they are) and the files."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", compression) as bundle:
        if meta is not None:
            bundle.writestr("meta.json", meta if isinstance(meta, bytes) else json.dumps(meta))
        for name, data in files.items():
            bundle.writestr(name, data)
    return target.getvalue()


def valid_bundle() -> bytes:
    """A bundle that keeps every rule."""
    return archive(valid_meta(), valid_files())


def _with(path: str, value: Any) -> Callable[[], bytes]:
    """Change one field of meta.json; `value` of ... removes it."""

    def build() -> bytes:
        meta: Any = valid_meta()
        *parents, last = path.split("/")
        place = meta
        for part in parents:
            place = place[int(part) if part.isdigit() else part]
        if value is ...:
            del place[last]
        else:
            place[int(last) if last.isdigit() else last] = value
        return archive(meta, valid_files())

    return build


def _with_file(name: str, data: bytes | None) -> Callable[[], bytes]:
    """Replace a file, or leave it out."""

    def build() -> bytes:
        files = valid_files() | ({} if data is None else {name: data})
        if data is None:
            del files[name]
        return archive(valid_meta(), files)

    return build


def _raw_meta(data: bytes | None) -> Callable[[], bytes]:
    return lambda: archive(data, valid_files())


def _patched(find: bytes, offset: int, replacement: bytes, *, last: bool = False) -> Callable[[], bytes]:
    """Overwrite bytes of the archive near a mark."""

    def build() -> bytes:
        data = bytearray(valid_bundle())
        start = (data.rindex(find) if last else data.index(find)) + offset
        data[start : start + len(replacement)] = replacement
        return bytes(data)

    return build


def _encrypted() -> bytes:
    data = bytearray(valid_bundle())
    start = data.index(b"PK\x01\x02")
    data[start + 8] |= 1
    return bytes(data)


def _overlapping() -> bytes:
    """Let the second directory record point at the first entry."""
    data = bytearray(valid_bundle())
    first = data.index(b"PK\x01\x02")
    second = data.index(b"PK\x01\x02", first + 4)
    data[second + 42 : second + 46] = data[first + 42 : first + 46]
    return bytes(data)


def _ratio() -> bytes:
    files = valid_files()
    data = bytearray(archive(valid_meta(), files))
    first = data.index(b"PK\x01\x02")
    data[first + 24 : first + 28] = struct.pack("<I", 1 << 31)
    return bytes(data)


def _method() -> bytes:
    return archive(valid_meta(), valid_files(), compression=zipfile.ZIP_BZIP2)


def _corrupt_entry() -> bytes:
    data = bytearray(valid_bundle())
    start = data.index(b"sh/centroids.bin") + len(b"sh/centroids.bin")
    data[start + 5] ^= 0xFF
    return bytes(data)


def _too_small() -> bytes:
    """A layout far beyond what the file can hold."""
    meta = valid_meta()
    meta["layout"] |= {"width": 16383, "height": 16383}
    return archive(meta, valid_files())


def _added(name: str, data: str) -> Callable[[], bytes]:
    """A sound bundle with one more entry."""

    def build() -> bytes:
        target = io.BytesIO(archive(valid_meta(), valid_files()))
        with zipfile.ZipFile(target, "a") as bundle, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            bundle.writestr(zipfile.ZipInfo(name), data)
        return target.getvalue()

    return build


_SEGMENTS = "streams/sh/shNDeltaSegments"

BROKEN: dict[str, Callable[[], bytes]] = {
    "zip-invalid": lambda: b"PK\x03\x04 and nothing more",
    "zip-encrypted": _encrypted,
    "zip-method": _method,
    "zip-ratio": _ratio,
    "zip-overlap": _overlapping,
    "zip-entry-corrupt": _corrupt_entry,
    "zip-bad-name": _with_file("../outside.bin", b"1"),
    "zip-duplicate": _added("sh/centroids.bin", "x"),
    "zip-repeated": _added("meta.json", json.dumps(valid_meta())),
    "zip-entry-size": _with_file("sh/centroids.bin", bytes(2 * 27 * 4 + 1)),
    "meta-missing": _raw_meta(None),
    "meta-encoding": _raw_meta(b'{"format": "\xff"}'),
    "meta-json": _raw_meta(b"{"),
    "missing-field": _with("streams/rotation", ...),
    "wrong-type": _with("splatCount", "five"),
    "format": _with("format", "sog"),
    "version": _with("version", 3),
    "count": _with("frameCount", 0),
    "layout-type": _with("layout/type", "morton"),
    "layout-small": _with("layout/width", 2),
    "layout-limit": _too_small,
    "time-type": _with("timeMapping/type", "bezier"),
    "time-length": _with("timeMapping/frameTimesNormalized", [0.0, 1.0]),
    "time-value": _with("timeMapping/frameTimesNormalized", [0.0, 0.5, 0.25]),
    "path": _with("streams/rotation/path", "../{frame}/rotation.webp"),
    "path-template": _with("streams/rotation/path", "rotation.webp"),
    "range-length": _with("streams/position/rangeMin", [vector(0, 0, 0)]),
    "range-value": _with("streams/position/rangeMin/1", vector(9, 0, 0)),
    "codebook-empty": _with("streams/scale/codebook", []),
    "codebook-value": _with("streams/scale/codebook/1", vector(1, -1, 1)),
    "sh0-codebook-length": _with("streams/sh/sh0Codebook", [0.0] * 255),
    "sh0-codebook-value": _with("streams/sh/sh0Codebook/7", float("inf")),
    "bands": _with("streams/sh/bands", 4),
    "palette-count": _with("streams/sh/shNCount", 0),
    "centroids-type": _with("streams/sh/shNCentroidsType", "f64"),
    "labels-encoding": _with("streams/sh/shNLabelsEncoding", "delta-v2"),
    "segments": _with(f"{_SEGMENTS}/1/startFrame", 1),
    "file-missing": _with_file("frames/00001/sh0.webp", None),
    "image-format": _with_file("frames/00001/sh0.webp", b"not an image"),
    "image-size": _with_file("frames/00001/sh0.webp", image([(1, 2, 3, 4)], 2, 2)),
    "index-range": _with_file("frames/00002/scale.webp", image([(0, 0), (1, 0), (2, 0), (3, 0), (0, 1)])),
    "label-range": _with_file("sh/base2.webp", image([(0, 0), (3, 0), (1, 0), (1, 0), (1, 0)])),
    "centroids-size": _with_file("sh/centroids.bin", bytes(27 * 4 + 2)),
    "centroids-value": _with_file("sh/centroids.bin", np.full(27, np.nan, "<f4").tobytes()),
    "delta-magic": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 0)]], magic=b"SPL4DLB1")),
    "delta-version": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 0)]], version=2)),
    "delta-header": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 0)]], splats=6)),
    "delta-truncated": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 0)]])[:-1]),
    "delta-trailing": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 0)]]) + b"\0"),
    "delta-count": _with_file("sh/delta0.bin", delta(0, 2, [])[:28] + struct.pack("<I", SPLATS + 1)),
    "delta-splat": _with_file("sh/delta0.bin", delta(0, 2, [[(SPLATS, 2, 0)]])),
    "delta-order": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 0), (3, 1, 0)]])),
    "delta-label": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 3, 0)]])),
    "delta-reserved": _with_file("sh/delta0.bin", delta(0, 2, [[(3, 2, 1)]])),
    "vector-list": _with("streams/position/rangeMin/1", [1, -1, 0]),
    "json-null": _with("comment", None),
    "rotation-zero": _with_file("frames/00001/rotation.webp", image([(128,) * 4] + [(255, 128, 128, 128)] * 4)),
    "foreign-sh": _with("generator", ...),
    "unreferenced-file": _with_file("notes.txt", b"hello"),
}
"""For each rule a bundle that breaks it and no other."""
