"""Options of clusters: what would do nothing is refused, and messages name what was given."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from gsplat_tools.cli.convert import main
from gsplat_tools.cluster.engines import InProcess
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud

pytestmark = pytest.mark.cluster

QUICK = ("--no-validate", "--webp-effort", "0", "--sh-palette-size", "20", "--scale-codebook-size", "20")


@pytest.fixture
def frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two frames in the working directory, and tasks that run in this process."""
    monkeypatch.setattr("gsplat_tools.cluster.engines.open_engine", lambda _, jobs, retries: InProcess(jobs, retries))
    monkeypatch.chdir(tmp_path)
    for index in range(2):
        save(random_cloud(30, sh_degree=1, seed=index), tmp_path / f"f{index}.ply")
    Path("m").write_text("source,target\nf0.ply,a.spz\n")
    return tmp_path


def run(*words: str) -> Result:
    return CliRunner().invoke(main, [*words])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--batch m --to spz --to sog", "a row of a batch has one target; give --to once"),
        ("--batch m --parts there", "--parts is for one sequence or scene"),
        ("--batch m --block-splats 9", "--block-splats is for one scene"),
        ("f0.ply a.sog4d --parts there", "give a --scheduler too, or --block-splats"),
        ("f0.ply a.spz --retries 3", "--retries is for tasks"),
        ("f0.ply a.sog4d --block-splats 9 --dry-run", "leave out --batch, --scheduler and --block-splats"),
        ("f0.ply a.spz --auto --views 0", "--auto looks at pictures and needs at least one view"),
    ],
)
def test_what_would_do_nothing__is_refused(frames: Path, words: str, said: str) -> None:
    result = run(*words.split())
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())
    assert not list(Path().glob("a.*"))


def test_blocks_of_a_sequence__are_refused_with_the_reason(frames: Path) -> None:
    for elsewhere in ((), ("--scheduler", "local:2")):
        result = run("f?.ply", "a.sog4d", "--block-splats", "9", *elsewhere)
        assert result.exit_code == 1
        assert "blocks are for one still scene, and this is a sequence" in result.stderr


@pytest.mark.parametrize(
    "option",
    ["--time 0.5", "--frame 1", "--target-psnr 30", "--max-bytes 9", "--max-bytes-per-splat 9", "--auto", "--frames auto",
     "--fit-motion window", "--fit-report there"],
)  # fmt: skip
def test_what_a_cluster_cannot_do__is_named_as_it_was_given(frames: Path, option: str) -> None:
    result = run("f?.ply", "a.sog4d", "--scheduler", "local:2", *option.split())
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: {option.split(maxsplit=1)[0]} cannot be asked for on a cluster")


def test_options_that_change_nothing__change_nothing_on_a_cluster(frames: Path) -> None:
    none = ("--tolerance", "0.1", "--lod", "0", "--shn-order", "interleaved", *QUICK)
    assert run("f?.ply", "a.sog4d", *none).exit_code == 0
    result = run("f?.ply", "b.sog4d", "--scheduler", "local:2", *none)
    assert result.exit_code == 0, result.stderr
    assert Path("b.sog4d").read_bytes() == Path("a.sog4d").read_bytes()
    result = run("f0.ply", "c.sog4d", "--block-splats", "9", "--tolerance", "0.1", "--json", *QUICK)
    assert json.loads(result.stdout)["cluster"]["blocks"] == 1


@pytest.mark.parametrize(("workers", "said"), [(1, "1 worker, dashboard"), (2, "2 workers, dashboard")])
def test_the_dashboard__is_said_with_the_number_of_workers(
    frames: Path, monkeypatch: pytest.MonkeyPatch, workers: int, said: str
) -> None:
    monkeypatch.setattr(InProcess, "dashboard", "http://here")
    monkeypatch.setattr(InProcess, "workers", workers)
    assert run("--batch", "m", "--no-validate").stderr.startswith(said)
