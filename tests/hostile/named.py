"""Files that break, or just keep, one rule each: what changes to single bytes seldom arrive at."""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from tests.hostile import rebuilders
from tests.hostile.large_json import large_bundles

Named = Iterator[tuple[str, bytes]]


def companions(text: bytes, data: bytes) -> Named:
    """Yield companions that say which file they describe, or described before."""
    sound = json.loads(text)
    right = {"bytes": len(data), "crc32": zlib.crc32(data)}
    for what, described in {
        "this file": right,
        "another size": right | {"bytes": len(data) + 1},
        "another checksum": right | {"crc32": right["crc32"] ^ 1},
        "more than that": right | {"x": 1},
        "a list": [],
    }.items():
        yield what, json.dumps(sound | {"file": described}).encode()
        yield f"{what}, before", json.dumps({"file": {}, "previous": sound | {"file": described}}).encode()
    yield "too long", text + b" " * (1 << 20)
    yield "not JSON", b"{"
    yield "no object", b"[]"


def ply() -> Named:
    from tests.builders import PlyElement, ply_file, splat_columns

    def file(*, change: dict[str, Any] | None = None, drop: tuple[str, ...] = (), degree: int = 0, **options: Any) -> bytes:
        columns = {**splat_columns(2, degree, normals=False), **(change or {})}
        return ply_file(PlyElement("vertex", {n: c for n, c in columns.items() if n not in drop}), **options)

    sound = file()
    comments = (
        *(
            "SplatRenderMode: mip",
            "antialiased 0",
            "coordinate_system LUF",
            "coordinate_system up",
            "time_model window",
            "",
            "x",
        ),
        *("temporal_cutoff 2", "temporal_cutoff nan", "temporal_cutoff x", "temporal_cutoff 0.5", "time_model never"),
        *("origin 1 2 x", "origin 1 2", "origin 1 2 3", "source_format spz", "source_format ../x", "generator anything"),
    )
    yield "comments", file(comments=comments)
    for comment in comments:
        yield f"comment {comment}", file(comments=(comment,))
    yield "origin that is not finite", file(comments=("origin 1 2 1e999",))
    yield "blank lines", sound.replace(b"element", b"\n \t\nelement", 1)
    yield "a long first line", sound.replace(b"ply\n", b"ply" + b" " * 5000 + b"\n", 1)
    yield "an endless first line", b"ply" + b" " * (1 << 20)
    yield "no end", b"ply\n" + b"comment x\n" * 110_000
    yield "an end that is none", sound.replace(b"end_header\n", b"\x0bend_header\nend_header\n", 1)
    yield "other numbers", file(degree=1, change={"f_rest_9": ("float", [0.0, 0.0])}, drop=("f_rest_8",))
    yield "half a band", file(degree=1, drop=("f_rest_8",))
    yield "packed", file(change={"packed_position": ("uint", [1, 2])}, drop=("x",))
    for name in ("scale_x", "scale_y", "alpha", "rot_w", "qw", "qx"):
        yield f"activated, {name}", file(change={name: ("float", [1.0, 2.0])}, drop=("opacity",))
    yield (
        "a mesh",
        ply_file(PlyElement("vertex", {"x": ("float", [1.0])}), PlyElement("face", {"i": ("list uchar int", [[0]])})),
    )
    yield "a mesh without faces", ply_file(PlyElement("vertex", {"x": ("float", [1.0])}), PlyElement("face", {}, count=0))
    yield "no vertex", ply_file(PlyElement("face", {"i": ("uchar", [0])}))
    yield "no properties", ply_file(PlyElement("vertex", {}, count=3))
    yield "a list where a number belongs", file(change={"x": ("list uchar float", [[1.0], [2.0]])})
    lists = {name: ("list char int", [[1], [2, 3]]) for name in ("a", "b")}
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        walked = file(change=lists, encoding=encoding)
        yield f"lists, {encoding}", walked
        yield f"real lengths, {encoding}", walked.replace(b"list char", b"list float")
        if encoding != "ascii":
            first = walked.index(b"end_header\n") + 11 + 14 * 4
            yield f"a negative length, {encoding}", walked[:first] + b"\xff" + walked[first + 1 :]
            yield f"too long a list, {encoding}", walked[:first] + b"\x7f" + walked[first + 1 :]
            last = walked[:-9] + b"\x7f" + walked[-8:]
            yield f"too long a last list, {encoding}", last
    # Larger than what is looked at before chunks are read, with normals that come after the first of 64 places.
    count = 64 * 256 + 4000
    names = list(splat_columns(1, 0))
    rows = np.zeros((count, len(names)), "<f4")
    rows[300, names.index("nx")] = 1
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *[f"property float {n}" for n in names]]
    yield "normals that are rare", "\n".join([*header, "end_header", ""]).encode() + rows.tobytes()


def compressed_ply() -> Named:
    from tests.builders import PlyElement, ply_file

    chunk: dict[str, Any] = {
        f"{end}_{axis}": ("float", [float(end == "max")])
        for axes in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
        for end in ("min", "max")
        for axis in axes
    }
    vertex: dict[str, Any] = {f"packed_{name}": ("uint", [1, 2]) for name in ("position", "rotation", "scale", "color")}

    def file(
        chunks: dict[str, Any] = chunk, words: dict[str, Any] = vertex, rest: tuple[int, int] | None = None, **options: Any
    ) -> bytes:
        elements = [PlyElement("chunk", chunks), PlyElement("vertex", words)]
        if rest is not None:
            number, rows = rest
            elements.append(PlyElement("sh", {f"f_rest_{i}": ("uchar", [i % 256] * rows) for i in range(number)}))
        return ply_file(*elements, **options)

    yield "as it is", file()
    yield "text", file(encoding="ascii")
    for number in (0, 1, 9, 24, 45, 72, 75):
        yield f"{number} coefficients", file(rest=(number, 2))
    yield "a row too few", file(rest=(9, 1))
    yield "without chunks", ply_file(PlyElement("vertex", vertex))
    yield "two chunks", file(chunks={name: (kind, values * 2) for name, (kind, values) in chunk.items()})
    yield "short words", file(words=vertex | {"packed_scale": ("ushort", [1, 2])})
    yield "real words", file(words=vertex | {"packed_scale": ("float", [1.0, 2.0])})
    yield "lists of words", file(words=vertex | {"packed_scale": ("list uchar uint", [[1], [2]])})
    yield "lists beside words", file(words=vertex | {"more": ("list uchar uint", [[1], [2]])})
    yield "other properties", file(words=vertex | {"more": ("uchar", [1, 2])})
    yield "half of the colors", file(chunks={name: column for name, column in chunk.items() if name != "max_b"})
    yield (
        "no splats",
        file(chunks={n: (k, []) for n, (k, _) in chunk.items()}, words={n: (k, []) for n, (k, _) in vertex.items()}),
    )
    yield "a range that is not finite", file(chunks=chunk | {"max_x": ("float", [float("nan")])})


def gspk(layout: str) -> Named:
    file = partial(rebuilders.gspk_file, layout)
    motion = {
        "velocities": ("f32", np.ones((3, 3))),
        "times": ("f32", np.linspace(0, 1, 3)),
        "durations": ("f32", np.full(3, 0.5)),
    }
    for degree in range(5):
        yield f"degree {degree}", file(degree=degree)
        yield f"degree {degree}, uncompressed", file(degree=degree, codec="none", json_last=True)
    for model in ("window", "gaussian", "never"):
        for cutoff in (None, 0.05, 0, 1, True, "x", 10**400):
            facts = {"time_model": model, "motion_bounds": None} | ({} if cutoff is None else {"temporal_cutoff": cutoff})
            yield f"motion, {model}, cutoff {str(cutoff)[:9]}", file(arrays=motion, facts=facts)
    yield "motion without streams", file(facts={"time_model": "window"})
    yield "a source", file(facts={"source_format": "spz"})
    yield "a source that is none", file(facts={"source_format": "../x"})
    yield "no splats", file(count=0)

    def share(description: dict[str, Any]) -> None:
        streams = description["streams"]
        streams[0]["offset"] = streams[1]["offset"]

    def cover(description: dict[str, Any]) -> None:
        description["streams"][0]["offset"] = 64

    yield "streams that share bytes", file(change=share, codec="none", json_last=True)
    yield "a stream in the description", file(change=cover, codec="none")
    yield "streams twice", file(change=lambda description: description["streams"].append(description["streams"][0]))
    for text in (
        b"[]",
        b"1",
        b"null",
        b'{"layout": NaN}',
        b"",
        b"{}",
        b"[" * 300 + b"]" * 300,
        b"[" + b"0," * 1_000_000 + b"0]",
    ):
        header = struct.pack("<4sIQQQII24x", b"GSPK", 1, 64 + len(text), 64, len(text), zlib.crc32(text), layout != "spark")
        yield f"description {text[:20]!r}", header + text
    header = struct.pack("<4sIQQQII24x", b"GSPK", 1, (64 << 20) + 65, 64, (64 << 20) + 1, 0, layout != "spark")
    yield "a description of 64 MiB", header.ljust((64 << 20) + 65, b"\0")


def spz() -> Named:
    from dataclasses import replace

    from tests.builders_spz import fixed24, random_file

    extensions = [(0xADBE0003, struct.pack("<I", 3)), (0xADBE0002, bytes(12))]
    for version in (1, 2, 3, 4):
        for degree in range(5):
            file = random_file(3, version=version, sh_degree=degree)
            yield f"version {version}, degree {degree}", file.data()
            for flags in (1, 2, 3, 4):
                yield (
                    f"version {version}, degree {degree}, flags {flags}",
                    replace(file, flags=flags, extensions=extensions if flags & 2 else []).data(),
                )
        yield f"version {version}, no splats", random_file(0, version=version).data()
        if version > 1:
            ends = fixed24([(1 << 23) - 1, -(1 << 23), 0] * 3)
            yield f"version {version}, ends", replace(random_file(3, version=version), positions=ends).data()
    for size in (1 << 20, (1 << 20) + 1):
        block = struct.pack("<II", 7, size - 8) + bytes(size - 8)
        for version in (2, 4):
            file = replace(random_file(2, version=version), flags=2, extensions=[(7, bytes(size - 8))])
            yield f"version {version}, {size} bytes of extensions", file.data()
        yield f"{size} bytes that follow", gzip.compress(random_file(2, version=2).raw() + block, 1, mtime=0)
    sound = random_file(3, version=4, sh_degree=1).data()
    for toc in (0, 1, 31, 33, len(sound)):
        yield f"table at {toc}", sound[:16] + struct.pack("<I", toc) + sound[20:]
    for number in range(6):  # streams that hold less and more than the table says
        place = 32 + 16 * number
        for step in (-1, 1):
            (length,) = struct.unpack_from("<Q", sound, place + 8)
            yield (
                f"stream {number}, length {step:+d}",
                sound[: place + 8] + struct.pack("<Q", length + step) + sound[place + 16 :],
            )
    yield "streams with fewer splats", sound[:8] + struct.pack("<I", 2) + sound[12:]
    for name in ("positions", "alphas", "sh"):
        for change in (lambda data: data[:-1], lambda data: data + b"\0", lambda data: b"", lambda data: data * 100):
            yield f"{name} of another length", _with_stream(random_file(3, version=4, sh_degree=1), name, change)


def _with_stream(file: Any, name: str, change: Callable[[bytes], bytes]) -> bytes:
    """Return a version 4 file with one stream that holds something else than the table says."""
    import zstandard

    names = ("positions", "alphas", "colors", "scales", "rotations", "sh")
    parts = [getattr(file, each) for each in names]
    frames = [zstandard.compress(change(part) if each == name else part) for each, part in zip(names, parts, strict=True)]
    table = b"".join(struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, parts, strict=True))
    return file.header() + struct.pack("<BI12s", len(names), 32, bytes(12)) + table + b"".join(frames)


def splat4d() -> Named:
    from tests.formats.splat4d.by_hand import Section, delta, meta, plain, record, with_band, with_deltas

    yield "nothing", b""
    yield "version 1, window", record(time=0.5) * 3
    yield "version 1, gaussian", record(time=0.5) * 2 + record(time=-2.0)
    yield "version 1, not finite", record(time=float("nan"), duration=float("inf"))
    for cutoff in (0.0, 1.0, -1.0, float("nan"), 0.5):
        for model in (1, 2):
            file = plain(time_model=model)
            file.sections[1] = meta(cutoff=cutoff)
            yield f"time model {model}, cutoff {cutoff}", file.build()
    yield "gaussian, odd times", plain(record(time=float("inf")), record(duration=-1), time_model=2).build()
    yield "window, odd times", plain(record(time=float("inf")), record(duration=-1), time_model=1).build()
    yield "null rotations", plain(record(quat=(128,) * 4)).build()
    for frames in (0, 4, 6):
        file = with_deltas()
        file.frames = frames
        yield f"deltas, {frames} frames", file.build()
    for index, start, frames in ((3, 1, 3), (3, 0, 0), (5, 4, 2), (5, 2, 2)):
        file = with_deltas()
        for section in file.sections[index : index + 2]:
            section.start, section.frames = start, frames
        yield f"section {index} from {start}, {frames} frames", file.build()
    for index in range(7):
        file = with_deltas()
        del file.sections[index]
        yield f"without section {index}", file.build()
    whole = delta(0, 3, 3, 2, [[], [(0, 0)]])
    for length in range(len(whole) + 2):
        file = with_deltas()
        file.sections[4].data = (whole + b"\0")[:length]
        yield f"{length} bytes of a delta", file.build()
    for block in ([(3, 0)], [(0, 2)], [(1, 0), (0, 0)], [(0, 0)] * 4):
        file = with_deltas()
        file.sections[4].data = delta(0, 3, 3, 2, [[], block])
        yield f"updates {block}", file.build()
    for labels in ((0, 1, 2), (0, 1, 65535)):
        yield f"labels {labels}", with_band(labels=labels).build()
    for kind in range(5):
        for encoding in range(4):
            file = with_band()
            file.sections[1] = meta((2, kind, encoding))
            yield f"centroids of type {kind}, labels of encoding {encoding}", file.build()
    file = with_band()
    file.sections.append(Section(b"XXXX", b"abc"))
    yield "a section of the future", file.build()


def sog() -> Named:
    from tests.formats.sog_files import archive, edited, palette_image, version_1, version_2, webp

    for text in (b"[]", b"1", b"{}", b"{", b"[" * 300 + b"]" * 300, b"[" + b"0," * 1_000_000 + b"0]"):
        yield f"meta.json {text[:20]!r}", archive(version_2(0) | {"meta.json": text})
    yield from large_bundles("sog")
    for bands in (1, 2, 3):
        yield f"version 1, {bands} bands", archive(version_1(bands))
        yield f"version 2, {bands} bands", archive(version_2(bands))
        for width in (64 * (3, 8, 15)[bands - 1], 100, 64 * 4):
            for files in (version_1(bands), version_2(bands)):
                yield f"{bands} bands, a palette {width} wide", archive(files | {"p.webp": webp([(1, 2, 3, 255)], width)})
    yield "too small a palette", archive(version_2(1) | {"p.webp": palette_image({}, 3, 3)})
    for name in ("../s.webp", "/s.webp", "a/../s.webp", "C:/s.webp", "a\\s.webp", "", ".", "s\0.webp"):
        yield f"named {name!r}", archive(edited(version_2(0), "scales.files", [name]))
    for count in (0, 4, 6, 20):
        yield f"{count} splats", archive(version_2(1, count=count))
    yield "two folders", archive({f"{a}/{name}": data for a in "ab" for name, data in version_2(0).items()})
    yield "a folder", archive(version_2(0), prefix="a/")


FOLDER_FILES = {"huge.webp": bytes(4 << 20), "empty.webp": b""}
"""What lies beside the meta.json whose relatives `folder` yields."""


def folder(text: bytes) -> Named:
    for name in ("huge.webp", "empty.webp", "missing.webp", "\ud800.webp", "n" * 300, "n" * 5000, "s.webp/", "s.webp/x", "é"):
        for stream in ("scales", "quats"):
            meta = json.loads(text)
            meta[stream]["files"] = [name]
            yield f"{stream} in {name[:9]!r}", json.dumps(meta).encode()


def lod_files() -> dict[str, bytes]:
    """What lies beside the lod-meta.json whose relatives `lod` yields."""
    from tests.formats.sog_files import archive, version_1, version_2

    return {
        "plain.sog": archive(version_2(0)),
        "mip.sog": archive(version_2(0, model="antialiased", antialias=True)),
        "old.sog": archive(version_1(2)),
        "nothing.sog": archive({"x": b""}),
        "broken.sog": b"PK",
        "text.sog": b"{}",
    }


def lod() -> Named:
    def file(filenames: list[Any], *nodes: dict[str, Any], levels: int = 2, **more: Any) -> bytes:
        children = [
            {"lods": {key: dict(zip(("file", "offset", "count"), rows, strict=True)) for key, rows in node.items()}}
            for node in nodes
        ]
        return json.dumps({"lodLevels": levels, "filenames": filenames, "tree": {"children": children}, **more}).encode()

    for name in lod_files():
        yield f"all of {name}", file([name], {"0": (0, 0, 5)})
        yield f"part of {name}", file([name], {"0": (0, 1, 2)})
        yield f"too much of {name}", file([name], {"0": (0, 4, 2)})
    yield "several models", file(["plain.sog", "mip.sog"], {"0": (0, 0, 5)}, {"0": (1, 0, 5)})
    yield "several degrees", file(["plain.sog", "old.sog"], {"0": (0, 0, 5)}, {"0": (1, 0, 5)})
    yield "twice", file(["plain.sog"], {"0": (0, 0, 3)}, {"0": (0, 2, 3)})
    yield "nothing in level 0", file(["plain.sog"], {"1": (0, 0, 5)})
    yield "no level", file(["plain.sog"])
    yield "empty pieces", file(["plain.sog"], {"0": (0, 0, 0)}, {"1": (0, 2, 0)})
    for key in ("2", "300", "-1", "x", "1" * 12):
        yield f"level {key}", file(["plain.sog"], {key: (0, 0, 5)})
    for levels in (0, 1, 256, 257, 1 << 40):
        yield f"{levels} levels", file(["plain.sog"], {"0": (0, 0, 5)}, levels=levels)
    for version in (1, 2, None, "1"):
        yield f"version {version}", file(["plain.sog"], {"0": (0, 0, 5)}, version=version)
    for name in ("../x.sog", "/x.sog", "\ud800.sog", "missing.sog", "n" * 300 + ".sog", "plain.sog/"):
        yield f"named {name[:9]!r}", file([name], {"0": (0, 0, 5)})
        yield f"environment {name[:9]!r}", file(["plain.sog"], {"0": (0, 0, 5)}, environment=name)
    yield "counts that differ", file(["plain.sog"], {"0": (0, 0, 5)}, counts=[4])
    yield "no tree", file(["plain.sog"], tree=1)


def sog4d() -> Named:
    from tests import sog4d_bundles as bundles

    def bundle(change: Callable[[Any], Any] = lambda meta: None, **files: Any) -> bytes:
        meta = bundles.valid_meta()
        change(meta)
        return bundles.archive(meta, bundles.valid_files() | files)

    for text in (b"[]", b"1", b"{}", b"[" * 300 + b"]" * 300, b"[" + b"0," * 1_000_000 + b"0]"):
        yield f"meta.json {text[:20]!r}", bundles.archive(text, bundles.valid_files())
    yield from large_bundles("sog4d")

    def without_bands(meta: Any) -> None:
        sh = meta["streams"]["sh"]
        meta["streams"]["sh"] = {"bands": 0, "sh0Path": sh["sh0Path"], "sh0Codebook": sh["sh0Codebook"]}

    yield "no bands", bundle(without_bands)
    yield "no bands, version 2", bundle(lambda meta: (without_bands(meta), meta.update(version=2)))
    for magic in (b"SOG4DLB1", b"SPL4DLB1"):
        whole = bundles.delta(0, 2, [[(3, 2, 0)]], magic=magic)
        for length in range(len(whole) + 2):
            yield f"{length} bytes of a delta", bundle(**{"sh/delta0.bin": (whole + b"\0")[:length]})

    def single_frames(meta: Any) -> None:
        meta["frameCount"] = frames
        meta["timeMapping"] = {"type": "uniform"}
        for name in ("rangeMin", "rangeMax"):
            meta["streams"]["position"][name] = meta["streams"]["position"][name][:1] * frames
        meta["streams"]["sh"]["shNDeltaSegments"] = [
            {"startFrame": i, "frameCount": 1, "baseLabelsPath": "sh/base0.webp", "deltaPath": f"sh/delta{i}.bin"}
            for i in range(frames)
        ]

    frames = 6
    files: dict[str, bytes] = {f"sh/delta{i}.bin": bundles.delta(i, 1, []) for i in range(frames)}
    sound = bundles.valid_files()
    files |= {
        f"frames/{i:05d}/{path[13:]}": sound[path] for i in range(frames) for path in sound if path[:12] == "frames/00000"
    }
    yield "a segment a frame", bundle(single_frames, **files)
