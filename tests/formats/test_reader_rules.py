"""Refusals of the interchange formats name the rule that was broken, and the validator gives the same code."""

import gzip
import re
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.errors import FormatError, GsplatWarning
from gsplat_tools.formats import FORMATS, load, save
from gsplat_tools.validation import rules_of, validate
from tests.clouds import random_cloud

NAMES = {"spz": "a.spz", "compressed-ply": "a.compressed.ply", "splat": "a.splat", "sog": "a.sog"}


def patched(data: bytes, offset: int, value: bytes) -> bytes:
    return data[:offset] + value + data[offset + len(value) :]


def replaced(old: bytes, new: bytes) -> object:
    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


def with_extension(kind: int, payload: bytes, claimed: int | None = None) -> object:
    def change(data: bytes) -> bytes:
        toc = struct.unpack_from("<I", data, 16)[0]
        length = len(payload) if claimed is None else claimed
        record = struct.pack("<II", kind, length) + payload
        head = patched(patched(data[:toc], 16, struct.pack("<I", toc + len(record))), 14, bytes([data[14] | 2]))
        return head + record + data[toc:]

    return change


BROKEN = [
    ("spz", "header", lambda data: data[:20]),
    ("spz", "version", lambda data: patched(data, 4, b"\x09")),
    ("spz", "count", lambda data: patched(data, 8, b"\xff\xff\xff\xff")),
    ("spz", "degree", lambda data: patched(data, 12, b"\x07")),
    ("spz", "fractional-bits", lambda data: patched(data, 13, b"\x28")),
    ("spz", "streams", lambda data: patched(data, 15, b"\x02")),
    ("spz", "table", lambda data: data[:-5]),
    ("spz", "table", lambda data: patched(data, 16, struct.pack("<I", 1 << 30))),
    ("spz", "attribute", lambda data: data[:-40] + bytes(40)),
    ("spz", "extensions", with_extension(7, b"abc", claimed=1000)),
    ("spz", "extensions", with_extension(0xADBE0003, struct.pack("<I", 99))),
    ("compressed-ply", "header", lambda data: data[: data.index(b"property uint")]),
    ("compressed-ply", "binary", replaced(b"binary_little_endian", b"ascii")),
    ("compressed-ply", "chunk", replaced(b"property float min_x\n", b"")),
    ("compressed-ply", "chunk", replaced(b"property float min_y\n", b"property double min_y\n")),
    ("compressed-ply", "vertex", replaced(b"property uint packed_scale\n", b"")),
    ("compressed-ply", "sh", lambda data: data[:-5]),
    ("splat", "record-length", lambda data: data[:-1]),
    ("sog", "zip-invalid", lambda data: data[:-30]),
    ("sog", "image-format", lambda data: data.replace(b"WEBP", b"PEBW", 1)),
]


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
@pytest.mark.parametrize(("format_id", "code", "change"), BROKEN, ids=lambda value: value if isinstance(value, str) else "")
def test_refusal__names_its_rule(format_id: str, code: str, change: object, tmp_path: Path) -> None:
    path = tmp_path / NAMES[format_id]
    save(random_cloud(40, sh_degree=1), path)
    damaged = change(path.read_bytes())
    if code == "image-format":  # the archive's own checksum must not be what is found
        import zlib

        damaged = with_checksum(path.read_bytes(), damaged, zlib.crc32)
    path.write_bytes(damaged)

    with pytest.raises(FormatError) as caught:
        load(path)
    report = validate(path)

    assert caught.value.code == code
    assert [(issue["code"], issue["severity"]) for issue in report["issues"]] == [(code, "error")]
    assert report["valid"] is False


def with_checksum(whole: bytes, damaged: bytes, crc32: object) -> bytes:
    """Correct the CRC of the first entry of an archive."""
    name_length, extra_length = struct.unpack_from("<HH", whole, 26)
    start = 30 + name_length + extra_length
    stored = struct.unpack_from("<I", whole, 18)[0]
    old, new = (struct.pack("<I", crc32(data[start : start + stored])) for data in (whole, damaged))
    assert whole.count(old) == 2
    return damaged.replace(old, new)


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
def test_unknown_extension__is_skipped_with_a_code(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    save(random_cloud(40, sh_degree=1).replace(coordinate_system="RUF"), path)
    before = load(path)
    path.write_bytes(with_extension(7, b"abc")(path.read_bytes()))

    with pytest.warns(GsplatWarning, match="0x00000007"):
        cloud = load(path)

    assert cloud.coordinate_system == "RUF"
    assert np.array_equal(cloud.means, before.means)
    issues = {issue["code"]: issue["severity"] for issue in validate(path)["issues"]}
    assert issues.pop("left-out-extensions") == "warning"
    assert set(issues) <= {"invisible"}


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
def test_positions_at_an_end__are_told(tmp_path: Path) -> None:
    save(random_cloud(40, sh_degree=0), tmp_path / "a.spz", version=3)
    raw = gzip.decompress((tmp_path / "a.spz").read_bytes())
    (tmp_path / "a.spz").write_bytes(gzip.compress(patched(raw, 16 + 3 * 9, b"\x00\x00\x80")))

    issues = {issue["code"]: issue for issue in validate(tmp_path / "a.spz")["issues"]}

    assert issues["position-ends"]["severity"] == "warning"
    assert issues["position-ends"]["count"] == 1
    assert issues["position-ends"]["first"][0]["splat"] == 3


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
def test_box_without_an_inside__is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    save(random_cloud(600, sh_degree=0), path)
    data = path.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    boxes = np.frombuffer(data[start : start + 3 * 72], "<f4").reshape(3, 18).copy()
    boxes[1, 0] = boxes[1, 3] + 1
    path.write_bytes(patched(data, start, boxes.tobytes()))

    issues = {issue["code"]: issue for issue in validate(path)["issues"]}

    assert issues["box"]["count"] == 1
    assert issues["box"]["first"][0]["splat"] == 256


@pytest.mark.parametrize("format_id", NAMES)
def test_page__lists_every_rule_with_its_severity(format_id: str) -> None:
    page = (Path(__file__).parents[2] / FORMATS[format_id].spec).read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z0-9-]+)` \| (error|warning|info|hint) \|", page, re.MULTILINE))

    assert rows == {code: rule.severity for code, rule in FORMATS[format_id].rules.items()}
    assert set(rows) <= set(rules_of(FORMATS[format_id]))


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
@pytest.mark.parametrize("format_id", NAMES)
def test_sound_file__breaks_no_rule(format_id: str, tmp_path: Path) -> None:
    path = tmp_path / NAMES[format_id]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        save(random_cloud(300, sh_degree=1), path)

    assert {issue["code"] for issue in validate(path)["issues"]} <= {"axes-unknown", "invisible"}
