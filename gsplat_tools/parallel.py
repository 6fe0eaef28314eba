"""Threads over fixed blocks: the same blocks, hence the same bits, for any number of threads.

Kernels release the interpreter lock, so threads run them side by side; nothing here depends on numba.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

BLOCK_SIZE = 1 << 14
"""Splats a block: 14 kB to 4 MB of attributes, small enough to stay in the second-level cache."""

_jobs: ContextVar[int | None] = ContextVar("gsplat_tools_jobs", default=None)


def num_jobs() -> int:
    """Return how many threads to use: what `use_jobs` set, else the processors that this process may run on."""
    jobs = _jobs.get()
    if jobs is not None:
        return jobs
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


@contextmanager
def use_jobs(jobs: int | None) -> Iterator[None]:
    """Use `jobs` threads inside the block; None leaves the choice to the machine."""
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs}")
    token = _jobs.set(jobs)
    try:
        yield
    finally:
        _jobs.reset(token)


def blocks(count: int, size: int = BLOCK_SIZE) -> list[tuple[int, int]]:
    """Return (start, stop) of blocks of `size` that cover `count`; the partition ignores the number of threads."""
    return [(start, min(start + size, count)) for start in range(0, count, size)]


def run_blocks(function: Callable[[int, int], object], count: int, size: int = BLOCK_SIZE) -> None:
    """Call `function(start, stop)` for every block of `count` items; each call owns its part of the output."""
    parts = blocks(count, size)
    if len(parts) == 1:
        function(*parts[0])
    else:
        for_each(lambda block: function(*block), parts)


def for_each(function: Callable[[Item], object], items: Iterable[Item]) -> None:
    """Call `function` for every item, in threads; the first exception, in item order, is raised."""
    for _ in map_ordered(function, items):
        pass


def map_ordered(function: Callable[[Item], Result], items: Iterable[Item], *, ahead: int | None = None) -> Iterator[Result]:
    """Yield `function(item)` in the order of the items, computed in threads.

    Parameters
    ----------
    function
        Called from worker threads; it must not depend on the order of calls.
    items
        Consumed lazily, at most `ahead` items before the result that is yielded next.
    ahead
        Bound on items in flight, which bounds memory; twice the number of threads by default.
    """
    jobs = num_jobs()
    if jobs == 1:
        yield from map(function, items)
        return
    limit = ahead if ahead is not None else 2 * jobs
    pending: deque[Future[Result]] = deque()
    pool = _pool(jobs, os.getpid())
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) >= limit:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        for future in pending:
            future.cancel()
        wait(pending)


@lru_cache(maxsize=4)
def _pool(jobs: int, _process: int) -> ThreadPoolExecutor:
    """Return the pool of `jobs` threads of this process; a forked child gets its own."""
    # Work that a worker starts runs inside that worker: nested pools would deadlock or crowd the processors.
    return ThreadPoolExecutor(max_workers=jobs, thread_name_prefix="gsplat", initializer=_jobs.set, initargs=(1,))
