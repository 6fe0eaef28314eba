"""Objects in stores: read by range, written by parts, seen whole or not at all; stores that fail."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cluster.blocks import convert_blocks
from gsplat_tools.cluster.engines import InProcess
from gsplat_tools.cluster.sequences import convert_sequence
from gsplat_tools.convert import convert
from gsplat_tools.errors import CapabilityError, ReadError, TargetExistsError, WriteError
from gsplat_tools.formats import _store_requests, _stores, load
from gsplat_tools.formats._stores import is_url, local_path, replacing_object, url_of
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud
from tests.cluster.sequences import local_bundle, make_frames, sha256
from tests.cluster.stores import BUCKET, Proxy, s3_server
from tests.cluster.test_sequences import SHORT

fsspec = pytest.importorskip("fsspec")
pytestmark = pytest.mark.cluster


@pytest.fixture
def memory() -> Iterator[Any]:
    system = fsspec.filesystem("memory")
    yield system
    system.store.clear()


@pytest.fixture(scope="module")
def s3() -> Iterator[Proxy]:
    pytest.importorskip("moto")
    with s3_server() as proxy, pytest.MonkeyPatch.context() as patch:
        patch.setattr(_store_requests, "_FIRST_PAUSE", 0.01)
        yield proxy


@pytest.fixture
def store(s3: Proxy) -> Iterator[Proxy]:
    """The server, without faults and objects at first, its errors given up soon."""
    s3.reset()
    yield s3
    s3.fault = None
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    for name in system.find(BUCKET):
        system.rm(name)


def s3_bytes(name: str) -> bytes:
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    return bytes(system.cat(f"{BUCKET}/{name}"))


def s3_names() -> list[str]:
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    return sorted(system.find(BUCKET))


def test_urls__survive_being_paths() -> None:
    for url in ("s3://bucket/a/b.ply", "memory://a.ply", "gs://bucket/x"):
        assert is_url(url)
        assert is_url(Path(url))
        assert url_of(Path(url)) == url == url_of(url)
    for path in ("/a/b", "a/b", "C:/a", "C:\\a", "file:///a/b", ""):
        assert not is_url(path), path
    assert local_path("file:///a/b.ply") == Path("/a/b.ply")


def test_objects__are_sources_and_targets(memory: Any, tmp_path: Path) -> None:
    cloud = random_cloud(50)
    save(cloud, "memory://b/a.ply")
    save(cloud, tmp_path / "a.ply")
    assert memory.cat("/b/a.ply") == (tmp_path / "a.ply").read_bytes()

    report = convert(["memory://b/a.ply"], "memory://b/a.spz").to_json()
    convert([f"file://{tmp_path}/a.ply"], f"file://{tmp_path}/a.spz")

    assert report["target"]["path"] == "memory://b/a.spz"
    assert memory.cat("/b/a.spz") == (tmp_path / "a.spz").read_bytes()
    assert np.array_equal(load("memory://b/a.ply").means, cloud.means)  # type: ignore[union-attr]
    with pytest.raises(TargetExistsError, match=r"memory://b/a\.spz"):
        convert(["memory://b/a.ply"], "memory://b/a.spz")
    with pytest.raises(FileNotFoundError):
        load("memory://b/none.ply")
    with pytest.raises(CapabilityError, match="more than one file"):
        save(cloud, "memory://b/a.vis")


def test_a_writer_that_fails__shows_nothing(memory: Any) -> None:
    def fail() -> None:
        with replacing_object("memory://b/x", overwrite=False) as stream:
            stream.write(b"half")
            assert not memory.exists("/b/x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert not memory.exists("/b/x")


def test_a_sequence_in_s3__has_the_bytes_of_one_on_the_disk(store: Proxy, tmp_path: Path) -> None:
    pattern = make_frames(tmp_path / "frames", 4, 60)
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)
    system = fsspec.filesystem("s3")
    for path in (tmp_path / "frames").iterdir():
        system.put(str(path), f"{BUCKET}/frames/{path.name}")

    convert_sequence([f"s3://{BUCKET}/frames/*.ply"], f"s3://{BUCKET}/out.sog4d", InProcess(), validation=None, **SHORT)

    assert sha256(s3_bytes("out.sog4d")) == expected
    assert [name for name in s3_names() if "frames" not in name] == [f"{BUCKET}/out.sog4d"]


def test_a_header__is_read_without_the_rest(store: Proxy) -> None:
    system = fsspec.filesystem("s3")
    save(random_cloud(120_000, sh_degree=3), "s3://bucket/large.ply")
    size = system.info(f"{BUCKET}/large.ply")["size"]
    assert size > 2 * _stores.BLOCK_BYTES
    store.reset()

    info = inspect_file("s3://bucket/large.ply")[1]

    assert info.splats == 120_000
    read = [
        each for (method, path), each in zip(store.log, store.ranges, strict=True) if (method, "large" in path) == ("GET", True)
    ]
    starts_ends = [tuple(map(int, each.removeprefix("bytes=").split("-"))) for each in read]
    assert 0 < sum(end - start + 1 for start, end in starts_ends) < size


def test_an_upload_that_is_cut_off__leaves_the_object_as_it_was(store: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    with replacing_object("s3://bucket/x", overwrite=True) as stream:
        stream.write(b"before")

    def refuses_later_parts(method: str, path: str, _number: int) -> str | None:
        return "503" if method == "PUT" and "partNumber=2" in path else None

    store.fault = refuses_later_parts

    def write() -> None:
        with replacing_object("s3://bucket/x", overwrite=True, block_bytes=5 << 20) as stream:
            for _ in range(12):
                stream.write(bytes(1 << 20))

    with pytest.raises(WriteError, match=r"s3://bucket/x: cannot write to the store"):
        write()
    store.fault = None
    assert store.failed > 0
    assert s3_bytes("x") == b"before"


def test_a_store_that_is_busy_now_and_then__changes_no_byte(store: Proxy, tmp_path: Path) -> None:
    save(random_cloud(40), tmp_path / "a.ply")
    fsspec.filesystem("s3").put(str(tmp_path / "a.ply"), f"{BUCKET}/a.ply")
    convert([tmp_path / "a.ply"], tmp_path / "a.spz")
    store.failed = 0
    store.fault = lambda _method, _path, number: ("503", None, None, "cut", None)[number % 5]

    convert(["s3://bucket/a.ply"], "s3://bucket/a.spz")

    store.fault = None
    assert store.failed > 0
    assert s3_bytes("a.spz") == (tmp_path / "a.spz").read_bytes()


def test_a_store_that_stays_busy__is_an_error_that_names_it(store: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    save(random_cloud(20), "s3://bucket/a.ply")
    store.fault = lambda _method, _path, _number: "503"

    with pytest.raises(ReadError, match=r"s3://bucket/a\.ply: cannot read from the store"):
        load("s3://bucket/a.ply")


def test_an_object_that_is_replaced_while_it_is_read__is_an_error(store: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_stores, "BLOCK_BYTES", 1 << 19)
    system = fsspec.filesystem("s3")
    system.pipe_file(f"{BUCKET}/x", bytes(3 << 20))
    with _stores.open_object("s3://bucket/x") as stream:
        assert stream.read(1 << 18) == bytes(1 << 18)
        system.pipe_file(f"{BUCKET}/x", bytes(reversed(range(256))) * (3 << 12))
        with pytest.raises(ReadError, match=r"s3://bucket/x: the object was replaced"):
            stream.read()


def test_reads_here_and_there__give_the_bytes_that_are_there(memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_stores, "BLOCK_BYTES", 1000)
    data = np.random.default_rng(1).bytes(400_000)
    memory.pipe_file("/b/x", data)
    with _stores.open_object("memory://b/x") as stream:
        for start in (0, 390_000, 5, 263_000, 399_999, 400_000, 500_000, 17):
            for size in (1, 999, 1001, 70_000):
                assert stream.seek(start) == start
                assert stream.read(size) == data[start : start + size]
        assert stream.seek(-3, 2) == 399_997
        assert stream.read() == data[-3:]


def test_a_scene_in_blocks_in_s3__has_the_bytes_of_one_on_the_disk(store: Proxy, tmp_path: Path) -> None:
    options = {"sh_palette_size": 40, "scale_codebook_size": 60, "webp_effort": 0}
    save(random_cloud(20_000, sh_degree=1), tmp_path / "a.ply")
    fsspec.filesystem("s3").put(str(tmp_path / "a.ply"), f"{BUCKET}/a.ply")
    expected = local_bundle(str(tmp_path / "a.ply"), tmp_path / "local.sog4d", **options)

    report = convert_blocks("s3://bucket/a.ply", "s3://bucket/out.sog4d", InProcess(), block_splats=1, **options)  # type: ignore[arg-type]

    assert report.cluster["blocks"] == 2
    assert sha256(s3_bytes("out.sog4d")) == expected == report.cluster["sha256"]
    assert s3_names() == [f"{BUCKET}/a.ply", f"{BUCKET}/out.sog4d"]
