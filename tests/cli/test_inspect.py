import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from gsplat_tools.cli.inspect import main
from gsplat_tools.errors import LossyConversionWarning
from gsplat_tools.formats import save
from tests.clouds import random_cloud


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    save(random_cloud(300, sh_degree=1), path)
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_info__has_the_fixed_names(scene: Path) -> None:
    report = json.loads(run("info", scene, "--json").stdout)

    names = "format version bytes splats sh_degree frames coordinate_system origin splat_model bounds motion_bounds encoding"
    assert set(names.split()) == set(report)
    assert (report["format"], report["splats"], report["sh_degree"], report["frames"]) == ("ply", 300, 1, 1)
    assert report["bytes"] == scene.stat().st_size


def test_info__is_what_a_file_alone_asks_for(scene: Path) -> None:
    assert run(scene).stdout == run("info", scene).stdout
    assert "300" in run(scene).stdout


def test_stats__count_what_is_not_finite_and_stay_valid_json(tmp_path: Path) -> None:
    cloud = random_cloud(100, sh_degree=0)
    logits = cloud.opacity_logits.copy()
    logits[:7] = np.inf
    save(cloud.replace(opacity_logits=logits), tmp_path / "s.ply")

    report = json.loads(run("stats", tmp_path / "s.ply", "--json").stdout, parse_constant=pytest.fail)

    entry = report["attributes"]["opacity_logits"]
    assert (entry["inf"], entry["nan"]) == (7, 0)
    assert {"min", "max", "mean", "std", "percentiles", "nan", "inf", "histogram"} == set(entry)
    assert sum(entry["histogram"]["counts"]) == 93


def test_stats__hint_at_activated_values(tmp_path: Path) -> None:
    cloud = random_cloud(50, sh_degree=0)
    save(cloud.replace(log_scales=np.exp(cloud.log_scales), opacity_logits=np.full(50, 0.5)), tmp_path / "s.ply")

    codes = {hint["code"] for hint in json.loads(run("stats", tmp_path / "s.ply", "--json").stdout)["hints"]}

    assert {"scales-look-linear", "opacities-look-activated"} <= codes


def test_compare__of_a_file_with_itself_is_identical(scene: Path) -> None:
    report = json.loads(run("compare", scene, scene, "--views", 2, "--size", "64x48", "--json", "--no-progress").stdout)

    names = "psnr_min psnr_mean ssim_mean max_abs identical worst_view views attributes"
    assert set(names.split()) <= set(report)
    assert report["identical"] is True
    assert report["psnr_min"] is None
    assert report["attributes"]["means"]["max"] == 0


def test_compare__matches_splats_that_were_reordered_and_writes_pictures(scene: Path, tmp_path: Path) -> None:
    from gsplat_tools.formats import load

    with pytest.warns(LossyConversionWarning, match="clamped"):
        save(load(scene), tmp_path / "ordered.gspk", order="morton")
    report = json.loads(
        run(
            "compare", scene, tmp_path / "ordered.gspk", "--views", 1, "--size", "64x48", "--json", "--images", tmp_path / "png"
        ).stdout
    )

    assert report["attributes"]["means"]["max"] < 2e-3
    assert report["psnr_min"] > 35
    assert report["model"].startswith("unity")
    with Image.open(tmp_path / "png" / "view_0.png") as picture:
        assert picture.size[0] >= 3 * 64


def test_render__writes_a_picture_and_guards_it(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "scene.png"

    first = run("render", scene, "-o", target, "--views", 1, "--size", "64x48", "--no-progress")
    second = run("render", scene, "-o", target, "--views", 1, "--size", "64x48", "--no-progress")

    assert first.exit_code == 0
    with Image.open(target) as picture:
        assert np.asarray(picture.convert("RGB")).max() > 20
    assert second.exit_code == 1
    assert "--overwrite" in second.stderr


def test_inspect__names_what_it_does_not_know(tmp_path: Path) -> None:
    (tmp_path / "what.bin").write_bytes(b"GIF89a")

    result = run("info", tmp_path / "what.bin")

    assert result.exit_code == 1
    assert "no format claims this file" in result.stderr
    assert run("polish", tmp_path / "what.bin").exit_code == 2


def test_compare__goes_through_the_frames_of_sequences(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    for i in range(3):
        save(
            random_cloud(60, sh_degree=0, seed=4).replace(opacity_logits=np.full(60, 2.0 + i)), tmp_path / "frames" / f"{i}.ply"
        )

    report = json.loads(
        run("compare", tmp_path / "frames", tmp_path / "frames", "--views", 2, "--size", "48x32", "--json").stdout
    )

    assert [level["frame"] for level in report["frames"]] == [0, 1, 2]
    assert [view["name"] for view in report["views"]][:3] == ["frame 0 view 0", "frame 0 view 1", "frame 1 view 0"]
    assert report["identical"] is True


def test_inspect__says_that_a_file_is_not_there(tmp_path: Path) -> None:
    result = run(tmp_path / "no.ply")

    assert result.exit_code == 2
    assert "no.ply' does not exist" in result.stderr
