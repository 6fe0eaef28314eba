"""gs:// on an emulator: read by range, written by a resumable upload, published last."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cluster.engines import InProcess
from gsplat_tools.cluster.sequences import convert_sequence
from gsplat_tools.convert import convert
from gsplat_tools.errors import ReadError, TargetExistsError, WriteError
from gsplat_tools.formats import _store_requests, _stores, load
from gsplat_tools.formats._store_requests import use_store_timeout
from gsplat_tools.formats._stores import exists, identity, matching, remove, replacing_object
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud
from tests.cluster.sequences import local_bundle, make_frames, sha256
from tests.cluster.stores import BUCKET, Proxy
from tests.cluster.test_sequences import SHORT

gcsfs = pytest.importorskip("gcsfs", reason="needs gcsfs; scripts/setup dev-gs installs it")
emulator = pytest.importorskip("gcp_storage_emulator.server", reason="needs gcp-storage-emulator; scripts/setup dev-gs")
pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]  # the emulator's, of its own age


@pytest.fixture(scope="module")
def google() -> Iterator[Proxy]:
    logging.getLogger("gcp_storage_emulator").setLevel(logging.CRITICAL)
    logging.getLogger("gcsfs").setLevel(logging.CRITICAL)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = emulator.create_server("127.0.0.1", port, in_memory=True, default_bucket=BUCKET)
    server.start()
    proxy = Proxy(port)
    with pytest.MonkeyPatch.context() as patch, use_store_timeout(1.0):
        patch.setenv("STORAGE_EMULATOR_HOST", proxy.url)
        patch.setenv("GOOGLE_CLOUD_PROJECT", "project")
        patch.setenv("NO_PROXY", "127.0.0.1")
        patch.setattr(_store_requests, "_FIRST_PAUSE", 0.01)
        patch.setattr(_store_requests, "TRIES", 3)
        _forget()
        yield proxy
        _forget()
    proxy.close()
    server.stop()


def _forget() -> None:
    for kind in (gcsfs.GCSFileSystem, _store_requests._gs()):
        kind.clear_instance_cache()


@pytest.fixture
def store(google: Proxy) -> Iterator[Proxy]:
    google.reset()
    yield google
    google.reset()
    for url in matching("gs://bucket/**"):
        remove(url)


def content(url: str) -> bytes:
    system, name = _store_requests.file_system(url)
    system.invalidate_cache()
    return bytes(system.cat_file(name))


def test_an_object__is_there_has_an_identity_and_can_be_removed(store: Proxy) -> None:
    assert not exists("gs://bucket/x")
    for data in (b"first", b"again"):
        with replacing_object("gs://bucket/x", overwrite=True) as stream:
            stream.write(data)
            before = identity("gs://bucket/x") if exists("gs://bucket/x") else ""
        assert content("gs://bucket/x") == data
        assert identity("gs://bucket/x") != before
    with pytest.raises(TargetExistsError), replacing_object("gs://bucket/x", overwrite=False) as stream:
        stream.write(b"third")
    assert matching("gs://bucket/*") == ["gs://bucket/x"]
    remove("gs://bucket/x")
    remove("gs://bucket/x")
    assert not exists("gs://bucket/x")
    with pytest.raises(FileNotFoundError):
        load("gs://bucket/none.ply")


def test_a_large_object__is_sent_by_chunks_appears_last_and_is_read_by_range(store: Proxy) -> None:
    cloud = random_cloud(120_000, sh_degree=3)
    data = np.random.default_rng(0).bytes((20 << 20) + 12345)
    with replacing_object("gs://bucket/large", overwrite=False) as stream:
        for start in range(0, len(data), 1 << 20):
            stream.write(data[start : start + (1 << 20)])
            assert not exists("gs://bucket/large")
    assert content("gs://bucket/large") == data
    sent = [path for method, path in store.log if "upload_id=" in path and method in ("POST", "PUT")]
    assert len(sent) >= 3

    save(cloud, "gs://bucket/large.ply")
    store.reset()
    info = inspect_file(Path("gs:/bucket/large.ply"))[1]
    assert info.splats == 120_000
    ranges = [each for each in store.ranges if each]
    assert ranges
    read = sum(int(end) - int(start) + 1 for start, end in (each.removeprefix("bytes=").split("-") for each in ranges))
    assert read < int(identity("gs://bucket/large.ply").split()[0])
    assert read <= 2 * _stores.BLOCK_BYTES


def test_an_upload_that_is_cut_off__leaves_the_object_as_it_was(store: Proxy) -> None:
    with replacing_object("gs://bucket/x", overwrite=True) as stream:
        stream.write(b"before")

    def write(size: int) -> None:
        with replacing_object("gs://bucket/x", overwrite=True) as stream:
            for _ in range(size):
                stream.write(bytes(1 << 20))

    for fault in ("cut", "hang"):
        seen: list[str] = []

        def second_chunk(method: str, path: str, _number: int, fault: str = fault, seen: list[str] = seen) -> str | None:
            if "upload_id=" in path and method in ("POST", "PUT"):
                seen.append(path)
                return fault if len(seen) > 1 else None
            return None

        store.reset(second_chunk)
        start = time.monotonic()
        with pytest.raises(WriteError, match=r"gs://bucket/x: cannot write"):
            write(20)
        assert time.monotonic() - start < 20
        store.reset()
        assert content("gs://bucket/x") == b"before"
    write(20)
    assert content("gs://bucket/x") == bytes(20 << 20)


def test_a_store_that_hangs_or_is_busy__changes_no_byte_or_is_an_error(store: Proxy, tmp_path: Path) -> None:
    save(random_cloud(40), tmp_path / "a.ply")
    save(random_cloud(40), "gs://bucket/a.ply")
    convert([tmp_path / "a.ply"], tmp_path / "a.spz")
    store.reset(lambda _method, _path, number: {1: "503", 6: "hang", 11: "stall"}.get(number))
    convert(["gs://bucket/a.ply"], "gs://bucket/a.spz")
    assert store.failed >= 2
    store.reset(lambda _method, path, _number: "hang" if "a.ply" in path else None)
    with pytest.raises(ReadError, match=r"gs://bucket/a\.ply: cannot read .* --store-timeout"):
        load("gs://bucket/a.ply")
    store.reset()
    assert content("gs://bucket/a.spz") == (tmp_path / "a.spz").read_bytes()


def test_a_sequence__has_the_bytes_of_one_on_the_disk(store: Proxy, tmp_path: Path) -> None:
    pattern = make_frames(tmp_path / "frames", 4, 60)
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)
    for path in (tmp_path / "frames").iterdir():
        with replacing_object(f"gs://bucket/frames/{path.name}", overwrite=False) as stream:
            stream.write(path.read_bytes())

    report: Any = convert_sequence(["gs://bucket/frames/*.ply"], "gs://bucket/out.sog4d", InProcess(), validation=None, **SHORT)

    assert report.frames == 4
    assert sha256(content("gs://bucket/out.sog4d")) == expected
    assert [url for url in matching("gs://bucket/**") if "/frames/" not in url] == ["gs://bucket/out.sog4d"]
