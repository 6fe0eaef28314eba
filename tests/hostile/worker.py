"""Judges a range of cases in a child process that may hang, crash or run out of memory without taking the run along."""

from __future__ import annotations

import faulthandler
import json
import mmap
import os
import resource
import signal
import struct
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.parallel import use_jobs
from tests.hostile.cases import Case, cases
from tests.hostile.corpus import seeds_of
from tests.hostile.judge import judge
from tests.hostile.workplace import Workplace

ADDRESS_SPACE = 768 << 20
"""Bytes that a child may map beyond what it starts with: what is allocated and never touched shows here alone."""

THOROUGH_EVERY = 16
_BATCH = 5000
_PATIENCE = 60.0
"""Seconds without progress after which a child is killed."""


@dataclass
class Result:
    """What a run found: how often each outcome occurred, and flaws by kind with the first case of each."""

    outcomes: Counter[str] = field(default_factory=Counter)
    flaws: dict[str, dict[str, Any]] = field(default_factory=dict)
    cases: int = 0
    seconds: float = 0.0

    def add_flaw(self, step: str, kind: str, detail: str, index: int) -> None:
        key = f"{step}: {kind}" + (f" {detail.rsplit('(', 1)[-1].rstrip(')')}" if kind == "exception" else "")
        entry = self.flaws.setdefault(key, {"case": index, "detail": detail, "count": 0})
        entry["count"] += 1


def judge_case(format_id: str, case: Case, place: Workplace, seconds: float | None = None) -> tuple[str, list[Any]]:
    """Judge a case as the runs do: some in several threads, some in all the ways that a user has."""
    is_thorough = case.index % THOROUGH_EVERY == 0
    with use_jobs(2 if case.index % THOROUGH_EVERY == 1 else 1):
        return judge(FORMATS[format_id], place.put(case), thorough=is_thorough, seconds=seconds)


def warm_up(format_id: str, place: Workplace) -> list[str]:
    """Read every seed, so that compilation is over; returns seeds that are not read, which would test nothing."""
    broken = []
    for _ in range(2):
        broken = []
        for index, seed in enumerate(seeds_of(format_id)):
            case = Case(-THOROUGH_EVERY * (index + 1), seed, "as it is", seed.seal(seed.data))
            outcome, flaws = judge_case(format_id, case, place, seconds=600.0)
            flaws = [flaw for flaw in flaws if flaw.kind != "memory"]  # of the compiler
            if outcome != "read" or flaws:
                broken.append(f"{seed.name}: {outcome} {flaws}")
    return broken


def run(format_id: str, ranges: Iterable[tuple[int, int]], result: Result) -> None:
    """Judge ranges of cases of a format, each in a child process of its own, and add to the result."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as folder:
        root = Path(folder)
        for message in warm_up(format_id, Workplace(root / "warm-up")):
            result.add_flaw("seed", "not read", message, -1)
        for start, stop in ranges:
            position = start
            while position < stop:
                position = _run_child(format_id, position, stop, root, result)
    result.seconds += time.monotonic() - began


def batches(start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Yield start..stop in ranges that one child judges."""
    for first in range(start, stop, _BATCH):
        yield first, min(first + _BATCH, stop)


def _memory_folder() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _run_child(format_id: str, start: int, stop: int, root: Path, result: Result) -> int:
    """Judge a batch in a child; returns the first case that is left to do."""
    progress = mmap.mmap(-1, 8)
    progress[:] = struct.pack("<q", start)
    log = root / "log"
    log.write_bytes(b"")
    child = os.fork()
    if child == 0:
        status = 1
        try:
            _limit_memory()
            _judge_range(format_id, start, stop, root / "work", log, progress)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    status = _watch(child, progress)
    (position,) = struct.unpack("<q", progress[:])
    for line in log.read_text().splitlines():
        entry = json.loads(line)
        if "outcome" in entry:
            result.outcomes[entry["outcome"]] += entry["count"]
        else:
            result.add_flaw(**entry)
    if status == 0:
        result.cases += stop - start
        return stop
    result.cases += position + 1 - start
    kind = "hang" if status is None else "crash"
    result.add_flaw("process", kind, f"{kind} of the process, status {status}", position)
    return position + 1


def _watch(child: int, progress: mmap.mmap) -> int | None:
    """Wait for a child; None if it was killed because it made no progress."""
    last, since = progress[:], time.monotonic()
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if progress[:] != last:
            last, since = progress[:], time.monotonic()
        elif time.monotonic() - since > _PATIENCE:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.02)


def _limit_memory() -> None:
    """Let allocations fail that go far beyond what any case may use."""
    faulthandler.enable()
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        limit = pages * resource.getpagesize() + ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _judge_range(format_id: str, start: int, stop: int, work: Path, log: Path, progress: mmap.mmap) -> None:
    place = Workplace(work)
    outcomes: Counter[str] = Counter()
    with log.open("a") as stream:
        for case in cases(format_id, start, stop):
            progress[:] = struct.pack("<q", case.index)
            outcome, flaws = judge_case(format_id, case, place)
            outcomes[outcome] += 1
            for flaw in flaws:
                entry = {"step": flaw.step, "kind": flaw.kind, "detail": flaw.detail, "index": case.index}
                stream.write(json.dumps(entry) + "\n")
                stream.flush()
        for outcome, count in outcomes.items():
            stream.write(json.dumps({"outcome": outcome, "count": count}) + "\n")
