"""Tasks on Dask: a cluster of this machine, or one that is running."""

from __future__ import annotations

import asyncio
import itertools
import logging
import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, wait
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, cast

from gsplat_tools.cluster.outcomes import DEFAULT_RETRIES, Outcome, Settings, caught, is_full, run_task
from gsplat_tools.errors import ClusterError, MissingDependencyError
from gsplat_tools.parallel import num_jobs
from gsplat_tools.progress import stage

LOST = "the same command (a batch with --resume) continues: segments and scenes that are finished are kept"

_SAME = "install the same version of gsplat_tools on the scheduler and on all workers"

_FULL_SECONDS = 2.0
"""Seconds that a worker with a full disk takes to say so, lest it be the first that is free for every task."""

_LOOK_SECONDS = 5.0
"""Seconds between two looks whether workers are still there, while a task is waited for."""

_FAILED_TOPIC = "gsplat_tools-failed"
"""Of events: keys of tasks that failed and may be tried again."""

_GONE_SECONDS = 60.0
"""Seconds without any worker after which none is expected any more."""

_REPLACED_SECONDS = 30.0
"""Seconds within which a worker that died is expected to be replaced, where all others have full disks."""


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
        self._full: set[str] = set()
        self._keys: set[str] = set()
        self._failed: Counter[str] = Counter()
        self._counting = threading.Lock()  # events are taken by another thread
        self._given: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {}
        self._instead: dict[str, Any] = {}
        self._kept_to: dict[str, list[str]] = {}
        self._gone_since: float | None = None
        self._said = ExitStack()  # shows that there is no worker
        self._client: Any = None
        # What a client says about lost workers and schedulers, at length and also when it is closed, is told by our errors.
        self._logger = logging.getLogger("distributed.client")
        self._level = self._logger.level
        self._logger.setLevel(logging.CRITICAL)
        try:
            self._open(address, jobs)
        except BaseException:
            self.close()
            raise

    def _open(self, address: str, jobs: int | None) -> None:
        """Connect, and see that workers can do anything for us."""
        distributed = self._distributed
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
        self._settings = Settings(jobs)
        self.workers = len(self._addresses())
        self.dashboard = self._client.dashboard_link
        self._client.subscribe_topic("all", self._take_event)
        self._client.subscribe_topic(_FAILED_TOPIC, self._take_failure)
        self.run_everywhere(_nothing)  # told here, since a worker without our modules ends when it is given a task

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Hand in a task."""
        future = self._submit(function, arguments)
        self._given[future.key] = (function, arguments)
        return future

    def results(self, pending: Sequence[Any]) -> Iterator[Outcome]:
        """Wait for the tasks; where one fails, those that are not finished are given up."""
        try:
            for future in pending:
                yield self._outcome(future)
        except BaseException:
            with suppress(Exception):
                self._client.cancel(list(pending), force=True)
            raise

    def completed(self, pending: Sequence[Any]) -> Iterator[tuple[int, Outcome | Exception]]:
        """Wait for the tasks as they end; where the caller ends early, those that are not finished are given up."""
        if not pending:
            return
        left = {future.key: (index, future) for index, future in enumerate(pending)}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        for future in pending:
            future.add_done_callback(ended.put)
        try:
            while left:
                try:
                    found = [ended.get(timeout=_LOOK_SECONDS)]
                except queue.Empty:
                    found = self._stranded([future for _, future in left.values()])
                for future in found:
                    if future.key in left:
                        index, _ = left.pop(future.key)
                        yield index, caught(lambda future=future: self._outcome(future))  # type: ignore[misc]
        except _GoneError as error:
            # As where the scheduler is lost: what was not done is told task by task.
            yield from ((index, ClusterError(str(error))) for index, _ in left.values())
        except BaseException:
            with suppress(Exception):
                self._client.cancel(list(pending), force=True)
            raise
        finally:
            self._said.close()

    def _submit(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        # Not `allow_other_workers`: workers whose disk is full are idle, and would steal what is kept from them.
        workers = [each for each in self._addresses() if each not in self._full] or None if self._full else None
        key = _key(function)
        self._keys.add(key)
        with self._explained():
            future = self._client.submit(
                _run_on_worker, function, self._settings, *arguments,
                retries=self._retries, pure=False, key=key, workers=workers,
            )  # fmt: skip
        if workers:
            self._kept_to[future.key] = workers
        return future

    def _outcome(self, future: Any) -> Outcome:
        """Wait for a task; where it met a full disk, other workers do it."""
        given = self._given.pop(future.key, None)
        future = self._instead.get(future.key, future)
        while (outcome := self._waited(future)) is None or outcome.full is not None:
            if outcome is not None:
                assert outcome.full is not None
                address, key = outcome.full
                self._full.add(address)
                self._count(1)
                if given is None or not self._has_room():
                    assert outcome.error is not None
                    raise outcome.error
                arguments = tuple(self._again(each) if getattr(each, "key", "") == key else each for each in given[1])
                given = (given[0], arguments)
            else:
                self._has_room()  # waits for the worker that comes instead; without one, those with full disks try
            assert given is not None
            future = self._submit(*given)
        for each in given[1] if given is not None else ():  # what they were made from may go
            self._given.pop(getattr(each, "key", ""), None)
        return outcome

    def _take_event(self, event: tuple[float, Any]) -> None:
        """Count the tasks that Dask hands to other workers because theirs is gone."""
        said = event[1]
        if isinstance(said, dict) and said.get("action") == "remove-worker":
            lost = {*said.get("processing-tasks", ()), *said.get("lost-computed-tasks", ())}
            self._count(sum(key in self._keys for key in lost))

    def _take_failure(self, event: tuple[float, Any]) -> None:
        """Count a task that Dask tries again, which it does `retries` times."""
        key = event[1]
        if key in self._keys:
            self._failed[key] += 1
            self._count(int(self._failed[key] <= self._retries))

    def _count(self, tries: int) -> None:
        with self._counting:
            self.retried += tries

    def _has_room(self) -> bool:
        """Whether some worker has room on its disk, those included that come soon in place of others that died."""
        end = time.monotonic() + _REPLACED_SECONDS
        while self._full.issuperset(there := self._addresses()):
            if len(there) >= self.workers or time.monotonic() > end:
                return False
            time.sleep(_LOOK_SECONDS / 50)
        return True

    def _again(self, future: Any) -> Any:
        """Hand in again what another task needs, once for all that need it."""
        if future.key not in self._instead:
            function, arguments = self._given[future.key]
            self._instead[future.key] = self.submit(function, *arguments)
        return self._instead[future.key]

    def _waited(self, future: Any) -> Outcome | None:
        """Wait for a task, or until no worker is left of those that it was kept to."""

        async def fetched() -> Any:
            return await future

        # Not `future.result()`: where the worker that has the result dies, it waits for another, and there may be none.
        fetching = asyncio.run_coroutine_threadsafe(fetched(), self._client.loop.asyncio_loop)
        try:
            while not wait([fetching], _LOOK_SECONDS).done:
                if self._stranded([future]):
                    return None
            with self._explained():
                return cast("Outcome", fetching.result())
        finally:
            fetching.cancel()
            self._kept_to.pop(future.key, None)
            self._said.close()

    def _stranded(self, pending: Sequence[Any]) -> list[Any]:
        """Return the tasks of which all workers that they were kept to are gone.

        Raises
        ------
        ClusterError
            There has been no worker at all for a while.
        """
        there = set(self._addresses())
        if there:
            self._gone_since = None
            self._said.close()
            return [each for each in pending if there.isdisjoint(self._kept_to.get(each.key) or there)]
        if self._gone_since is None:
            self._gone_since = time.monotonic()
            self._said.enter_context(stage("all workers are gone, waiting for others", 0, "workers"))
        elif time.monotonic() - self._gone_since >= _GONE_SECONDS:
            raise _GoneError(f"all workers of the cluster at {self.name} are gone; start others, and {LOST}")
        return []

    def _addresses(self) -> list[str]:
        with self._explained():
            return list(self._client.scheduler_info(n_workers=-1)["workers"])

    def run_everywhere(self, function: Callable[[], Any]) -> list[Any]:
        """Return what a function returns on every worker that answers.

        Raises
        ------
        ClusterError
            A worker cannot run it, most likely for want of our modules; or none answers.
        """
        with self._explained():
            found = self._client.run(function, on_error="return")
        for address, value in found.items():
            if isinstance(value, Exception) and not isinstance(value, OSError):  # those of connections: it is gone by now
                raise ClusterError(f"the worker at {address} cannot run gsplat_tools ({value}): {_SAME}") from value
        values = [value for value in found.values() if not isinstance(value, OSError)]
        if not values:
            raise ClusterError(f"no worker of the cluster at {self.name} answers; start others, and {LOST}")
        return values

    def close(self) -> None:
        """Leave a running cluster, or end our own."""
        if self._client is not None:
            for topic in ("all", _FAILED_TOPIC):  # or the scheduler tells of our leaving, to whom has left
                with suppress(Exception):
                    self._client.unsubscribe_topic(topic)
            with suppress(Exception):
                self._client.close(timeout=5)
        if self._cluster is not None:
            with suppress(Exception):
                self._cluster.close(timeout=10)
        self._logger.setLevel(self._level)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn what Dask raises about workers and connections into our error."""
        lost = (
            CancelledError,
            asyncio.CancelledError,
            self._distributed.comm.CommClosedError,
            self._distributed.client.FutureCancelledError,
        )
        try:
            yield
        except self._distributed.KilledWorker as error:
            raise ClusterError(f"a task ended its workers again and again, for want of memory most likely; {LOST}") from error
        except lost as error:
            raise ClusterError(f"the connection to the scheduler at {self.name} was lost; {LOST}") from error
        except (RuntimeError, ModuleNotFoundError) as error:  # of tasks none comes so: `run_task` returns them
            missing = error if isinstance(error, ModuleNotFoundError) else error.__cause__
            if not isinstance(missing, ImportError | AttributeError):
                raise
            raise ClusterError(f"the cluster at {self.name} cannot run gsplat_tools ({missing}): {_SAME}") from error


class _GoneError(ClusterError):
    """There is no worker."""


def _nothing() -> None:
    """Do nothing, on a worker that has our modules."""


def _run_on_worker(function: Callable[..., Any], settings: Settings, *arguments: Any) -> Outcome:
    """Run a task on a Dask worker; a full disk is told to the engine, since trying again here would use up the tries."""
    for each in arguments:
        if isinstance(each, Outcome) and each.full is not None:
            return each
    try:
        return run_task(function, settings, *arguments)
    except Exception as error:
        from distributed import get_worker

        worker: Any = get_worker()
        if not is_full(error):
            worker.log_event(_FAILED_TOPIC, worker.get_current_task())
            raise
        time.sleep(_FULL_SECONDS)
        return Outcome(error=error, full=(worker.address, worker.get_current_task()))


_numbers = itertools.count()


def _key(function: Callable[..., Any]) -> str:
    """Return a name for a task, which Dask's dashboard groups by what stands before the number."""
    return f"{function.__name__.strip('_')}-{time.time_ns():x}{next(_numbers):x}"
