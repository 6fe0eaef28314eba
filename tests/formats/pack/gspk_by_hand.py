"""Assembles .gspk files with struct and json, from docs/formats/gspk.md and nothing of the package."""

import json
import math
import struct
import zlib

import numpy as np
import zstandard

DTYPES = {"f32": "<f4", "u32": "<u4"}


def assemble(description, arrays, *, codec="zstd", frame_rows=2, json_last=False, change=None, raw_change=None):
    """Bytes of a file.

    description  the JSON without frame_rows and streams
    arrays       {name: (dtype, array)}; streams are stored in reverse order, to show that no order is relied on
    change       called with the description before it is written
    raw_change   {(name, frame): bytes} stored instead of what is right
    """
    count = description["count"]
    description = dict(description, frame_rows=frame_rows, streams=[])
    body = bytearray()
    start = 64 if json_last else 64 * 64
    for name, (dtype, array) in reversed(arrays.items()):
        values = np.ascontiguousarray(array, DTYPES[dtype])
        body += bytes(-len(body) % 64)
        entry = {"name": name, "dtype": dtype, "shape": list(values.shape), "offset": start + len(body), "codec": codec}
        entry |= {"raw_length": values.nbytes, "frames": [], "crc32": []}
        for frame in range(math.ceil(count / frame_rows)):
            raw = values[frame * frame_rows : (frame + 1) * frame_rows].tobytes()
            stored = zstandard.ZstdCompressor().compress(raw) if codec == "zstd" else raw
            stored = (raw_change or {}).get((name, frame), stored)
            entry["frames"].append(len(stored))
            entry["crc32"].append(zlib.crc32(raw))
            body += stored
        entry["stored_length"] = sum(entry["frames"])
        description["streams"].append(entry)
    if change is not None:
        change(description)
    text = json.dumps(description, indent=1).encode()
    assert json_last or len(text) <= start - 64
    place = start + len(body) if json_last else 64
    layout = 1 if description.get("layout") == "uncompressed" else 0
    length = place + len(text) if json_last else start + len(body)
    header = struct.pack("<4sIQQQII24x", b"GSPK", 1, length, place, len(text), zlib.crc32(text), layout)
    padding = b"" if json_last else bytes(start - 64 - len(text))
    return header + (bytes(body) + text if json_last else text + padding + bytes(body))


def spark_description(count, degree, **changes):
    return {
        "layout": "spark",
        "count": count,
        "degree": degree,
        "bounds": {"min": [-1, -1, -1], "max": [1, 1, 1.5]},
        "origin": [0.5, 0, 1e6],
        "coordinate_system": "RUB",
        "splat_model": "antialiased",
        "splat_encoding": {"rgbMin": 0, "rgbMax": 1, "lnScaleMin": -12, "lnScaleMax": 9},
        "a key of the future": {"x": [1]},
        **changes,
    }
