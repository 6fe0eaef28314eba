"""Dask clusters whose workers die and are not replaced, or never could do anything for us."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

pytest.importorskip("distributed")

import distributed

from gsplat_tools.cli.convert import main
from gsplat_tools.cluster import on_dask
from gsplat_tools.cluster.on_dask import Dask
from gsplat_tools.errors import ClusterError
from gsplat_tools.formats.saving import save
from gsplat_tools.progress import Stage, report_to
from tests.clouds import random_cloud
from tests.cluster.crowded import keep_slowly
from tests.cluster.ending import end_or_return, fail_at_first

pytestmark = pytest.mark.cluster

WORKER = "import sys; {}from distributed.cli.dask_worker import main; main()"
WITHOUT = "sys.modules['gsplat_tools'] = None; "
"""Hides our modules from a worker."""

StartWorker = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def scheduler() -> Iterator[str]:
    """A scheduler of its own."""
    with distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=50) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def start_worker(scheduler: str, tmp_path: Path) -> Iterator[StartWorker]:
    """Start a worker that nobody starts again."""
    started = []

    def start(before: str = "", name: int = 1) -> subprocess.Popen[bytes]:
        words = [scheduler, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--name", str(name)]
        words += ["--local-directory", str(tmp_path / "dask")]
        process = subprocess.Popen(
            [sys.executable, "-c", WORKER.format(before), *words],
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
            stderr=subprocess.DEVNULL,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def engine(scheduler: str, start_worker: StartWorker, monkeypatch: pytest.MonkeyPatch) -> Iterator[Dask]:
    """An engine whose only worker is `pids(engine)[0]`."""
    monkeypatch.setattr(on_dask, "_LOOK_SECONDS", 0.1)
    start_worker()
    dask = Dask(scheduler, 1, 3)
    yield dask
    dask.close()


def kill_once_started(engine: Dask, started: Path) -> threading.Thread:
    """Kill the only worker once it is at the task that says so."""
    (pid,) = engine.run_everywhere(os.getpid)

    def kill() -> None:
        while not started.exists():
            time.sleep(0.01)
        os.kill(pid, signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread


class Told:
    """Remembers the labels of stages."""

    def __init__(self) -> None:
        self.labels: list[str] = []
        self.closed = 0

    def __call__(self, label: str, total: int, unit: str) -> Stage:
        self.labels.append(label)
        return self

    def advance(self, amount: int) -> None:
        pass

    def close(self) -> None:
        self.closed += 1


def test_no_worker_is_left__ends_with_an_error(engine: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_dask, "_GONE_SECONDS", 0.5)
    pending = [engine.submit(keep_slowly, str(tmp_path), index) for index in range(2)]
    killer, told = kill_once_started(engine, tmp_path / "0.pid"), Told()

    with report_to(told), pytest.raises(ClusterError, match=r"all workers .* are gone; .* the same command"):
        list(engine.results(pending))

    killer.join()
    assert told.labels == ["all workers are gone, waiting for others"]
    assert told.closed == 1


def test_no_worker_is_left__is_the_error_of_every_scene_that_was_not_done(
    engine: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_dask, "_GONE_SECONDS", 0.5)
    done = engine.submit(end_or_return, 5)
    assert [outcome.result() for outcome in engine.results([done])] == [25]
    killer = kill_once_started(engine, tmp_path / "0.pid")

    found = dict(engine.completed([engine.submit(keep_slowly, str(tmp_path), index) for index in range(2)]))

    killer.join()
    assert sorted(found) == [0, 1]
    for error in found.values():
        assert isinstance(error, ClusterError)
        assert "are gone" in str(error)


def test_a_result_that_died_with_its_worker__is_not_waited_for_without_end(
    engine: Dask, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(on_dask, "_GONE_SECONDS", 0.5)
    (pid,) = engine.run_everywhere(os.getpid)
    pending = engine.submit(end_or_return, 5)
    while not pending.done():
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)

    with pytest.raises(ClusterError, match="are gone"):
        list(engine.results([pending]))

    assert "gather" not in capfd.readouterr().err


def test_a_worker_that_comes_instead__goes_on(engine: Dask, start_worker: StartWorker, tmp_path: Path) -> None:
    pending = [engine.submit(keep_slowly, str(tmp_path), index) for index in (3, 4)]
    (tmp_path / "4.pid").touch()  # not slow
    killer = kill_once_started(engine, tmp_path / "3.pid")
    killer.join()
    start_worker(name=2)

    assert [outcome.result() for outcome in engine.results(pending)] == [9, 16]
    assert engine.retried in (1, 2)  # the second may have waited at the worker that died, or at the scheduler


def test_tries__are_counted(engine: Dask, tmp_path: Path) -> None:
    for name, times in (("passes", 2), ("stays", 9)):
        (tmp_path / name).mkdir()
        _, found = next(engine.completed([engine.submit(fail_at_first, str(tmp_path / name), times)]))
        assert isinstance(found, ConnectionError) == (name == "stays")

    assert engine.retried == 2 + 3
    assert len(list((tmp_path / "stays").iterdir())) == 1 + 3


def test_workers_without_our_modules__are_refused(scheduler: str, start_worker: StartWorker, tmp_path: Path) -> None:
    start_worker(WITHOUT)
    with pytest.raises(ClusterError, match=r"the worker at tcp://.* cannot run gsplat_tools .*install the same version"):
        Dask(scheduler)
    save(random_cloud(20), tmp_path / "a.ply")
    (tmp_path / "m.csv").write_text(f"source,target\n{tmp_path}/a.ply,{tmp_path}/a.spz\n")

    result = CliRunner().invoke(main, ["--batch", str(tmp_path / "m.csv"), "--scheduler", scheduler])

    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert "install the same version of gsplat_tools" in result.stderr


def test_a_scheduler_without_our_modules__is_an_error_that_says_so() -> None:
    dask: Any = object.__new__(Dask)
    dask.name, dask._distributed = "tcp://there", distributed

    def task() -> None:
        try:
            raise ModuleNotFoundError("No module named 'gsplat_tools'")
        except ModuleNotFoundError as error:
            raise RuntimeError("Error during deserialization of the task graph") from error

    with pytest.raises(ClusterError, match="tcp://there cannot run gsplat_tools"), dask._explained():
        task()
    with pytest.raises(RuntimeError, match="another"), dask._explained():
        raise RuntimeError("another")
