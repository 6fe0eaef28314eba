"""Where tasks run: in this process, in processes of this machine, or on Dask. Results come in the order of the tasks."""

from __future__ import annotations

import itertools
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Protocol

from gsplat_tools.cluster.on_dask import Dask
from gsplat_tools.cluster.outcomes import DEFAULT_RETRIES, Outcome, Settings, caught, is_passing, run_task
from gsplat_tools.errors import CapabilityError, ClusterError
from gsplat_tools.parallel import num_jobs

__all__ = ["DEFAULT_RETRIES", "Dask", "Engine", "InProcess", "Processes", "open_engine"]

_FIRST_PAUSE = 0.2
"""Seconds before a task is tried again in a process of this machine; doubled each time."""

_END_SECONDS = 7.0
"""Seconds that a process has to drop what it has half done; a store that hangs takes five of them."""


class Engine(Protocol):
    """Something that runs tasks."""

    name: str
    workers: int
    dashboard: str | None
    retried: int

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Hand in a task; arguments may be tasks handed in before, and stand for their results."""

    def results(self, pending: Sequence[Any]) -> Iterator[Outcome]:
        """Yield outcomes in the order of the tasks."""

    def completed(self, pending: Sequence[Any]) -> Iterator[tuple[int, Outcome | Exception]]:
        """Yield (index of the task, outcome or error) as they end; one that fails stops no other."""

    def close(self) -> None:
        """Let go of the workers."""


@dataclass(slots=True)
class _Task:
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    future: Future[Outcome] | None = None
    outcome: Outcome | None = None
    tries: int = 0


class InProcess:
    """Runs tasks one after another in this process; each uses its threads."""

    name = "local"
    workers = 1
    dashboard: str | None = None

    def __init__(self, jobs: int | None = None, retries: int = DEFAULT_RETRIES) -> None:
        self._settings, self._retries = Settings(jobs), retries
        self.retried = 0

    def submit(self, function: Callable[..., Any], *arguments: Any) -> _Task:
        """Keep the task until its result is asked for."""
        return _Task(function, arguments)

    def results(self, pending: Sequence[_Task]) -> Iterator[Outcome]:
        """Run the tasks."""
        for task in pending:
            yield self._outcome(task)

    def completed(self, pending: Sequence[_Task]) -> Iterator[tuple[int, Outcome | Exception]]:
        """Run the tasks."""
        for index, task in enumerate(pending):
            yield index, caught(lambda task=task: self._outcome(task))  # type: ignore[misc]

    def close(self) -> None:
        """Nothing is held."""

    def _outcome(self, task: _Task) -> Outcome:
        if task.outcome is None:
            given = [self._outcome(each) if isinstance(each, _Task) else each for each in task.arguments]
            for attempt in itertools.count():
                try:
                    task.outcome = run_task(task.function, self._settings, *given)
                    break
                except Exception as error:
                    if attempt >= self._retries or not is_passing(error):
                        raise
                    self.retried += 1
                    time.sleep(_FIRST_PAUSE * 2**attempt)
        assert task.outcome is not None
        return task.outcome


class Processes:
    """Runs tasks in `workers` processes of this machine; a process that dies is replaced."""

    dashboard: str | None = None

    def __init__(self, workers: int, jobs: int | None = None, retries: int = DEFAULT_RETRIES) -> None:
        self.name = f"local:{workers}"
        self.workers = workers
        self.retried = 0
        self._settings = Settings(jobs or max(1, num_jobs() // workers))
        self._retries = retries
        self._unfinished: list[_Task] = []
        self._start()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> _Task:
        """Hand in a task, after what it needs is there."""
        given = tuple(self._outcome(each) if isinstance(each, _Task) else each for each in arguments)
        task = _Task(function, given)
        self._unfinished.append(task)
        self._send(task)
        return task

    def results(self, pending: Sequence[_Task]) -> Iterator[Outcome]:
        """Wait for the tasks."""
        for task in pending:
            yield self._outcome(task)

    def completed(self, pending: Sequence[_Task]) -> Iterator[tuple[int, Outcome | Exception]]:
        """Wait for the tasks as they end."""
        left = dict(enumerate(pending))
        while left:
            futures = [task.future for task in left.values() if task.future is not None]
            wait(futures, return_when=FIRST_COMPLETED)
            ended = [index for index, task in left.items() if task.future is not None and task.future.done()]
            for index in ended:
                task = left[index]
                if task.future is not None and task.future.done():  # not handed in again meanwhile
                    yield index, caught(lambda task=task: self._outcome(task))  # type: ignore[misc]
                    del left[index]

    def close(self) -> None:
        """End the processes; those that are busy are told to drop what they have half done, which may take seconds."""
        processes = list((self._pool._processes or {}).values())
        busy = any(each.future is not None and not each.future.done() for each in self._unfinished)
        self._pool.shutdown(wait=False, cancel_futures=True)
        if not busy:
            return
        for process in processes:
            process.terminate()
        end = time.monotonic() + _END_SECONDS
        for process in processes:
            process.join(max(0.0, end - time.monotonic()))
            if process.is_alive():
                process.kill()

    def _start(self) -> None:
        # Threads of this process make a fork unsafe.
        self._pool = _pool(self.workers)

    def _send(self, task: _Task) -> None:
        with suppress(BrokenProcessPool):
            task.future = self._pool.submit(_run_here, task.function, self._settings, *task.arguments)
            return
        self._restart(task)

    def _restart(self, task: _Task) -> None:
        """Replace the processes after one died, and hand in again what they had not finished."""
        task.tries += 1
        self.retried += 1
        self._pool.shutdown(wait=False, cancel_futures=True)
        if task.tries > self._retries:
            self._run_alone(task)
        self._start()
        for each in self._unfinished:
            try:
                each.future = self._pool.submit(_run_here, each.function, self._settings, *each.arguments)
            except BrokenProcessPool as error:  # one died again meanwhile: whoever waits for this task replaces it
                each.future = Future()
                each.future.set_exception(error)

    def _run_alone(self, task: _Task) -> None:
        """Run a task in a process of its own, to tell whether it is this one that ends processes."""
        self._unfinished.remove(task)
        with _pool(1) as pool:
            try:
                task.outcome = pool.submit(_run_here, task.function, self._settings, *task.arguments).result()
            except BrokenProcessPool as error:
                task.outcome = Outcome(
                    error=ClusterError(f"the task ended its process {task.tries + 1} times, for want of memory most likely")
                )
                task.outcome.error.__cause__ = error  # type: ignore[union-attr]

    def _outcome(self, task: _Task) -> Outcome:
        while task.outcome is None:
            assert task.future is not None
            try:
                task.outcome = task.future.result()
                self._unfinished.remove(task)
            except BrokenProcessPool:
                self._restart(task)
            except CancelledError:
                self._send(task)
            except Exception as error:
                task.tries += 1
                if task.tries > self._retries or not is_passing(error):
                    self._unfinished.remove(task)
                    raise
                self.retried += 1
                time.sleep(_FIRST_PAUSE * 2**task.tries)
                self._send(task)
        return task.outcome


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_obey_parent)


def _obey_parent() -> None:
    """Leave Ctrl-C to the parent, which ends this process by SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))


def _run_here(function: Callable[..., Any], settings: Settings, *arguments: Any) -> Outcome:
    """Run a task in a process of a pool; SIGTERM unwinds it, so that what is half done is dropped, and ends the process."""
    try:
        return run_task(function, settings, *arguments)
    except SystemExit as end:
        os._exit(int(end.code or 0))  # the pool would take it for a result and start the next task


def open_engine(scheduler: str, jobs: int | None = None, retries: int = DEFAULT_RETRIES) -> Engine:
    """Return the engine of a name.

    Parameters
    ----------
    scheduler
        "local" (this process and its threads), "local:N" (processes), "local-cluster:N" (Dask on this machine), or the
        address of a Dask scheduler, such as "tcp://host:8786".
    jobs
        Threads of a task; by default what the machine has, shared out.
    retries
        Times that a task is tried again.

    Raises
    ------
    CapabilityError
        The name is unknown.
    ClusterError, MissingDependencyError
        There is no such cluster, or Dask is not installed.
    """
    if scheduler == "local":
        return InProcess(jobs, retries)
    if match := re.fullmatch(r"local:([1-9]\d*)", scheduler):
        return Processes(int(match[1]), jobs, retries)
    if re.fullmatch(r"local-cluster:[1-9]\d*|(tcp|tls|ws|wss|ucx)://.+", scheduler):
        return Dask(scheduler, jobs, retries)
    raise CapabilityError(f"unknown scheduler {scheduler!r}; use local, local:N, local-cluster:N or tcp://HOST:PORT")
