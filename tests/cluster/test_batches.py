"""Manifests, batches that go on after a failure, and what is not done again."""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from gsplat_tools.cli.convert import main
from gsplat_tools.cluster import batches
from gsplat_tools.cluster.engines import InProcess, Processes
from gsplat_tools.cluster.manifest import read_manifest
from gsplat_tools.cluster.state import Done
from gsplat_tools.errors import CorruptDataError, WriteError
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud
from tests.cluster.ending import end_or_return

pytestmark = pytest.mark.cluster


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three scenes in the working directory."""
    for index in range(3):
        save(random_cloud(40 + index, sh_degree=1, seed=index), tmp_path / f"s{index}.ply")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def batch(manifest: str, *words: str) -> tuple[Result, dict[str, Any]]:
    Path("m.csv").write_text(manifest)
    result = CliRunner().invoke(main, ["--batch", "m.csv", "--json", "--views", "0", *words])
    return result, json.loads(result.stdout) if result.stdout.startswith("{") else {}


def statuses(report: dict[str, Any]) -> list[str]:
    return [item["status"] for item in report["items"]]


def test_csv_and_json_lines__say_the_same(scenes: Path) -> None:
    Path("m.csv").write_text("\ufeffsource,target,preset,sh-degree\ns0.ply,a.spz,best,\n\ns?.ply,out/{stem}.splat,,0\n")
    lines = [
        {"source": "s0.ply", "target": "a.spz", "options": {"preset": "best"}},
        {"source": ["s?.ply"], "target": "out/{stem}.splat", "options": {"sh-degree": "0"}},
    ]
    Path("m.jsonl").write_text("\n\n".join(json.dumps(line) for line in lines))

    rows, others = read_manifest("m.csv"), read_manifest("m.jsonl")

    assert [(row.sources, row.target, row.options) for row in rows] == [(r.sources, r.target, r.options) for r in others]
    assert [row.target for row in rows] == ["a.spz", "out/s0.splat", "out/s1.splat", "out/s2.splat"]
    assert [row.line for row in rows] == [2, 4, 4, 4]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("source,target\ns0.ply\n", "line 2: expected as many cells"),
        ("source,target\ns0.ply,a,b\n", "line 2: expected as many cells as the first line has, 2, found 3"),
        ("\n\nsource,target\n\ns0.ply,a.spz\ns0.ply\n", "line 6: expected as many cells"),
        ('source,target\n"s\n0.ply",a.spz\ns1.ply\n', "line 4: expected as many cells"),
        ('source,target\ns0.ply,"a.spz\n\n', "line 2: expected CSV"),
        ("from,to\ns0.ply,a.spz\n", "line 1: expected a first line with the columns source, target"),
        ("source,target,preset,preset\ns0.ply,a.spz,best,fast\n", "line 1: column preset stands there twice"),
        ("source,target\ns0.ply,q.spz\ns1.ply,b/../q.spz\n", "line 3: b/../q.spz is the target of line 2 too"),
        ("source,target\ns0.ply,q.spz\ns1.ply,{here}/q.spz\n", "line 3: {here}/q.spz is the target of line 2 too"),
        ("source,target\ns0.ply,q.spz\ns1.ply,file://{here}/q.spz\n", "is the target of line 2 too"),
        ("source,target\n,a.spz\n", "line 2: expected a source and a target"),
        ("source,target\ns0.ply,a.spz\ns1.ply,a.spz\n", "line 3: a.spz is the target of line 2 too"),
        ("source,target\n", "found none"),
        ("", "found none"),
        ("source,target\ns0.ply,a\0.spz\n", "line 2: a name holds a zero byte"),
        ('\n[{"source": "a", "target": "b"}]', "line 2: expected JSON lines, one object a line, and found a list"),
        ('{"source": "a\u2028b", "target": "b"}\n{"source": 1}', "line 2: expected a source and a target"),
        ('{"source": "a"', "line 1: expected a JSON object"),
        ('{"source": ["a", 1], "target": "b"}', "line 1: expected a source and a target"),
        ('{"source": "a", "target": "b", "preset": "best"}', "line 1: preset belongs into options"),
        ('{"source": "a", "target": "b", "options": []}', "line 1: expected an object"),
    ],
)
def test_manifests_that_are_wrong__name_the_line(scenes: Path, text: str, said: str) -> None:
    Path("m").write_text(text.replace("{here}", str(scenes)))
    with pytest.raises(CorruptDataError) as caught:
        read_manifest("m")
    assert said.replace("{here}", str(scenes)) in str(caught.value)
    result = CliRunner().invoke(main, ["--batch", "m"])
    assert result.exit_code == 2
    assert said.replace("{here}", str(scenes)) in " ".join(result.stderr.split())


def test_bytes_that_are_no_text__name_the_line(scenes: Path) -> None:
    Path("m").write_bytes(b"source,target\ns0.ply,a.spz\ns\xff.ply,b.spz\n")
    with pytest.raises(CorruptDataError, match="line 3: expected UTF-8"):
        read_manifest("m")


def test_a_manifest_that_is_missing__is_a_wrong_use(scenes: Path) -> None:
    for name in ("none.csv", "."):
        result = CliRunner().invoke(main, ["--batch", name])
        assert result.exit_code == 2
        assert name in result.stderr


def test_a_pattern_without_files__fails_alone_and_names_its_line(scenes: Path) -> None:
    result, report = batch("source,target\nx*.ply,{stem}.spz\ns0.ply,a.spz\ny*.ply,b.spz\n")

    assert statuses(report) == ["failed", "done", "failed"]
    assert result.exit_code == 1
    assert report["items"][0]["line"] == 2
    assert "line 2 of the manifest: no file matches the pattern" in report["items"][0]["error"]["message"]
    assert "no file matches the pattern" in report["items"][2]["error"]["message"]


def test_a_scene_that_fails__stops_no_other(scenes: Path) -> None:
    Path("s1.ply").write_bytes(b"ply\nformat")

    result, report = batch("source,target\ns1.ply,b.spz\nnone.ply,c.spz\ns0.ply,a.spz\ns2.ply,nowhere/d.spz\n")

    assert result.exit_code == 1
    assert statuses(report) == ["failed", "failed", "done", "failed"]
    assert report["summary"]["done"] == 1
    assert report["items"][0]["error"]["kind"] == "TruncatedDataError"
    assert "none.ply" in report["items"][1]["error"]["message"]
    assert report["items"][2]["report"]["target"]["bytes"] == Path("a.spz").stat().st_size
    assert not Path("b.spz").exists()
    assert sorted(path.name for path in Path().iterdir()) == [
        "a.spz",
        "m.csv",
        "m.csv.state.jsonl",
        *(f"s{i}.ply" for i in range(3)),
    ]


def test_resume__leaves_out_what_is_done_and_verified(scenes: Path) -> None:
    manifest = "source,target,sh-degree\n" + "".join(f"s{i}.ply,{i}.spz,\n" for i in range(3))
    assert statuses(batch(manifest)[1]) == ["done"] * 3
    assert statuses(batch(manifest, "--resume")[1]) == ["kept"] * 3

    os.utime("s0.ply", (1, 1))  # another time, the same bytes
    save(random_cloud(41, sh_degree=1, seed=7), "s1.ply", overwrite=True)
    data = Path("2.spz").read_bytes()
    Path("2.spz").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    result, report = batch(manifest, "--resume")

    assert statuses(report) == ["kept", "done", "done"]
    assert Path("2.spz").read_bytes() == data
    assert result.exit_code == 0
    other = manifest.replace("0.spz,\n", "0.spz,0\n")
    assert statuses(batch(other, "--resume")[1]) == ["done", "kept", "kept"]
    Path("1.spz").unlink()
    assert statuses(batch(other, "--resume")[1]) == ["kept", "done", "kept"]


def test_without_resume__targets_that_are_there_stay(scenes: Path) -> None:
    batch("source,target\ns0.ply,a.spz\n")
    before = Path("a.spz").read_bytes()

    _, report = batch("source,target,overwrite\ns1.ply,a.spz,false\n")
    assert statuses(report) == ["failed"]
    assert report["items"][0]["error"]["kind"] == "TargetExistsError"
    assert Path("a.spz").read_bytes() == before
    assert statuses(batch("source,target,overwrite\ns1.ply,a.spz,true\n")[1]) == ["done"]


def test_a_state_file_that_was_cut_off__loses_its_last_line(scenes: Path) -> None:
    manifest = "source,target\n" + "".join(f"s{i}.ply,{i}.spz\n" for i in range(3))
    batch(manifest)
    state = Path("m.csv.state.jsonl")
    state.write_bytes(state.read_bytes()[:-20])

    assert sorted(statuses(batch(manifest, "--resume", "--overwrite")[1])) == ["done", "kept", "kept"]
    assert statuses(batch(manifest, "--resume")[1]) == ["kept"] * 3


@pytest.mark.parametrize(
    "manifest",
    [
        "source,target,sh-degree\ns0.ply,a.ply,\ns1.ply,b.ply,1\n",
        """{"source": "s0.ply", "target": "a.ply", "options": {"sh-degree": null}}
        {"source": "s1.ply", "target": "b.ply", "options": {"sh-degree": 1}}""",
    ],
)
def test_options_of_the_command__hold_for_rows_without_their_own(scenes: Path, manifest: str) -> None:
    _, report = batch(manifest, "--sh-degree", "0")
    assert [item["report"]["sh_degree"] for item in report["items"]] == [0, 1]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("source,target,colour\ns0.ply,a.spz,red\n", "line 2 of the manifest: 'colour' is no option"),
        ("source,target,jobs\ns0.ply,a.spz,2\n", "'jobs' is no option of a conversion"),
        ("source,target,sh-degree\ns0.ply,a.spz,9\n", "line 2 of the manifest"),
        ("source,target,codec\ns0.ply,a.spz,zstd\n", "--codec does not apply"),
        ("source,target\ns0.ply,a.xyz\n", "cannot tell the format"),
        ("source,target,strict\ns0.ply,a.spz,maybe\n", "true or false"),
    ],
)
def test_rows_with_wrong_options__are_refused_before_work(scenes: Path, row: str, said: str) -> None:
    result, _ = batch(row)
    assert result.exit_code == 2
    assert said in result.stderr
    assert not Path("a.spz").exists()


@pytest.mark.parametrize(
    "words", [["--batch", "m", "a.ply", "b.spz"], ["--resume", "s0.ply", "a.spz"], ["s0.ply"], ["--batch", "m", "--dry-run"]]
)
def test_words_that_do_not_go_together__are_usage_errors(scenes: Path, words: list[str]) -> None:
    assert CliRunner().invoke(main, words).exit_code == 2


def test_other_schedulers__give_the_same_files(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    def in_process(scheduler: str, jobs: int | None, retries: int) -> InProcess:
        opened.append((scheduler, jobs, retries))
        return InProcess(jobs, retries)

    monkeypatch.setattr("gsplat_tools.cluster.engines.open_engine", in_process)
    for index in range(3):
        save(random_cloud(30, sh_degree=1, seed=index), scenes / f"f{index}.ply")
    elsewhere = ["--scheduler", "local:3", "--jobs", "1", "--retries", "5", "--parts", "kept", "--json"]
    for source, target in (("s0.ply", "{}.spz"), ("f?.ply", "{}.sog4d")):
        result = CliRunner().invoke(main, [source, target.format("there"), *elsewhere])
        CliRunner().invoke(main, [source, target.format("here")])
        assert result.exit_code == 0
        assert json.loads(result.stdout)["cluster"]["scheduler"] == "local"
        assert Path(target.format("there")).read_bytes() == Path(target.format("here")).read_bytes()
    assert opened == [("local:3", 1, 5)] * 2
    assert not list(Path("kept").iterdir())
    refused = CliRunner().invoke(main, ["f?.ply", "x.sog4d", "--time", "0.5", "--scheduler", "local:3"])
    assert refused.exit_code == 1
    assert refused.stderr == ("error: --time cannot be asked for on a cluster; find options on one machine, then give them\n")


def test_an_error_that_passes__is_tried_again_and_no_more_often(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def fails_twice(item: batches.Item, options: str, memory: int | None) -> Any:
        calls.append(Path(item.target).name)
        if len(calls) < 3 or calls[-1] == "b.spz":
            raise WriteError("busy")
        return {"target": {}}, Done(target=item.target, options=options, sources=[], bytes=0, sha256=""), 0

    monkeypatch.setattr(batches, "convert_item", fails_twice)
    monkeypatch.setattr("gsplat_tools.cluster.engines._FIRST_PAUSE", 0)
    items = [batches.Item(line=1, sources=("s0.ply",), target=target) for target in ("a.spz", "b.spz")]

    report = batches.run_batch(items, InProcess(retries=2))

    assert statuses(report) == ["done", "failed"]
    assert calls == ["a.spz"] * 3 + ["b.spz"] * 3
    assert report["cluster"]["retried"] == 4


def test_a_scene_that_ends_its_process__stops_no_other(scenes: Path) -> None:
    engine = Processes(2, retries=1)
    try:
        pending = [engine.submit(end_or_return, index) for index in range(4)]
        outcomes = dict(engine.completed(pending))
    finally:
        engine.close()
    assert sorted(outcomes) == [0, 1, 2, 3]
    assert {index: getattr(outcome, "value", None) for index, outcome in outcomes.items()} == {0: 0, 1: 1, 2: None, 3: 9}


def test_processes_that_die_while_tasks_are_handed_in_again__are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    hand_in, calls = ProcessPoolExecutor.submit, []

    def breaks(pool: ProcessPoolExecutor, *words: Any) -> Any:
        calls.append(words)
        if len(calls) in (2, 3, 4):
            raise BrokenProcessPool
        return hand_in(pool, *words)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", breaks)
    engine = Processes(1)
    try:
        pending = [engine.submit(end_or_return, index) for index in (3, 4)]
        assert [outcome.value for outcome in engine.results(pending)] == [9, 16]
    finally:
        engine.close()
    assert engine.retried >= 2
