"""Tasks for Dask workers of which the first has no room on its disk."""

import errno
import os
import time
from pathlib import Path

from distributed import get_worker


def keep(index: int) -> tuple[int, int]:
    """Return the square and the worker; the first worker has no room."""
    name = int(get_worker().name)
    if name == 0:
        raise OSError(errno.ENOSPC, "No space left on device")
    return index * index, name


def add(index: int, kept: tuple[int, int]) -> int:
    """Return a sum with what another task kept."""
    return index + kept[0]


def keep_slowly(folder: str, index: int) -> int:
    """Return the square; before that, the first time, say who is at it and take a minute."""
    if int(get_worker().name) == 0:
        raise OSError(errno.ENOSPC, "No space left on device")
    started = Path(folder) / f"{index}.pid"
    if not started.exists():
        started.with_suffix(".tmp").write_text(str(os.getpid()))
        started.with_suffix(".tmp").rename(started)
        time.sleep(60)
    return index * index
