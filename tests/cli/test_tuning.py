import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from gsplat_tools.cli._tuning import knob_table
from gsplat_tools.cli.convert import main
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats import load, save
from gsplat_tools.ops.sampling import crop

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    save(crop(load(ROOT / "fixtures" / "garden.ply"), 400), path)
    return path


@pytest.fixture(scope="module")
def scene_without_axes(scene: Path) -> Path:
    path = scene.with_name("unknown.ply")
    cloud = load(scene)
    assert isinstance(cloud, GaussianCloud)
    save(cloud.replace(coordinate_system="unknown"), path)
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_target_psnr__is_held_against_the_source_and_explained(scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "out.spz", "--target-psnr", 32, "--views", 3, "--json", "--quiet")

    report = json.loads(result.stdout)
    assert result.exit_code == 0
    assert report["validation"]["psnr_min"] >= 32
    assert report["search"]["psnr_min"] == pytest.approx(report["validation"]["psnr_min"], abs=0.02)
    assert report["search"]["bytes"] == report["target"]["bytes"] == (tmp_path / "out.spz").stat().st_size
    assert report["options"]["fractional_bits"] == report["search"]["options"]["fractional_bits"]
    assert {"option", "value", "bytes_saved", "db_lost", "why"} == set(report["decisions"][0])


def test_target_psnr__leaves_the_target_where_it_cannot_be_had(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.splat"
    target.write_bytes(b"precious")

    result = run(scene, target, "--overwrite", "--target-psnr", 200, "--views", 1, "--quiet")

    assert result.exit_code == 1
    assert "reaches 200 dB: the finest has" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert target.read_bytes() == b"precious"


def test_auto__reports_what_it_saved_and_exact_keeps_everything(scene: Path, tmp_path: Path) -> None:
    auto = json.loads(run(scene, tmp_path / "a.spz", "--preset", "best", "--auto", "--views", 1, "--json", "--quiet").stdout)
    best = json.loads(run(scene, tmp_path / "b.spz", "--preset", "best", "--json", "--quiet").stdout)
    exact = json.loads(run(scene, tmp_path / "c.spz", "--preset", "exact", "--auto", "--json", "--quiet").stdout)

    assert auto["target"]["bytes"] < best["target"]["bytes"]
    assert any(each["bytes_saved"] for each in auto["decisions"])
    assert exact["search"] is None
    assert exact["decisions"] == []
    assert "auto-off" in {each["code"] for each in exact["warnings"]}
    assert exact["splats"] == 400


def test_search__needs_validation_and_is_not_estimated(scene: Path, tmp_path: Path) -> None:
    assert run(scene, tmp_path / "o.spz", "--max-bytes", 9000, "--no-validate").exit_code == 2
    assert run(scene, tmp_path / "o.spz", "--max-bytes", 9000, "--dry-run").exit_code == 2


def test_documents__hold_the_table_that_help_prints() -> None:
    assert knob_table() in (ROOT / "docs" / "tuning.md").read_text(encoding="utf-8")
    assert run("--show-knobs").stdout.strip() == knob_table()


@pytest.mark.parametrize("options", [["--dry-run"], ["--max-bytes", 10**6, "--views", 1], ["--auto", "--views", 1]], ids=str)
def test_clip_by_rendering__comes_before_estimates_and_searches(options: list[object], scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "a.vis", "--to", "visionary-i8", "--clip", "rendered", *options, "--json", "--quiet")

    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert (report["bytes"] if "--dry-run" in options else report["target"]["bytes"]) > 17 * 300
    assert report.get("options", {}).get("clip") != "rendered"


@pytest.mark.parametrize("options", [["--dry-run"], ["--max-bytes", 10**6, "--views", 1]], ids=str)
def test_axes__of_the_source_that_are_given_hold_for_estimates_and_searches(
    options: list[object], scene_without_axes: Path, tmp_path: Path
) -> None:
    scene = scene_without_axes
    axes = ["--source-coordinates", "RDF", "--target-coordinates", "RUB"]
    target = tmp_path / "a.spz"

    plain = json.loads(run(scene, target, *options, "--json", "--quiet", "--overwrite").stdout)
    turned = json.loads(run(scene, target, *options, *axes, "--json", "--quiet", "--overwrite").stdout)

    levels = [report["psnr_min"] if "psnr_min" in report else report["validation"]["psnr_min"] for report in (plain, turned)]
    assert abs(levels[0] - levels[1]) < 3


def test_dry_run__names_the_target_in_errors(scene_without_axes: Path, tmp_path: Path) -> None:
    result = run(scene_without_axes, tmp_path / "a.spz", "--dry-run", "--target-coordinates", "RUB")

    assert result.exit_code == 1
    assert f"{tmp_path / 'a.spz'}, coordinate_system: " in result.stderr
