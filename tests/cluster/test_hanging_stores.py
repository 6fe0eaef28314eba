"""Stores that take requests and do not answer: the same bytes, or an error within a bound; nobody sees half an object."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gsplat_tools.cluster.batches import Item, run_batch
from gsplat_tools.cluster.engines import InProcess, Processes
from gsplat_tools.cluster.sequences import convert_sequence
from gsplat_tools.convert import convert
from gsplat_tools.errors import CapabilityError, GsplatError, ReadError, WriteError
from gsplat_tools.formats import _store_requests, load
from gsplat_tools.formats._store_requests import SLOWEST, store_timeout, use_store_timeout
from gsplat_tools.formats._stores import replacing_object
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud
from tests.cluster.sequences import local_bundle, make_frames, sha256
from tests.cluster.stores import BUCKET, Fault, Proxy, s3_server
from tests.cluster.test_sequences import SHORT

fsspec = pytest.importorskip("fsspec")
pytest.importorskip("moto")
pytestmark = pytest.mark.cluster

TIMEOUT, TRIES = 1.0, 3
"""Seconds that an answer may take, and times that it is asked for: a busy machine must not look like a store that hangs."""

SLACK = 10.0
"""Seconds that a busy machine may take on top of a bound; what libraries would wait by themselves is minutes."""


@pytest.fixture(scope="module")
def s3() -> Iterator[Proxy]:
    with s3_server() as proxy, pytest.MonkeyPatch.context() as patch, use_store_timeout(TIMEOUT):
        patch.setattr(_store_requests, "_FIRST_PAUSE", 0.01)
        patch.setattr(_store_requests, "TRIES", TRIES)
        yield proxy


@pytest.fixture
def store(s3: Proxy) -> Iterator[Proxy]:
    """A server that behaves at first, and holds a.ply."""
    s3.reset()
    yield s3
    s3.reset()
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    system.rm(system.find(BUCKET))
    for left in unfinished_uploads():  # those whose start was never answered: nobody knows their names
        system.abort_mpu(BUCKET, left["Key"], left["UploadId"])


@pytest.fixture
def source(store: Proxy, tmp_path: Path) -> Path:
    """The same scene on the disk and in the store."""
    save(random_cloud(40), tmp_path / "a.ply")
    fsspec.filesystem("s3").put(str(tmp_path / "a.ply"), f"{BUCKET}/a.ply")
    store.reset()
    return tmp_path / "a.ply"


@contextmanager
def ending_within(seconds: float) -> Iterator[None]:
    start = time.monotonic()
    yield
    assert time.monotonic() - start < seconds + SLACK


def names() -> list[str]:
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    return sorted(name.removeprefix(f"{BUCKET}/") for name in system.find(BUCKET))


def content(name: str) -> bytes:
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    return bytes(system.cat(f"{BUCKET}/{name}"))


def unfinished_uploads() -> list[Any]:
    found = fsspec.filesystem("s3").call_s3("list_multipart_uploads", Bucket=BUCKET)
    return list(found.get("Uploads", []))


def on(method: str, part: str, fault: str, *, times: int = 1000) -> Fault:
    """Fail the first requests of a method whose path holds a part."""
    left = [times]

    def failing(asked: str, path: str, _number: int) -> str | None:
        if asked != method or part not in path or not left[0]:
            return None
        left[0] -= 1
        return fault

    return failing


READERS: dict[str, Callable[[Path], Any]] = {
    "load": lambda _: load("s3://bucket/a.ply"),
    "inspect": lambda _: inspect_file(Path("s3:/bucket/a.ply")),
    "convert": lambda folder: convert(["s3://bucket/a.ply"], folder / "a.spz"),
}


@pytest.mark.parametrize("fault", ["deaf", "hang", "stall", "drip"])
def test_a_source_that_never_comes__is_an_error_within_the_bound(
    store: Proxy, source: Path, tmp_path: Path, fault: str
) -> None:
    size = source.stat().st_size
    for name, read in READERS.items() if fault == "hang" else [("load", READERS["load"])]:
        store.reset(on("GET", "a.ply", fault))
        with (
            ending_within(TRIES * (TIMEOUT + size / SLOWEST)),
            pytest.raises(ReadError, match=r"s3://bucket/a\.ply: cannot read .* --store-timeout"),
        ):
            read(tmp_path)
        assert store.failed == TRIES, name
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.parametrize("fault", ["deaf", "hang", "stall", "drip", "late"])
def test_one_answer_that_does_not_come__changes_no_byte(store: Proxy, source: Path, tmp_path: Path, fault: str) -> None:
    convert([source], tmp_path / "expected.spz")
    store.reset(on("GET", "a.ply", fault, times=1))
    convert(["s3://bucket/a.ply"], tmp_path / "read.spz")
    assert store.failed == 1
    for request in (("PUT", "partNumber=1"), ("POST", "uploads"), ("POST", "uploadId"), ("HEAD", "out.spz")):
        if request[0] in {"stall": ("PUT", "HEAD"), "drip": ("PUT", "HEAD"), "deaf": ("POST", "HEAD")}.get(fault, ()):
            continue  # no body to answer with, or to take
        if (fault, request[1]) == ("drip", "uploadId"):
            continue  # stores do so while they join parts, and get ten times the time
        store.reset(on(*request, fault, times=1))
        convert([source], "s3://bucket/out.spz", overwrite=True, validation=None)
        assert store.failed == 1, request
        store.reset()
        assert content("out.spz") == (tmp_path / "read.spz").read_bytes() == (tmp_path / "expected.spz").read_bytes()
        fsspec.filesystem("s3").rm(f"{BUCKET}/out.spz")


@pytest.mark.parametrize(
    "request_",
    [("POST", "uploads", "hang"), ("PUT", "partNumber", "hang"), ("PUT", "partNumber", "deaf"), ("POST", "uploadId", "hang")],
    ids=" ".join,
)
def test_an_upload_that_hangs__shows_nothing_and_leaves_no_parts(
    store: Proxy, source: Path, request_: tuple[str, str, str]
) -> None:
    size = 1 << 16
    store.reset(on(*request_))
    with (
        ending_within(TRIES * (TIMEOUT + size / SLOWEST) + 2 * TIMEOUT),
        pytest.raises(WriteError, match=r"s3://bucket/out\.spz: cannot write .* --store-timeout"),
    ):
        convert([source], "s3://bucket/out.spz", validation=None)
    assert store.failed == TRIES
    store.reset()
    assert names() == ["a.ply"]
    assert unfinished_uploads() == []
    convert([source], "s3://bucket/out.spz")
    assert names() == ["a.ply", "out.spz"]


def test_a_later_part_that_hangs__leaves_the_object_as_it_was(store: Proxy) -> None:
    with replacing_object("s3://bucket/x", overwrite=True) as stream:
        stream.write(b"before")
    store.reset(on("PUT", "partNumber=2", "hang"))

    def write() -> None:
        with replacing_object("s3://bucket/x", overwrite=True, block_bytes=5 << 20) as stream:
            for _ in range(12):
                stream.write(bytes(1 << 20))

    with pytest.raises(WriteError, match=r"s3://bucket/x: cannot write"):
        write()
    store.reset()
    assert content("x") == b"before"
    assert unfinished_uploads() == []


def test_an_upload_whose_last_answers_are_lost__is_found_to_be_there(store: Proxy, source: Path, tmp_path: Path) -> None:
    convert([source], tmp_path / "a.spz")
    store.reset(on("POST", "uploadId", "late"))
    convert([source], "s3://bucket/out.spz")
    assert store.failed >= 1
    store.reset()
    assert content("out.spz") == (tmp_path / "a.spz").read_bytes()


def test_a_store_that_does_not_say_what_is_there__is_not_overwritten(store: Proxy, source: Path) -> None:
    convert([source], "s3://bucket/out.spz", sh_degree=0)
    before = content("out.spz")
    store.reset(on("HEAD", "out.spz", "hang"))
    with pytest.raises(GsplatError, match=r"s3://bucket/out\.spz"):
        convert([source], "s3://bucket/out.spz")
    store.reset()
    assert content("out.spz") == before


@pytest.mark.parametrize("scheduler", ["local", "local:2"])
def test_a_sequence_meets_a_store_that_hangs__and_continues(
    store: Proxy, tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSPLAT_STORE_TIMEOUT", "600")  # of workers that are not told the time of this run
    pattern = make_frames(tmp_path / "frames", 4, 40)
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)
    target = "s3://bucket/out.sog4d"

    def run() -> Any:
        engine = InProcess(1, 0) if scheduler == "local" else Processes(2, 1, 0)
        try:
            return convert_sequence([pattern], target, engine, validation=None, **SHORT).cluster
        finally:
            engine.close()

    kept = 0
    if scheduler == "local":
        store.reset(on("POST", "out.sog4d?", "hang"))  # parts are taken, the bundle is not
        with pytest.raises(WriteError, match=r"s3://bucket/out\.sog4d: cannot write"):
            run()
        store.reset()
        kept = len(names())
        assert kept > 0
        assert "out.sog4d" not in names()
    numbers = iter(range(10_000))
    store.reset(lambda _method, _path, _number: {0: "hang", 10: "stall"}.get(next(numbers) % 20))
    with ending_within(100.0):
        cluster = run()
    assert store.failed > 0
    assert cluster["kept_segments"] == kept
    store.reset()
    assert sha256(content("out.sog4d")) == expected
    assert names() == ["out.sog4d"]


def test_a_batch__tries_again_what_hung(store: Proxy, source: Path, tmp_path: Path) -> None:
    quick = {"validation": None}
    items = [Item(line=i, sources=("s3://bucket/a.ply",), target=f"s3://bucket/{i}.spz", arguments=quick) for i in range(2)]
    store.reset(on("PUT", "1.spz", "hang"))
    report = run_batch(items, InProcess(1, 1))
    assert [each["status"] for each in report["items"]] == ["done", "failed"]
    assert "s3://bucket/1.spz" in report["items"][1]["error"]["message"]
    assert report["cluster"]["retried"] == 1
    store.reset(on("PUT", "1.spz", "hang", times=TRIES))
    report = run_batch(items[1:], InProcess(1, 1))
    assert [each["status"] for each in report["items"]] == ["done"]
    assert report["cluster"]["retried"] == 1
    store.reset()
    assert content("0.spz") == content("1.spz")


@pytest.mark.parametrize(("scheduler", "number"), [("local", signal.SIGINT), ("local:2", signal.SIGTERM)])
def test_a_signal_while_a_store_hangs__ends_the_command_and_its_uploads(
    store: Proxy, source: Path, scheduler: str, number: int
) -> None:
    # A shell that runs the tests in the background has SIGINT ignored, which children inherit.
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program += "; from gsplat_tools.cli.convert import main; main()"
    command = [sys.executable, "-c", program, str(source), "s3://bucket/out.spz"]
    command += ["--no-validate", "--scheduler", scheduler, "--store-timeout", "100"]
    store.reset(on("PUT", "out.spz", "hang"))
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 240  # kernels may have to be compiled first, and what compiles does not hear signals
        while not store.failed and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        assert store.failed, "the upload has not begun"
        with ending_within(3.0):
            process.send_signal(number)
            _, said = process.communicate(timeout=20)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143}[number]  # type: ignore[index]
    assert "the target is as it was" in said
    assert store.failed == 1
    store.reset()
    assert names() == ["a.ply"]
    assert unfinished_uploads() == []


def test_the_time__is_an_option_a_variable_or_a_default(monkeypatch: pytest.MonkeyPatch) -> None:
    with use_store_timeout(None):
        assert store_timeout() == _store_requests.DEFAULT_STORE_TIMEOUT
        monkeypatch.setenv("GSPLAT_STORE_TIMEOUT", "90")
        assert store_timeout() == 90
        with use_store_timeout(2):
            assert store_timeout() == 2
        for wrong in ("soon", "0", "-1", "inf", "nan"):
            monkeypatch.setenv("GSPLAT_STORE_TIMEOUT", wrong)
            with pytest.raises(CapabilityError, match="GSPLAT_STORE_TIMEOUT"):
                store_timeout()
