"""Batches that were ended in the middle: what they leave, and how the next run goes on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from gsplat_tools.cli.convert import main
from gsplat_tools.cluster import batches
from gsplat_tools.cluster.engines import InProcess
from gsplat_tools.cluster.state import State
from gsplat_tools.convert import convert
from gsplat_tools.errors import ClusterError, ReadError
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud

pytestmark = pytest.mark.cluster

MANIFEST = "source,target\n" + "".join(f"s{index}.ply,{index}.spz\n" for index in range(4))
QUICK = {"validation": None}


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four scenes and a manifest in the working directory."""
    for index in range(4):
        save(random_cloud(40 + index, sh_degree=1, seed=index), tmp_path / f"s{index}.ply")
    monkeypatch.chdir(tmp_path)
    Path("m.csv").write_text(MANIFEST)
    return tmp_path


def batch(*words: str) -> tuple[Result, dict[str, Any]]:
    result = CliRunner().invoke(main, ["--batch", "m.csv", "--json", "--no-validate", *words])
    return result, json.loads(result.stdout) if result.stdout.startswith("{") else {}


def statuses(report: dict[str, Any]) -> list[str]:
    return [item["status"] for item in report["items"]]


def expected(scenes: Path) -> list[bytes]:
    """Return the bytes of all targets, converted elsewhere."""
    (scenes / "apart").mkdir(exist_ok=True)
    for index in range(4):
        convert([scenes / f"s{index}.ply"], scenes / f"apart/{index}.spz", overwrite=True, validation=None)
    return [(scenes / f"apart/{index}.spz").read_bytes() for index in range(4)]


@contextlib.contextmanager
def command(*words: str) -> Iterator[subprocess.Popen[str]]:
    """Run a batch as a process, and end it and its workers at the end."""
    code = "import sys; from gsplat_tools.cli.convert import main; sys.exit(main())"
    line = [sys.executable, "-c", code, "--batch", "m.csv", "--no-validate", *words]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def wait_for(path: Path) -> None:
    """Wait for a file to appear."""
    end = time.monotonic() + 120
    while not path.exists():
        assert time.monotonic() < end, f"{path} has not appeared"
        time.sleep(0.001)


def test_a_command_that_was_killed__goes_on_with_resume(scenes: Path) -> None:
    with command("--scheduler", "local:2", "--jobs", "1") as process:
        wait_for(scenes / "0.spz")
        process.kill()
        process.wait()
        result, report = batch("--resume")  # while its workers may still write what they have begun

    assert result.exit_code == 0, result.stderr
    assert set(statuses(report)) <= {"done", "kept"}
    assert [(scenes / f"{index}.spz").read_bytes() for index in range(4)] == expected(scenes)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_was_interrupted__says_how_far_it_is_and_goes_on(scenes: Path, number: signal.Signals) -> None:
    with command("--scheduler", "local:2", "--jobs", "1") as process:
        wait_for(scenes / "0.spz")
        process.send_signal(number)
        assert process.stderr is not None
        said = process.stderr.read()
        process.wait()
        if process.returncode == 0:
            pytest.skip("all was done before the signal came")
    assert process.returncode == 128 + number
    assert " of 4 scenes are done; the same command with --resume continues" in said

    result, report = batch("--resume")

    assert result.exit_code == 0, result.stderr
    assert set(statuses(report)) <= {"done", "kept"}
    assert [(scenes / f"{index}.spz").read_bytes() for index in range(4)] == expected(scenes)


def end_before_noting(monkeypatch: pytest.MonkeyPatch, target: str) -> None:
    """End the next batch after a target was published, before that is noted."""
    keep = State.keep

    def ends(state: State, done: Any) -> None:
        if done.target.endswith(target):
            raise KeyboardInterrupt
        keep(state, done)

    monkeypatch.setattr(State, "keep", ends)
    result, _ = batch()
    monkeypatch.setattr(State, "keep", keep)
    assert result.exit_code == 130
    assert "interrupted; 1 of 4 scenes are done; the same command with --resume continues" in result.stderr


def test_a_target_that_was_published_and_not_noted__is_made_again(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    end_before_noting(monkeypatch, "1.spz")
    assert Path("1.spz").exists()

    assert statuses(batch()[1]) == ["failed", "failed", "done", "done"]
    result, report = batch("--resume")

    assert statuses(report) == ["kept", "done", "kept", "kept"]
    assert result.exit_code == 0
    assert [(scenes / f"{index}.spz").read_bytes() for index in range(4)] == expected(scenes)
    assert statuses(batch("--resume")[1]) == ["kept"] * 4


def test_targets_that_were_there_before__are_refused_after_an_interruption_too(
    scenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("3.spz").write_bytes(b"mine")
    Path("2.spz").write_bytes(b"also mine")
    Path("m.csv").write_text("source,target,overwrite\n" + "".join(f"s{i}.ply,{i}.spz,{i == 2}\n" for i in range(4)))
    keep = State.keep
    monkeypatch.setattr(State, "keep", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    assert batch()[0].exit_code == 130
    monkeypatch.setattr(State, "keep", keep)
    assert Path("2.spz").read_bytes() == b"also mine"  # it may be replaced, and was not yet

    Path("m.csv").write_text(MANIFEST)
    _, report = batch("--resume")

    assert statuses(report) == ["done", "done", "failed", "failed"]
    assert report["items"][3]["error"]["kind"] == "TargetExistsError"
    assert "this batch has not written it; --overwrite" in report["items"][3]["error"]["message"]
    assert [Path(f"{index}.spz").read_bytes() for index in (2, 3)] == [b"also mine", b"mine"]


def test_a_companion_that_was_there_before__is_refused(scenes: Path) -> None:
    Path("m.csv").write_text("source,target,to\ns0.ply,a.vis,visionary-f16\n")
    Path("a.vis.json").write_bytes(b"{}")

    for words in ((), ("--resume",)):
        _, report = batch(*words)
        assert report["items"][0]["error"]["kind"] == "TargetExistsError"
        assert Path("a.vis.json").read_bytes() == b"{}"
    assert not Path("a.vis").exists()


def test_a_scene_that_failed__leaves_its_place_to_others(scenes: Path) -> None:
    source = Path("s1.ply").read_bytes()
    Path("s1.ply").write_bytes(source[:-10])
    assert statuses(batch()[1]) == ["done", "failed", "done", "done"]
    Path("s1.ply").write_bytes(source)
    Path("1.spz").write_bytes(b"mine")

    _, report = batch("--resume")

    assert statuses(report) == ["kept", "failed", "kept", "kept"]
    assert report["items"][1]["error"]["kind"] == "TargetExistsError"
    assert Path("1.spz").read_bytes() == b"mine"


def test_a_try_that_fails_after_its_target_appeared__is_followed_by_another(
    scenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hash_of, failed = batches._hash, []

    def fails_once(name: str) -> tuple[str, int]:
        if name.endswith("1.spz") and not failed:
            failed.append(name)
            raise ReadError("the disk is busy", path=name)
        return hash_of(name)

    monkeypatch.setattr(batches, "_hash", fails_once)
    items = [batches.Item(line=i, sources=(f"s{i}.ply",), target=f"{i}.spz", arguments=QUICK) for i in range(2)]

    report = batches.run_batch(items, InProcess(1, 1))

    assert statuses(report) == ["done", "done"]
    assert report["cluster"]["retried"] == 1
    assert report["items"][1]["report"]["target"]["path"] == "1.spz"


def test_without_resume__what_was_done_is_still_known_later(scenes: Path) -> None:
    assert statuses(batch()[1]) == ["done"] * 4
    result, report = batch()
    assert statuses(report) == ["failed"] * 4
    assert "0.spz: the target exists; --resume leaves out what this batch has done" in result.stderr
    assert statuses(batch("--resume")[1]) == ["kept"] * 4


def test_an_empty_state__stays_empty(scenes: Path) -> None:
    Path("m.csv").write_text("source,target\nx*.ply,{stem}.spz\n")
    batch()
    batch("--resume")
    assert Path("m.csv.state.jsonl").read_bytes() == b""


def test_a_scheduler_that_is_lost__leaves_what_was_begun(scenes: Path) -> None:
    class Lost(InProcess):
        def completed(self, pending: Any) -> Iterator[Any]:
            for index, outcome in super().completed(pending):
                is_conversion = pending[index].function is batches.convert_item
                yield index, ClusterError("the connection was lost") if is_conversion and index == 1 else outcome

    state = State(Path("state"))
    items = [batches.Item(line=i, sources=(f"s{i}.ply",), target=f"{i}.spz", arguments=QUICK) for i in range(2)]
    assert statuses(batches.run_batch(items, Lost(1, 1), state=state)) == ["done", "failed"]

    assert statuses(batches.run_batch(items, InProcess(1, 1), state=State(Path("state")), resume=True)) == ["kept", "done"]
