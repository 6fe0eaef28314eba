"""Batches and single scenes on Dask workers, which know neither the working directory nor the versions of the command."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gsplat_tools.cli import _cluster as cluster
from gsplat_tools.cluster import runs
from gsplat_tools.cluster.batches import Item, run_batch
from gsplat_tools.cluster.on_dask import Dask
from gsplat_tools.cluster.state import State
from gsplat_tools.errors import ClusterError, TargetExistsError
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud
from tests.cluster.ending import wait_and_return

pytestmark = pytest.mark.cluster
pytest.importorskip("distributed")

QUICK = {"validation": None}


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dask]:
    """One worker, which is in a folder of its own."""
    dask = Dask("local-cluster:1", 1, 0)
    dask.run_everywhere(partial(os.chdir, tmp_path_factory.mktemp("worker")))
    yield dask
    dask.close()


def test_relative_names__are_those_of_the_command(engine: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "a[1]"  # which is no pattern
    folder.mkdir()
    monkeypatch.chdir(folder)
    for index in range(2):
        save(random_cloud(40, sh_degree=1, seed=index), folder / f"s{index}.ply")
    items = [
        Item(line=2, sources=("s0.ply",), target="a.spz", arguments=QUICK),
        Item(line=3, sources=("s?.ply",), target="b.sog4d", arguments=QUICK),
        Item(line=4, sources=("none.ply",), target="c.spz", arguments=QUICK),
    ]

    report = run_batch(items, engine, state=State(Path("state")))

    assert [item["status"] for item in report["items"]] == ["done", "done", "failed"]
    assert [item["report"]["target"]["path"] for item in report["items"][:2]] == ["a.spz", "b.sog4d"]
    assert [item["report"]["source"] for item in report["items"][:2]] == ["s0.ply", "s?.ply"]
    assert sorted(path.name for path in folder.iterdir()) == ["a.spz", "b.sog4d", "s0.ply", "s1.ply", "state"]
    again = run_batch(items[:2], engine, state=State(Path("state")), resume=True)
    assert [item["status"] for item in again["items"]] == ["kept", "kept"]

    one = Item(line=0, sources=("s0.ply",), target="d.spz", arguments={**QUICK, "overwrite": False})
    assert cluster._convert_whole(one, engine)["target"]["path"] == "d.spz"
    assert Path("d.spz").read_bytes() == Path("a.spz").read_bytes()
    with pytest.raises(TargetExistsError, match=r"d\.spz: the target exists"):
        cluster._convert_whole(one, engine)


def test_workers_with_other_versions__are_refused(engine: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(random_cloud(40, sh_degree=1, seed=1), tmp_path / "a.ply")
    versions, able = runs.fingerprint()
    monkeypatch.setattr(runs, "fingerprint", other_versions({**versions, "libwebp": "0.0"}, able))
    item = Item(line=2, sources=(str(tmp_path / "a.ply"),), target=str(tmp_path / "a.spz"), arguments={"overwrite": False})

    with pytest.raises(ClusterError, match=r"a worker has libwebp .* instead of 0\.0"):
        run_batch([item], engine)
    with pytest.raises(ClusterError, match="a worker has libwebp"):
        cluster._convert_whole(item, engine)
    assert not (tmp_path / "a.spz").exists()


def other_versions(versions: dict[str, str], able: str) -> Any:
    """Return a stand-in for `fingerprint` that is the true one on workers."""
    return _Here(os.getpid(), versions, able)


class _Here:
    def __init__(self, pid: int, versions: dict[str, str], able: str) -> None:
        self.pid, self.found = pid, (versions, able)

    def __call__(self) -> tuple[dict[str, str], str]:
        return self.found if os.getpid() == self.pid else runs.fingerprint()


def test_tasks_that_nobody_waits_for__are_given_up(engine: Dask) -> None:
    pending = [engine.submit(wait_and_return, 0.2) for _ in range(6)]
    ended = engine.completed(pending)
    assert next(ended)[1].value == 0.2

    ended.close()

    assert sum(future.cancelled() for future in pending) >= 4
