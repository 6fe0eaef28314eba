"""Frames on the disk, their bundle as `convert` makes it, and workers that are killed."""

from __future__ import annotations

import hashlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsplat_tools.cluster.engines import Dask, Engine, Processes
from gsplat_tools.convert import convert
from gsplat_tools.formats.saving import save
from tests.formats.test_sog4d_sequences import moving


def make_frames(folder: Path, frames: int, splats: int, *, sh_degree: int = 1) -> str:
    """Write frames, and return the pattern that stands for them."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, cloud in enumerate(moving(splats, frames, sh_degree=sh_degree)):
        save(cloud, folder / f"{index}.ply")
    return str(folder / "*.ply")


def local_bundle(pattern: str, target: Path, **options: Any) -> str:
    """Convert on this machine, and return the SHA-256."""
    convert([pattern], target, validation=None, **options)
    return sha256(target.read_bytes())


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def pids(engine: Engine) -> list[int]:
    """Return the processes of an engine."""
    if isinstance(engine, Processes):
        return list(engine._pool._processes or {})
    assert isinstance(engine, Dask)
    return list(engine.run_everywhere(os.getpid))


@contextmanager
def killing(engine: Engine, when: Callable[[], bool], *, every: bool = False) -> Iterator[list[int]]:
    """Kill one worker, or every one, once `when` holds; yields the list of those killed."""
    killed: list[int] = []
    ended = threading.Event()
    known = pids(engine) if isinstance(engine, Dask) else []

    def watch() -> None:
        while not ended.is_set():
            if when():
                for pid in (known or pids(engine))[: None if every else 1]:
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)
                return
            time.sleep(0.002)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield killed
    finally:
        ended.set()
        thread.join()


def parts_of(target: Path) -> list[Path]:
    """Return the finished segments beside a target."""
    return sorted(target.parent.glob(f".{target.name}.gsplat-parts/*.part"))
