"""Dask workers without room on their disks: others do what they cannot."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("distributed")

from gsplat_tools.cluster import on_dask
from gsplat_tools.cluster.on_dask import Dask
from tests.cluster.crowded import add, keep, keep_slowly

pytestmark = pytest.mark.cluster


@pytest.fixture
def engine() -> Iterator[Dask]:
    """Two workers; the first has no room."""
    dask = Dask("local-cluster:2", 1, 0)
    yield dask
    dask.close()


def test_a_worker_without_room__is_gone_round(engine: Dask) -> None:
    needed = [engine.submit(keep, index) for index in range(4)]
    sums = [engine.submit(add, index, needed[index % 4]) for index in range(8)]
    assert [outcome.result() for outcome in engine.results(sums)] == [i + (i % 4) ** 2 for i in range(8)]
    assert engine.retried >= 1
    assert [outcome.result() for outcome in engine.results(needed)] == [(i * i, 1) for i in range(4)]

    retried = engine.retried
    later = [engine.submit(keep, index) for index in range(8)]
    assert sorted(index for index, _ in engine.completed(later)) == list(range(8))
    assert engine.retried == retried  # known by now


def test_a_worker_that_is_left_and_dies__does_not_stop_the_run(
    engine: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_dask, "_LOOK_SECONDS", 0.2)
    full = next(address for address, facts in engine._client.scheduler_info()["workers"].items() if facts["name"] == 0)
    engine._full.add(full)
    pending = [engine.submit(keep_slowly, str(tmp_path), 3)]
    alone = threading.Event()
    addresses = engine._addresses
    monkeypatch.setattr(engine, "_addresses", lambda: [full] if alone.is_set() else addresses())

    def kill() -> None:
        while not (tmp_path / "3.pid").exists():
            time.sleep(0.01)
        alone.set()  # until the one that died is replaced, nobody is there but the one whose disk is full
        os.kill(int((tmp_path / "3.pid").read_text()), signal.SIGKILL)
        time.sleep(4)  # longer than that one takes to say so
        alone.clear()

    killer = threading.Thread(target=kill)
    killer.start()
    assert [outcome.result() for outcome in engine.results(pending)] == [9]
    killer.join()


def test_no_room_anywhere__is_the_error_itself() -> None:
    dask = Dask("local-cluster:1", 1, 3)
    try:
        with pytest.raises(OSError, match="No space left") as caught:
            list(dask.results([dask.submit(keep, 1)]))
        assert caught.value.errno == errno.ENOSPC
    finally:
        dask.close()
