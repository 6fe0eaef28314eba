"""Commands whose store takes requests and does not answer; run as `scripts/reliability cluster --only hanging`.

Every case is a process. It ends within the time that is promised, with the bytes of one machine or with status 1 and the
name of the object; before the target is whole nothing stands there, and the same command then continues.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_tools.convert import convert
from gsplat_tools.formats._store_requests import TRIES
from tests.cluster.sequences import sha256
from tests.cluster.stores import BUCKET, Fault, Proxy, s3_server

TIMEOUT = 2.0
PAUSES = 4.0
"""Seconds between the tries of one request, together."""

WORK = 20.0, 60.0
"""Seconds for a command to start and to convert a scene, and for workers and a sequence, on a busy machine."""

COMMAND = [sys.executable, "-c", "from gsplat_tools.cli.convert import main; main()"]


class Broken(AssertionError):
    """A promise was not kept."""


def on(method: str, part: str, fault: str, *, times: int = 1000, every: int = 1) -> Fault:
    """Fail requests of a method whose path holds a part: the first, or every so many of them."""
    seen = 0

    def failing(asked: str, path: str, _number: int) -> str | None:
        nonlocal seen
        if part not in path or (method and asked != method):
            return None
        seen += 1
        return fault if seen <= times * every and seen % every == 0 else None

    return failing


@dataclass(frozen=True)
class Case:
    """A command, what its store does, and how it must end: 0, or 1 and then 0 once the store behaves."""

    name: str
    words: list[str]
    target: str
    expected: str
    fault: Fault
    status: int
    operations: int = 1
    """Operations that hang until they are given up, one after another."""


class Store:
    """What is in the store behind the proxy, seen from the side."""

    def __init__(self, proxy: Proxy) -> None:
        import boto3

        self.proxy = proxy
        self._client: Any = boto3.client("s3", endpoint_url=proxy.direct)

    def put(self, key: str, data: bytes) -> None:
        self._client.put_object(Bucket=BUCKET, Key=key, Body=data)

    def names(self) -> list[str]:
        return [each["Key"] for each in self._client.list_objects_v2(Bucket=BUCKET).get("Contents", [])]

    def read(self, target: str) -> bytes | None:
        if not target.startswith("s3://"):
            return Path(target).read_bytes() if Path(target).exists() else None
        key = target.removeprefix(f"s3://{BUCKET}/")
        return self._client.get_object(Bucket=BUCKET, Key=key)["Body"].read() if key in self.names() else None

    def uploads(self) -> int:
        """Return how many uploads hold parts that nobody sees, and end them."""
        found = self._client.list_multipart_uploads(Bucket=BUCKET).get("Uploads", [])
        for each in found:
            self._client.abort_multipart_upload(Bucket=BUCKET, Key=each["Key"], UploadId=each["UploadId"])
        return len(found)


def run(words: Sequence[str], limit: float) -> tuple[int, str, float]:
    """Run a command; return its status, what it said, and its seconds."""
    start = time.monotonic()
    process = subprocess.Popen([*COMMAND, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        _, said = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        process.kill()
        raise Broken(f"it did not end within {limit:.0f} s: {' '.join(words)}") from None
    return process.returncode, " ".join(said.split()), time.monotonic() - start


def check(store: Store, case: Case) -> None:
    """Run a case, and print a line."""
    words = [*case.words, "--store-timeout", f"{TIMEOUT:g}"]
    work = WORK["--scheduler" in words]
    limit = work + case.operations * (TRIES * (TIMEOUT + 1) + PAUSES)
    store.proxy.reset(case.fault)
    status, said, seconds = run(words, limit)
    failed = store.proxy.failed
    store.proxy.reset()
    if failed == 0:
        raise Broken(f"{case.name}: the store did not hang")
    if status != case.status:
        raise Broken(f"{case.name}: status {status}: {said}")
    left = f", {uploads} uploads left" if (uploads := store.uploads()) else ""
    ended = f"{failed} requests hung{left}; same bytes"
    if case.status:
        if store.read(case.target) is not None:
            raise Broken(f"{case.name}: it failed, and something stands at the target")
        if "--store-timeout" not in said or not re.search(r"s3://bucket/\S+: cannot (read from|write to) the store", said):
            raise Broken(f"{case.name}: an error without object and remedy: {said}")
        status, said, _ = run(words, work)
        if status:
            raise Broken(f"{case.name}, again: status {status}: {said}")
        ended = f"{failed} requests hung, status 1{left}; again: same bytes"
    found = store.read(case.target)
    if found is None or sha256(found) != case.expected:
        raise Broken(f"{case.name}: other bytes at the target")
    print(f"hanging store, {case.name:<58} {seconds:5.1f} s (of waiting at most {limit - work:3.0f} s)  {ended}", flush=True)


def check_signal(store: Store, scheduler: str, number: signal.Signals, words: Sequence[str], target: str, fault: Fault) -> None:
    """Interrupt a command whose store hangs."""
    store.proxy.reset(fault)
    given = [*COMMAND, *words, "--store-timeout", "600", "--scheduler", scheduler]
    process = subprocess.Popen(given, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not store.proxy.failed and process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    start = time.monotonic()
    process.send_signal(number)
    try:
        status = process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        raise Broken(f"{scheduler}: {number.name} did not end it within 20 s") from None
    seconds = time.monotonic() - start
    store.proxy.reset()
    if status not in (130, 143) or store.read(target) is not None:
        raise Broken(f"{scheduler}: {number.name} ended it with status {status}, target {store.read(target) is not None}")
    uploads = store.uploads()
    name = f"{scheduler}, {number.name}"
    print(
        f"hanging store, {name:<58} {seconds:5.1f} s  status {status}, nothing at the target, {uploads} uploads left",
        flush=True,
    )


def try_everything(pattern: str, expected: str, folder: Path, segment: int) -> None:
    """Run all cases: a scene, a sequence as tasks, a batch, signals."""
    with s3_server() as proxy:
        store = Store(proxy)
        frames = sorted(Path(pattern).parent.iterdir(), key=lambda path: int(path.stem))
        for path in frames:
            store.put(f"frames/{path.name}", path.read_bytes())
        convert([frames[0]], folder / "hanging.spz", validation=None)
        scene = sha256((folder / "hanging.spz").read_bytes())
        _scenes(store, folder, str(frames[0]), scene)
        _sequences(store, folder, expected, segment)
        _batch(store, folder, scene)
        for scheduler in ("local", "local:2", "local-cluster:2"):
            target = f"s3://{BUCKET}/signal.spz"
            for number in (signal.SIGINT, signal.SIGTERM):
                check_signal(store, scheduler, number, [str(frames[0]), target], target, on("PUT", "signal.spz", "hang"))


def _scenes(store: Store, folder: Path, path: str, scene: str) -> None:
    source, target = f"s3://{BUCKET}/frames/0.ply", f"s3://{BUCKET}/out.spz"
    for fault, said in (("hang", "is never answered"), ("stall", "stops in the middle"), ("drip", "comes a byte at a time")):
        here = str(folder / f"{fault}.spz")
        check(store, Case(f"a source {said}", [source, here], here, scene, on("GET", "0.ply", fault), 1))
    for index, (method, part, fault, said, status) in enumerate((
        ("GET", "0.ply", "stall", "the first answer stops in the middle", 0),
        ("PUT", "partNumber", "deaf", "the first part is not taken", 0),
        ("PUT", "partNumber", "deaf", "no part is taken", 1),
        ("POST", "uploads", "hang", "no upload begins", 1),
        ("POST", "uploadId", "hang", "no upload is completed", 1),
        ("POST", "uploadId", "late", "uploads are completed, and the answer is lost", 0),
    )):  # fmt: skip
        own = target.replace("out", f"out{index}")
        times = 1 if "first" in said else 1000
        # Completing is followed by a look and by dropping the parts.
        case = Case(said, [source, own], own, scene, on(method, part, fault, times=times), status, operations=2)
        check(store, case)


def _sequences(store: Store, folder: Path, expected: str, segment: int) -> None:
    pattern = f"s3://{BUCKET}/frames/*.ply"
    words = ["--no-validate", "--delta-segment-length", str(segment), "--jobs", "1"]
    for index, (scheduler, method, part, fault, every, said) in enumerate((
        ("local:2", "", "frames/", "hang", 60, "every 60th request for a frame is not answered"),
        ("local:2", "PUT", ".part", "deaf", 4, "every 4th part is not taken"),
        ("local-cluster:2", "", "frames/", "stall", 60, "every 60th frame stops in the middle"),
        ("local-cluster:2", "PUT", ".part", "hang", 4, "every 4th part is not acknowledged"),
    )):  # fmt: skip
        target = f"s3://{BUCKET}/{index}/out.sog4d"
        own = [pattern, target, "--scheduler", scheduler, *words]
        # All that hang at most one after another.
        check(
            store, Case(f"{scheduler}, {said}", own, target, expected, on(method, part, fault, every=every), 0, operations=10)
        )
    for index, scheduler in enumerate(("local:2", "local-cluster:2")):
        target = f"s3://{BUCKET}/never{index}/out.sog4d"
        own = [pattern, target, "--scheduler", scheduler, "--retries", "1", *words]
        fault = on("POST", "out.sog4d?", "hang")
        check(store, Case(f"{scheduler}, the bundle is not taken", own, target, expected, fault, 1, operations=2))


def _batch(store: Store, folder: Path, scene: str) -> None:
    """Of three scenes one hangs: the others are done, and --resume does what is left."""
    targets = [f"s3://{BUCKET}/batch/{index}.spz" for index in range(3)]
    manifest = folder / "batch.csv"
    manifest.write_text("source,target\n" + "".join(f"s3://{BUCKET}/frames/0.ply,{target}\n" for target in targets))
    words = [
        "--batch",
        str(manifest),
        "--no-validate",
        "--scheduler",
        "local:2",
        "--retries",
        "1",
        "--store-timeout",
        f"{TIMEOUT:g}",
    ]
    limit = WORK[1] + 2 * (TRIES * (TIMEOUT + 1) + PAUSES)
    store.proxy.reset(on("PUT", "batch/1.spz", "hang"))
    status, said, seconds = run(words, limit)
    failed = store.proxy.failed
    store.proxy.reset()
    there = [store.read(target) is not None for target in targets]
    if status != 1 or there != [True, False, True] or "2 done, 0 kept, 1 failed" not in said:
        raise Broken(f"batch: status {status}, {there}: {said}")
    status, said, _ = run([*words, "--resume"], limit)
    if status or "1 done, 2 kept, 0 failed" not in said or any(sha256(store.read(each) or b"") != scene for each in targets):
        raise Broken(f"batch, resumed: status {status}: {said}")
    name = "--batch --retries 1, one scene of three hangs"
    print(f"hanging store, {name:<58} {seconds:5.1f} s  {failed} requests hung, 2 done, 1 failed; --resume: 1 done, 2 kept")
