"""A sequence on workers that die, with schedulers, stores and disks that fail: the same bytes, or an error and a next run.

Run as `scripts/reliability cluster`, or `python -m tests.reliability.cluster --help`. Every case ends with the SHA-256 of
what stands at the target, which must be that of one machine; before that the target must not be there.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsplat_tools.cluster.engines import open_engine
from gsplat_tools.cluster.sequences import convert_sequence
from gsplat_tools.errors import GsplatError
from gsplat_tools.formats._stores import exists, is_url
from tests.cluster.sequences import killing, local_bundle, make_frames, parts_of, sha256
from tests.cluster.stores import BUCKET, forget, s3_server

OPTIONS: dict[str, Any] = {"delta_segment_length": 8}


class Broken(AssertionError):
    """A promise was not kept."""


def read(target: str) -> bytes:
    """Return what stands at a target."""
    if not is_url(target):
        return Path(target).read_bytes()
    import fsspec

    fsspec.filesystem("s3").invalidate_cache()
    return bytes(fsspec.filesystem("s3").cat(target))


def run(scheduler: str, pattern: str, target: str, around: Callable[[Any], Any] | None = None) -> tuple[Any, str]:
    """Convert; return the report or the error, and what happened around."""
    engine = open_engine(scheduler, 1)
    happened: Any = None
    try:
        with around(engine) if around else contextlib.nullcontext() as happened:
            return convert_sequence([pattern], target, engine, overwrite=False, validation=None, **OPTIONS), happened
    except GsplatError as error:
        return error, happened
    finally:
        engine.close()


def parts_in(target: str) -> int:
    """Return how many segments are finished."""
    if not is_url(target):
        return len(parts_of(Path(target)))
    import boto3

    prefix = target.removeprefix(f"s3://{BUCKET}/").rpartition("/")[0]
    client = boto3.client("s3")
    return len(client.list_objects_v2(Bucket=BUCKET, Prefix=f"{prefix}/.").get("Contents", []))


@contextmanager
def dask(count: int, environment: dict[int, dict[str, str]] | None = None) -> Iterator[tuple[str, list[Any]]]:
    """A scheduler and workers as processes of their own; yields its address and [scheduler, *workers]."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    base = [sys.executable, "-m", "distributed.cli"]
    processes = []

    def start(arguments: list[str], own: dict[str, str]) -> None:
        processes.append(subprocess.Popen([*base, *arguments], env={**os.environ, **own}, **quiet))  # type: ignore[call-overload]

    base = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    start(["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"], {})
    base = [sys.executable, "-m", "distributed.cli.dask_worker"]
    for index in range(count):
        own = (environment or {}).get(index, {})
        start([address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "60"], own)
    try:
        yield address, processes
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(15)
            process.kill()


@contextmanager
def once(when: Callable[[], bool], act: Callable[[], None]) -> Iterator[None]:
    """Act once, as soon as `when` holds."""
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(0.005):
            if when():
                act()
                return

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Cases:
    """Runs cases one after another and prints a line each."""

    def __init__(self, pattern: str, expected: str, frames: int) -> None:
        self.pattern, self.expected, self.frames = pattern, expected, frames

    def case(self, name: str, scheduler: str, pattern: str, target: str, around: Any = None, *, may_fail: bool = False) -> None:
        """Run a case; where it may fail, run it once more and look whether it continues."""
        start = time.perf_counter()
        report, happened = run(scheduler, pattern, target, around)
        words = ""
        if isinstance(report, GsplatError):
            if not may_fail:
                raise Broken(f"{name}: {report}") from report
            if exists(target):
                raise Broken(f"{name}: failed, and something stands at the target")
            left = parts_in(target)
            words = f"ended with {type(report).__name__} ({report.message[:60]}...), {left} segments kept; again: "
            report, _ = run("local:1", pattern, target)
            if isinstance(report, GsplatError):
                raise Broken(f"{name}: {report}") from report
            if report.cluster["kept_segments"] < left:
                raise Broken(f"{name}: kept {left} segments, used {report.cluster['kept_segments']}")
        self.tell(name, target, f"{words}{self._counted(report, happened)}", start)

    def tell(self, name: str, target: str, words: str, start: float) -> None:
        """Print a line, after a look at the bytes."""
        found = sha256(read(target))
        if found != self.expected:
            raise Broken(f"{name}: SHA-256 {found} instead of {self.expected}")
        print(f"{name:<58} same bytes  {time.perf_counter() - start:6.1f} s  {words}", flush=True)

    @staticmethod
    def _counted(report: Any, happened: Any) -> str:
        killed = f"{len(happened)} killed, " if isinstance(happened, list) else ""
        cluster = report.cluster
        return f"{killed}{cluster['kept_segments']} of {cluster['segments']} segments from before"


def kill(scheduler_target: str) -> Callable[[Any], Any]:
    """Kill a worker when the first segments are there."""
    return lambda engine: killing(engine, lambda: parts_in(scheduler_target) >= 3)


def on_files(cases: Cases, folder: Path) -> None:
    """Workers, kills, and a command that is killed itself; frames on the disk."""
    on_commands(cases, folder)
    for scheduler in ("local", "local:2", "local-cluster:1", "local-cluster:2"):
        cases.case(f"files, {scheduler}", scheduler, cases.pattern, str(folder / f"{scheduler.replace(':', '')}.sog4d"))
    for scheduler in ("local:2", "local-cluster:1", "local-cluster:2"):
        target = str(folder / f"k{scheduler.replace(':', '')}.sog4d")
        cases.case(f"files, {scheduler}, a worker killed", scheduler, cases.pattern, target, kill(target))


def on_commands(cases: Cases, folder: Path) -> None:
    """The command is killed with its workers, again and again."""
    target = str(folder / "client.sog4d")
    command = [sys.executable, "-c", "from gsplat_tools.cli.convert import main; main()", cases.pattern, target]
    command += ["--scheduler", "local:2", "--no-validate", "--delta-segment-length", "8", "--jobs", "1"]
    start, kills = time.perf_counter(), 0
    for wanted in (1, 6, 12, 18):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
        while parts_in(target) < wanted and process.poll() is None:
            time.sleep(0.01)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        if process.wait() != -signal.SIGKILL:
            raise Broken(f"the command ended by itself with status {process.returncode}")
        kills += 1
        if Path(target).exists():
            raise Broken("the command was killed, and something stands at the target")
    report, _ = run("local:2", cases.pattern, target)
    if isinstance(report, GsplatError):
        raise Broken(str(report))
    cases.tell(
        "files, local:2, the command killed with its workers", target, f"{kills} kills, {cases._counted(report, 0)}", start
    )


def on_schedulers(cases: Cases, folder: Path) -> None:
    """The scheduler is killed, or one worker's disk is full."""
    target = str(folder / "scheduler.sog4d")
    with dask(2) as (address, processes):
        around = lambda _engine: once(lambda: parts_in(target) >= 5, processes[0].kill)  # noqa: E731
        cases.case("files, tcp://, the scheduler killed", address, cases.pattern, target, around, may_fail=True)
    small = folder / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=24k", "tmpfs", str(small)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        print("files, tcp://, the disk of one worker full: left out, no small disk can be mounted here")
        return
    try:
        for count in (2, 1):
            target = str(folder / f"disk{count}.sog4d")
            with dask(count, {0: {"TMPDIR": str(small)}}) as (address, _):
                cases.case(
                    f"files, tcp://, the disk of one of {count} workers full", address, cases.pattern, target, may_fail=True
                )
    finally:
        subprocess.run(["umount", "-l", str(small)], check=False)


def on_s3(cases: Cases, folder: Path) -> None:
    """The same from and to a store."""
    import fsspec

    with s3_server() as proxy:
        os.environ["AWS_ENDPOINT_URL"] = proxy.direct
        system = fsspec.filesystem("s3", skip_instance_cache=True)
        for path in Path(cases.pattern).parent.iterdir():
            system.put(str(path), f"{BUCKET}/frames/{path.name}")
        pattern = f"s3://{BUCKET}/frames/*.ply"
        for scheduler in ("local-cluster:1", "local-cluster:2"):
            cases.case(f"S3, {scheduler}", scheduler, pattern, f"s3://{BUCKET}/{scheduler.replace(':', '')}/out.sog4d")
        target = f"s3://{BUCKET}/killed/out.sog4d"
        cases.case("S3, local-cluster:2, a worker killed", "local-cluster:2", pattern, target, kill(target))
        os.environ["AWS_ENDPOINT_URL"] = proxy.url
        forget()
        faults = {
            "every 20th request 503, every 33rd cut": lambda _m, _p, n: (
                "503" if n % 20 == 9 else "cut" if n % 33 == 9 else None
            ),
            "two requests without an answer": lambda _m, _p, n: "hang" if n in (400, 900) else None,
        }
        for name, fault in faults.items():
            proxy.fault, proxy.failed, proxy.count = fault, 0, 0
            target = f"s3://{BUCKET}/{len(name)}/out.sog4d"
            cases.case(f"S3, local-cluster:2, {name}", "local-cluster:2", pattern, target)
            print(f"{'':<58} {proxy.failed} of {proxy.count} requests failed")
        proxy.fault = lambda method, path, _n: "503" if method in ("PUT", "POST") and "out.sog4d?" in path else None
        target = f"s3://{BUCKET}/never/out.sog4d"
        report, _ = run("local:1", pattern, target)
        proxy.fault = None
        if not isinstance(report, GsplatError) or exists(target):
            raise Broken(f"a store that refuses the target: {report}")
        start = time.perf_counter()
        again, _ = run("local:1", pattern, target)
        words = f"ended with {type(report).__name__}; again: {cases._counted(again, None)}"
        cases.tell("S3, local:1, the store refuses the target with 503", target, words, start)


def on_hanging(cases: Cases, folder: Path) -> None:
    """Stores that do not answer, as commands see them."""
    from tests.reliability.hanging_stores import try_everything

    try_everything(cases.pattern, cases.expected, folder, OPTIONS["delta_segment_length"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--splats", type=int, default=300)
    parser.add_argument("--only", choices=["files", "schedulers", "s3", "hanging"])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pattern = make_frames(folder / "frames", arguments.frames, arguments.splats)
        start = time.perf_counter()
        expected = local_bundle(pattern, folder / "expected.sog4d", **OPTIONS)
        print(f"{arguments.frames} frames of {arguments.splats} splats; one machine: {expected}")
        print(f"{'one machine, files':<58} {'':<10}  {time.perf_counter() - start:6.1f} s", flush=True)
        cases = Cases(pattern, expected, arguments.frames)
        for part, test in (("files", on_files), ("schedulers", on_schedulers), ("s3", on_s3), ("hanging", on_hanging)):
            if arguments.only in (None, part):
                test(cases, folder)


if __name__ == "__main__":
    main()
