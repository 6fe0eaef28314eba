"""Seeds of every registered format: what its own writer makes of small clouds, and files assembled by hand."""

from __future__ import annotations

import gzip
import json
import struct
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import save
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.registry import FORMATS
from tests.clouds import random_cloud
from tests.hostile import archives, named, rebuilders
from tests.hostile.mutations import json_fields
from tests.hostile.seed import Seed, Span


@cache
def seeds_of(format_id: str) -> tuple[Seed, ...]:
    """Return the seeds of a format; one that is new here starts from what its writer makes."""
    seeds = [*_written(FORMATS[format_id]), *_BY_HAND.get(format_id, list)()]
    return tuple(
        replace(seed, named=_NAMED[format_id, seed.name]) if (format_id, seed.name) in _NAMED else seed for seed in seeds
    )


def _written(record: Format) -> Iterator[Seed]:
    """Yield what the writer makes of small clouds."""
    if record.write is None:
        return
    variants: list[tuple[str, dict[str, Any], dict[str, Any]]] = [("degree 1", {"sh_degree": 1}, {})]
    if record.holds_motion:
        variants.append(("moving", {"sh_degree": 0, "motion": True}, {}))
    if "raw_color" in {field.name for field in fields(record.write_options)}:
        variants.append(("raw colors", {"sh_degree": 0}, {"raw_color": True}))
    for name, cloud, options in variants:
        data, beside = written_files(record, cloud, **options)
        text_end = _text_end(data)
        spans = _SPANS.get(record.id, lambda data: (Span(0, min(len(data), 64)),))(data)
        if text_end:
            spans = (Span(0, text_end, "text"),)
        for companion, text in beside.items():
            whole = (Span(0, len(text), "text"),)
            files = {f"scene{record.extensions[0]}": data}
            yield Seed(
                f"companion, {name}",
                companion,
                text,
                whole,
                rebuild=(rebuilders.text(text),),
                beside=files,
                target=next(iter(files)),
                relatives=partial(json_fields, text),
                named=partial(named.companions, text, data),
            )
        if options and beside:
            continue  # another file without what lies beside it
        rebuild = (archives.zip_rebuilder(data),) if data[:2] == b"PK" else ()
        yield Seed(
            f"written, {name}", f"scene{record.extensions[0]}", data, spans, _SEALS.get(record.id, _default_seal(data)), rebuild
        )


def written_files(record: Format, cloud: dict[str, Any], **options: Any) -> tuple[bytes, dict[str, bytes]]:
    """Return the file of five random splats, and what lies beside it, without the checksum that ties the two together."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        path = Path(folder) / f"scene{record.extensions[0]}"
        save(random_cloud(5, **cloud), path, to=record.id, order="none", **options)
        beside = {}
        for other in Path(folder).iterdir():
            if other != path:
                companion = json.loads(other.read_bytes())
                companion.pop("file", None)
                beside[other.name] = json.dumps(companion).encode()
        return path.read_bytes(), beside


def _default_seal(data: bytes) -> Callable[[bytes], bytes]:
    return archives.seal if data[:2] == b"PK" else lambda changed: changed


def _text_end(data: bytes) -> int:
    return data.find(b"end_header") + 11 if data[:3] == b"ply" else 0


def _ply() -> list[Seed]:
    from tests.builders import PlyElement, ply_file, splat_columns

    plain = splat_columns(3, 1)
    doubles = splat_columns(3, 0, kind="double", normals=False)
    motion = {
        **splat_columns(2, 0, normals=False),
        "vx": ("float", [1.0, 2.0]),
        "t": ("double", [0.5, -1.0]),
        "dt": ("float", [2.0, 0.1]),
    }
    flat = {name: column for name, column in splat_columns(2, 0).items() if name != "scale_2"}
    lists = {**splat_columns(2, 0, normals=False), "neighbors": ("list uchar int", [[1, 2], []])}
    extra = {
        **splat_columns(2, 0, normals=False),
        "label": ("uchar", [1, 2]),
        "nx": ("float", [1.0, 0.0]),
        "x": ("double", [5e6, 1.5]),
    }
    face = PlyElement("face", {"vertex_indices": ("list uchar int", [[0, 1, 2]])})
    comments = ("origin 1 2 3", "SplatRenderMode: mip", "coordinate_system RUB", "time_model gaussian", "temporal_cutoff 0.05")
    files = {
        "plain": ply_file(PlyElement("vertex", plain)),
        "ascii": ply_file(PlyElement("vertex", doubles), encoding="ascii", comments=comments),
        "ascii lists": ply_file(face, PlyElement("vertex", lists), encoding="ascii"),
        "big-endian": ply_file(PlyElement("vertex", doubles), encoding="binary_big_endian", newline=b"\r\n"),
        "motion": ply_file(PlyElement("vertex", motion), comments=comments, obj_info=("x",)),
        "flat": ply_file(PlyElement("vertex", flat), newline=b"\r"),
        "lists": ply_file(face, PlyElement("vertex", lists)),
        "extras": ply_file(PlyElement("vertex", extra)),
    }
    return [
        Seed(
            name, "scene.ply", data, (Span(0, _header_end(data), "text"),), rebuild=(rebuilders.ply,) if name == "plain" else ()
        )
        for name, data in files.items()
    ]


def _header_end(data: bytes) -> int:
    start = data.find(b"end_header") + 10
    return start + 2 if data[start : start + 2] == b"\r\n" else start + 1


def _compressed_ply() -> list[Seed]:
    rng = np.random.default_rng(3)
    names = [
        f"{end}_{axis}"
        for axes in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"))
        for end in ("min", "max")
        for axis in axes
    ]
    lines = [
        "ply",
        "format binary_big_endian 1.0",
        "element chunk 1",
        *[f"property float {name}" for name in names],
        "element vertex 2",
    ]
    lines += [f"property int packed_{name}" for name in ("position", "rotation", "scale", "color")]
    lines += ["property uchar label", "element odd 1", "property list uchar uchar x", "end_header", ""]
    body = rng.standard_normal(12).astype(">f4").tobytes() + rng.bytes(2 * 17) + b"\x03abc"
    data = "\n".join(lines).encode() + body
    return [Seed("without colors, big-endian", "scene.compressed.ply", data, (Span(0, len(data) - len(body), "text"),))]


def gspk_spans(data: bytes) -> tuple[Span, ...]:
    offset, length = struct.unpack_from("<QQ", data, 16)
    return Span(0, 64), Span(offset, offset + length, "text")


def seal_gspk(data: bytes) -> bytes:
    """Make the checksum of the description right, and the length of the file."""
    if len(data) < 64:
        return data
    offset, length = struct.unpack_from("<QQ", data, 16)
    text = data[offset : offset + length] if offset + length <= len(data) else b""
    return data[:32] + struct.pack("<I", zlib.crc32(text)) + data[36:]


def _descriptions(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield a file whose description comes last with every field of it changed."""
    offset, length = struct.unpack_from("<QQ", data, 16)
    for what, text in json_fields(data[offset : offset + length]):
        header = data[:8] + struct.pack("<QQQ", offset + len(text), offset, len(text)) + data[32:offset]
        yield what, seal_gspk(header + text)


def _gspk(layout: str) -> Callable[[], list[Seed]]:
    def build() -> list[Seed]:
        sound = rebuilders.gspk_file(layout)
        tail = rebuilders.gspk_file(layout, codec="none", json_last=True)
        return [
            Seed("by hand", "scene.gspk", sound, gspk_spans(sound), seal_gspk, (rebuilders.gspk(layout),)),
            Seed("by hand, not sealed", "scene.gspk", sound, (Span(0, 64),)),
            Seed("description last", "scene.gspk", tail, gspk_spans(tail), seal_gspk, relatives=partial(_descriptions, tail)),
        ]

    return build


def _spz() -> list[Seed]:
    from tests.builders_spz import random_file

    extensions = [(0xADBE0003, struct.pack("<I", 3)), (0xADBE0002, bytes(12))]
    seeds = []
    for version in (1, 2, 3):
        file = random_file(3, version=version, sh_degree=version - 1)
        file.flags, file.extensions = (2, extensions) if version == 2 else (1, [])
        raw = file.raw()
        end = (Span(len(raw) - 32, len(raw)),) if version == 2 else ()
        seeds.append(Seed(f"version {version}, inside", "scene.spz", raw, (Span(0, 16), *end), _gzip, (rebuilders.spz,)))
    packed = _gzip(random_file(3, version=3, sh_degree=1).raw())
    seeds.append(Seed("version 3, outside", "scene.spz", packed, (Span(0, 18), Span(len(packed) - 8, len(packed)))))
    file = random_file(3, version=4, sh_degree=4)
    file.flags, file.extensions = 2, extensions
    data = file.data()
    rebuild = (rebuilders.spz_4, rebuilders.gzipped_spz_4)
    seeds.append(Seed("version 4", "scene.spz", data, (Span(0, 172),), rebuild=rebuild))
    return seeds


def _gzip(data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0)


def _splat4d() -> list[Seed]:
    from tests.formats.splat4d.by_hand import plain, record, with_band, with_deltas

    files = {
        "plain": plain(time_model=2),
        "band": with_band(),
        "deltas": with_deltas(),
        "shared labels": with_deltas(shares_labels=True),
    }
    seeds = [
        Seed(name, "scene.splat4d", file.build(), _splat4d_spans(file.build()), rebuild=(rebuilders.splat4d,))
        for name, file in files.items()
    ]
    one = record(time=3.0) + record()
    return [*seeds, Seed("version 1", "scene.splat4d", one, (Span(0, 64),))]


def _splat4d_spans(data: bytes) -> tuple[Span, ...]:
    """Return the header, and everything from META on: it stands before the labels and the table."""
    return Span(0, 64), Span(data.find(struct.pack("<If", 1, 0.01)), len(data))


def _sog4d() -> list[Seed]:
    from tests import sog4d_bundles as bundles

    one = bundles.valid_bundle()
    meta = bundles.valid_meta()
    meta["version"], meta["timeMapping"] = 2, {"type": "uniform"}
    sh = meta["streams"]["sh"]
    for key in [key for key in sh if key.startswith("shN")]:
        del sh[key]
    sh["bands"] = 2
    files = bundles.valid_files()
    for band, coefficients in ((1, 3), (2, 5)):
        sh[f"sh{band}"] = {
            "count": 2,
            "centroidsType": "f16",
            "centroidsPath": f"sh/{band}.bin",
            "labelsEncoding": "full",
            "labelsPath": f"frames/{{frame}}/labels{band}.webp",
        }
        files[f"sh/{band}.bin"] = np.arange(2 * 3 * coefficients, dtype="<f2").tobytes()
        for frame in range(bundles.FRAMES):
            files[f"frames/{frame:05d}/labels{band}.webp"] = bundles.image([(i % 2, 0) for i in range(bundles.SPLATS)])
    two = bundles.archive(meta, files, compression=8)
    return [
        Seed(
            "version 1, deltas",
            "scene.sog4d",
            one,
            archives.spans_of(one),
            archives.seal,
            (archives.zip_rebuilder(one),),
            relatives=archives.zip_relatives(one, bundles.BROKEN),
        ),
        Seed(
            "version 2, deflated",
            "scene.sog4d",
            two,
            archives.spans_of(two)[-1:],
            rebuild=(archives.zip_rebuilder(two),),
            relatives=archives.zip_relatives(two),
        ),
    ]


def _small(files: dict[str, bytes]) -> dict[str, bytes]:
    """Return a SOG scene of version 2 with codebooks of 32 entries, so that more of meta.json is something else."""
    from tests.formats.sog_files import palette_image, webp

    meta = json.loads(files["meta.json"])
    for key in ("scales", "sh0", "shN"):
        if key in meta:
            meta[key]["codebook"] = meta[key]["codebook"][:32]
    files = files | {"meta.json": json.dumps(meta).encode()}
    files |= {name: webp([(i, i + 1, 31 - i, 50 * i) for i in range(5)]) for name in ("s.webp", "c.webp")}
    return files | ({"p.webp": palette_image({69: [(1, 2, 31)] * 3}, 70, 3)} if "p.webp" in files else {})


def _sog() -> list[Seed]:
    from tests.formats.sog_files import archive, version_1
    from tests.formats.sog_files import version_2 as large

    def version_2(bands: int) -> dict[str, bytes]:
        return _small(large(bands, model="antialiased", antialias=bands == 0))

    seeds = []
    for name, files in (("version 2", version_2(1)), ("version 1", version_1(1)), ("version 2, plain", version_2(0))):
        data = archive(files)
        rebuild, relatives = (archives.zip_rebuilder(data),), archives.zip_relatives(data)
        seeds.append(Seed(name, "scene.sog", data, archives.spans_of(data), archives.seal, rebuild, relatives=relatives))
    packed = archive(version_2(1), deflated=True, prefix="folder/")
    seeds.append(
        Seed(
            "deflated, in a folder",
            "scene.sog",
            packed,
            archives.spans_of(packed)[-1:],
            rebuild=(archives.zip_rebuilder(packed),),
        )
    )
    files = version_2(0)
    meta = files.pop("meta.json")
    whole = tuple(archives.text_spans(meta, 0, len(meta)))
    rebuild = (rebuilders.text(meta),)
    seeds.append(
        Seed(
            "folder",
            "meta.json",
            meta,
            whole,
            rebuild=rebuild,
            beside=files | named.FOLDER_FILES,
            relatives=partial(json_fields, meta),
            named=partial(named.folder, meta),
        )
    )
    beside = {f"a/{name}": data for name, data in _small(large(0)).items()} | {
        "b.sog": archive(_small(large(1))),
        "env.sog": archive(version_1(1)),
    }
    beside |= named.lod_files()
    leaf = {"0": {"file": 0, "offset": 1, "count": 2}, "1": {"file": 1, "offset": 0, "count": 5}}
    tree = {
        "bound": {"min": [0, 0, 0], "max": [1, 1, 1]},
        "children": [{"lods": leaf}, {"lods": {"0": {"file": 0, "offset": 3, "count": 2}}}],
    }
    lod = {"lodLevels": 2, "counts": [4, 5], "filenames": ["a/meta.json", "b.sog"], "environment": "env.sog", "tree": tree}
    text = json.dumps(lod).encode()
    whole, rebuild = (Span(0, len(text), "text"),), (rebuilders.text(text),)
    seeds.append(
        Seed("levels", "lod-meta.json", text, whole, rebuild=rebuild, beside=beside, relatives=partial(json_fields, text))
    )
    return seeds


def _splat_span(data: bytes) -> tuple[Span, ...]:
    return (Span(0, min(len(data), 32)),)


_SPANS: dict[str, Callable[[bytes], tuple[Span, ...]]] = {
    "spark": gspk_spans,
    "uncompressed": gspk_spans,
    "gscc": lambda data: (Span(0, 40),),
    "spz": lambda data: (Span(0, 144),),
    "splat": _splat_span,
    "splat4d": lambda data: (Span(0, 64),),
    "sog": archives.spans_of,
    "sog4d": archives.spans_of,
}
_SEALS: dict[str, Callable[[bytes], bytes]] = {"spark": seal_gspk, "uncompressed": seal_gspk}
_BY_HAND: dict[str, Callable[[], list[Seed]]] = {
    "ply": _ply,
    "compressed-ply": _compressed_ply,
    "spark": _gspk("spark"),
    "uncompressed": _gspk("uncompressed"),
    "spz": _spz,
    "splat4d": _splat4d,
    "sog4d": _sog4d,
    "sog": _sog,
}
_NAMED: dict[tuple[str, str], Callable[[], Iterable[tuple[str, bytes]]]] = {
    ("ply", "plain"): named.ply,
    ("compressed-ply", "without colors, big-endian"): named.compressed_ply,
    ("spark", "by hand"): partial(named.gspk, "spark"),
    ("uncompressed", "by hand"): partial(named.gspk, "uncompressed"),
    ("spz", "version 4"): named.spz,
    ("splat4d", "plain"): named.splat4d,
    ("sog4d", "version 1, deltas"): named.sog4d,
    ("sog", "version 2"): named.sog,
    ("sog", "levels"): named.lod,
}
