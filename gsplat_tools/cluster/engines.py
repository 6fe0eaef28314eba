"""Where tasks run: in this process, in processes of this machine, or on Dask. Results come in the order of the tasks."""

from __future__ import annotations

import itertools
import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Protocol, cast

from gsplat_tools.cluster.outcomes import Outcome, is_passing, run_task
from gsplat_tools.errors import CapabilityError, ClusterError, MissingDependencyError
from gsplat_tools.parallel import num_jobs

DEFAULT_RETRIES = 3
"""Times that a task is tried again after an error that may pass, or after its worker died."""

_FIRST_PAUSE = 0.2
"""Seconds before a task is tried again in a process of this machine; doubled each time."""

LOST = "the same command continues: segments and scenes that are finished are kept"


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
        self._jobs, self._retries = jobs, retries
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
            yield index, _caught(lambda task=task: self._outcome(task))  # type: ignore[misc]

    def close(self) -> None:
        """Nothing is held."""

    def _outcome(self, task: _Task) -> Outcome:
        if task.outcome is None:
            given = [self._outcome(each) if isinstance(each, _Task) else each for each in task.arguments]
            for attempt in itertools.count():
                try:
                    task.outcome = run_task(task.function, self._jobs, *given)
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
        self._jobs = jobs or max(1, num_jobs() // workers)
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
                    yield index, _caught(lambda task=task: self._outcome(task))  # type: ignore[misc]
                    del left[index]

    def close(self) -> None:
        """End the processes."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _start(self) -> None:
        # Threads of this process make a fork unsafe.
        self._pool = ProcessPoolExecutor(self.workers, mp_context=get_context("spawn"))

    def _send(self, task: _Task) -> None:
        with suppress(BrokenProcessPool):
            task.future = self._pool.submit(run_task, task.function, self._jobs, *task.arguments)
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
                each.future = self._pool.submit(run_task, each.function, self._jobs, *each.arguments)
            except BrokenProcessPool as error:  # one died again meanwhile: whoever waits for this task replaces it
                each.future = Future()
                each.future.set_exception(error)

    def _run_alone(self, task: _Task) -> None:
        """Run a task in a process of its own, to tell whether it is this one that ends processes."""
        self._unfinished.remove(task)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                task.outcome = pool.submit(run_task, task.function, self._jobs, *task.arguments).result()
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


class Dask:
    """Runs tasks on Dask: a cluster of this machine, or one that is running."""

    def __init__(self, address: str, jobs: int | None = None, retries: int = DEFAULT_RETRIES) -> None:
        try:
            import distributed as imported
        except ImportError as error:
            raise MissingDependencyError(
                "a cluster needs dask.distributed; install it with pip install 'gsplat_tools[cluster]'"
            ) from error
        self._cluster: Any = None
        distributed: Any = imported
        self._distributed = distributed
        self._retries = retries
        self.name = address
        self.retried = 0
        local = re.fullmatch(r"local-cluster:(\d+)", address)
        try:
            if local:
                count = int(local[1])
                jobs = jobs or max(1, num_jobs() // count)
                self._cluster = distributed.LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    silence_logs="CRITICAL",
                )
            self._client = distributed.Client(self._cluster or address, set_as_default=False)
            self._client.wait_for_workers(1, timeout=60)
        except (OSError, TimeoutError) as error:
            raise ClusterError(f"no scheduler answers at {address}, or it has no workers: {error}") from error
        self._jobs = jobs
        self.workers = len(self._client.scheduler_info(n_workers=-1)["workers"])
        self.dashboard = self._client.dashboard_link

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Hand in a task."""
        with self._explained():
            return self._client.submit(
                run_task, function, self._jobs, *arguments, retries=self._retries, pure=False, key=_key(function)
            )

    def results(self, pending: Sequence[Any]) -> Iterator[Outcome]:
        """Wait for the tasks; where one fails, those that are not finished are given up."""
        try:
            for future in pending:
                with self._explained():
                    outcome = future.result()
                yield outcome
        except BaseException:
            with suppress(Exception):
                self._client.cancel(list(pending), force=True)
            raise

    def completed(self, pending: Sequence[Any]) -> Iterator[tuple[int, Outcome | Exception]]:
        """Wait for the tasks as they end."""
        if not pending:
            return
        places = {future.key: index for index, future in enumerate(pending)}

        def outcome(future: Any) -> Outcome:
            with self._explained():
                return cast("Outcome", future.result())

        for future in self._distributed.as_completed(pending):
            yield places[future.key], _caught(lambda future=future: outcome(future))  # type: ignore[misc]

    def run_everywhere(self, function: Callable[[], Any]) -> list[Any]:
        """Return what a function returns on every worker."""
        with self._explained():
            return list(self._client.run(function).values())

    def close(self) -> None:
        """Leave a running cluster, or end our own."""
        # A client that lost its scheduler says so at length when it stops looking for it.
        logger = logging.getLogger("distributed.client")
        level = logger.level
        logger.setLevel(logging.CRITICAL)
        with suppress(Exception):
            self._client.close(timeout=5)
        logger.setLevel(level)
        if self._cluster is not None:
            with suppress(Exception):
                self._cluster.close(timeout=10)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn what Dask raises about workers and connections into our error."""
        from asyncio import CancelledError as Cancelled

        lost = (
            CancelledError,
            Cancelled,
            self._distributed.comm.CommClosedError,
            self._distributed.client.FutureCancelledError,
        )
        try:
            yield
        except self._distributed.KilledWorker as error:
            raise ClusterError(f"a task ended its workers again and again, for want of memory most likely; {LOST}") from error
        except lost as error:
            raise ClusterError(f"the connection to the scheduler at {self.name} was lost; {LOST}") from error


def _caught(function: Callable[[], Outcome]) -> Outcome | Exception:
    """Return what a function returns, or the exception that it raises."""
    try:
        return function()
    except Exception as error:
        return error


_numbers = itertools.count()


def _key(function: Callable[..., Any]) -> str:
    """Return a name for a task, which Dask's dashboard groups by what stands before the number."""
    return f"{function.__name__.strip('_')}-{time.time_ns():x}{next(_numbers):x}"


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
