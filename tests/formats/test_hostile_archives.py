"""ZIP archives that lie: bombs, overlaps, encryption, names that lead away, and images larger than a scene needs."""

from __future__ import annotations

import io
import json
import struct
import zlib
from dataclasses import replace
from typing import Any

import pytest

from gsplat_tools.errors import CorruptDataError, FormatError, LimitExceededError
from gsplat_tools.formats import use_max_memory
from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.sog import SogReadOptions
from gsplat_tools.formats.sog import read as read_sog
from tests.formats.sog_files import archive, edited, version_2
from tests.hostile.archives import BOMB_BYTES, Entry, bomb, entries_of, extended, picture, zip_file


def peak(run: Any) -> int:
    """Bytes of Python and numpy that are allocated at once."""
    import tracemalloc

    tracemalloc.start()
    try:
        run()
    finally:
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return size


def test_entry_that_holds_more_than_it_says__is_read_no_further() -> None:
    reader = ZipReader(io.BytesIO(zip_file([Entry(b"a", b"", method=8, stored=bomb(), size=10)])))

    def read() -> None:
        with pytest.raises(CorruptDataError, match="does not decompress"):
            reader.read("a")

    assert peak(read) < 4 << 20


def test_entry_that_says_what_it_holds__is_refused_by_its_ratio() -> None:
    data = zip_file([Entry(b"a", b"", method=8, stored=bomb()[: 1 << 16], size=BOMB_BYTES)])

    with pytest.raises(LimitExceededError, match="--max-memory") as caught:
        ZipReader(io.BytesIO(data))
    assert caught.value.field == "a"

    with use_max_memory(BOMB_BYTES):
        assert ZipReader(io.BytesIO(data)).size("a") == BOMB_BYTES


def test_entry_that_is_shorter_than_it_says__is_refused() -> None:
    data = zip_file([Entry(b"a", b"abc", method=8, size=5)])

    with pytest.raises(CorruptDataError, match=r"holds 3 bytes, its record says 5|does not decompress"):
        ZipReader(io.BytesIO(data)).read("a")


def test_description_that_is_a_bomb__is_refused_before_it_is_unpacked() -> None:
    entries = [e for e in entries_of(archive(version_2(0))) if e.name != b"meta.json"]
    text = b"[" + b"[]," * 3_000_000 + b"[]]"  # 9 MB of JSON that take 200 MB as lists
    data = zip_file([Entry(b"meta.json", text, method=8), *entries])

    def read() -> None:
        with pytest.raises(FormatError, match=r"too many|more than is allowed"):
            read_sog(io.BytesIO(data), SogReadOptions())

    assert peak(read) < 64 << 20


@pytest.mark.parametrize("depth", [257, 900, 990, 1010, 100_000])
def test_description_that_is_deep__is_refused(depth: int) -> None:
    files = edited(version_2(0), "extra", None)
    files["meta.json"] = files["meta.json"].replace(b"null", b"[" * depth + b"]" * depth)

    with pytest.raises(CorruptDataError, match="inside each other"):
        read_sog(io.BytesIO(archive(files)), SogReadOptions())


@pytest.mark.parametrize("name", [b"/etc/passwd", b"../q.webp", b"a/../../b", b"C:\\x", b"a\\b", b"a\0b"])
def test_name_that_leads_away__is_refused(name: bytes) -> None:
    data = zip_file([*entries_of(archive(version_2(0))), Entry(name, b"x")])

    with pytest.raises(CorruptDataError, match="relative name") as caught:
        read_sog(io.BytesIO(data), SogReadOptions())
    assert caught.value.code == "zip-bad-name"  # type: ignore[attr-defined]


def test_data_that_a_local_header_moves_into_the_next_entry__are_refused() -> None:
    # zipfile of Python 3.11 takes them: what a scanner of the entries sees is not what is read.
    hidden = b"what is read"
    shown = Entry(b"a", b"what is seen", local_extra=len(hidden) + 30 + 1)
    data = zip_file([replace(shown, crc=zlib.crc32(hidden)), Entry(b"b", hidden), Entry(b"c", b"x")])
    reader = ZipReader(io.BytesIO(data))

    with pytest.raises(CorruptDataError, match="shares bytes") as caught:
        reader.read("a")
    assert (caught.value.field, caught.value.offset) == ("a", 0)
    assert caught.value.code == "zip-overlap"  # type: ignore[attr-defined]
    assert (reader.read("b"), reader.read("c")) == (hidden, b"x")


def test_data_that_a_local_header_moves_into_the_directory__are_refused() -> None:
    data = zip_file([Entry(b"a", b"abc"), Entry(b"b", b"abc", local_extra=3)])

    with pytest.raises(CorruptDataError, match="shares bytes"):
        ZipReader(io.BytesIO(data)).read("b")


def test_folder_entries__are_legal() -> None:
    data = zip_file([Entry(b"folder/", b""), *entries_of(archive(version_2(0)))])

    assert len(read_sog(io.BytesIO(data), SogReadOptions())) == 5


def test_two_files_of_a_name__are_refused() -> None:
    entries = entries_of(archive(version_2(0)))

    with pytest.raises(CorruptDataError, match="occurs again"):
        read_sog(io.BytesIO(zip_file([*entries, entries[0]])), SogReadOptions())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"flags": 1}, "encrypted"),
        ({"flags": 0x40}, "encrypted"),
        ({"method": 12, "stored": b"x"}, "method 12"),
        ({"offset": 0}, "shares bytes"),
        ({"stored_size": 1 << 20, "size": 1 << 20}, "shares bytes with the directory"),
    ],
)
def test_entry_that_cannot_be_trusted__is_refused_by_its_rule(change: dict[str, Any], message: str) -> None:
    first, *rest = entries_of(archive(version_2(0)))

    with pytest.raises(CorruptDataError, match=message):
        ZipReader(io.BytesIO(zip_file([first, *rest[:-1], replace(rest[-1], **change)])))


def test_image_far_larger_than_the_splats_need__is_refused_before_it_is_decoded() -> None:
    files = version_2(0) | {"q.webp": picture(2000, 1000)}

    def read() -> None:
        with pytest.raises(LimitExceededError, match="2000 x 1000"):
            read_sog(io.BytesIO(archive(files)), SogReadOptions())

    assert peak(read) < 2 << 20


def test_image_whose_canvas_is_not_its_picture__is_refused() -> None:
    files = version_2(0)
    files["q.webp"] = extended(200, 100, files["q.webp"])

    with pytest.raises(CorruptDataError, match=r"does not decompress|expected an image"):
        read_sog(io.BytesIO(archive(files)), SogReadOptions())


def test_splats_that_files_cannot_hold__are_refused() -> None:
    files = edited(version_2(0), "count", 1 << 40)

    with pytest.raises(LimitExceededError, match="decoded bytes"):
        read_sog(io.BytesIO(archive(files)), SogReadOptions())


def lod(levels: int, pieces: list[tuple[int, int]]) -> dict[str, Any]:
    leaves = [{"lods": {"0": {"file": 0, "offset": offset, "count": count}}} for offset, count in pieces]
    return {"lodLevels": levels, "filenames": ["a/meta.json"], "tree": {"children": leaves}}


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (lod(100_000_000, [(0, 5)]), "at most 256 levels"),
        (lod(1, [(0, 5)] * 1000), "named twice"),
        (lod(1, [(0, 3), (2, 2)]), "named twice"),
        (lod(1, [(0, 1 << 50)]), "5 are there"),
    ],
)
def test_tree_of_levels__makes_no_more_splats_than_there_are(scene: dict[str, Any], message: str, tmp_path: Any) -> None:
    for name, data in version_2(0).items():
        (tmp_path / "a").mkdir(exist_ok=True)
        (tmp_path / "a" / name).write_bytes(data)
    path = tmp_path / "lod-meta.json"
    path.write_text(json.dumps(scene))

    with path.open("rb") as stream, pytest.raises(CorruptDataError, match=message):
        read_sog(stream, SogReadOptions())


@pytest.mark.parametrize("name", ["a" * 5000, "\ud800.webp"])
def test_name_that_no_folder_can_hold__is_refused(name: str, tmp_path: Any) -> None:
    files = edited(version_2(0), "quats.files", [name])
    for known, data in files.items():
        (tmp_path / known).write_bytes(data)

    with (tmp_path / "meta.json").open("rb") as stream, pytest.raises(CorruptDataError):
        read_sog(stream, SogReadOptions())


def test_zip64_that_claims_the_end_of_the_world__is_refused() -> None:
    record = b"PK\x06\x06" + struct.pack("<QHHIIQQQQ", 44, 45, 45, 0, 0, 1, 1, 1 << 62, 1 << 62)
    locator = b"PK\x06\x07" + struct.pack("<IQI", 0, 40, 1)
    data = zip_file([Entry(b"meta.json", b"{}")], zip64=record + locator, directory_offset=0xFFFFFFFF, count=0xFFFF)

    with pytest.raises(CorruptDataError, match="ZIP archive"):
        ZipReader(io.BytesIO(data))
