"""4D assets through the commands."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from gsplat_tools.cli.convert import main as convert_command
from gsplat_tools.cli.inspect import main as inspect_command
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.ops.motion import at_time, visible_splats
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud


def run(command: object, *arguments: object) -> Result:
    return CliRunner().invoke(command, [str(argument) for argument in arguments])  # type: ignore[arg-type]


@pytest.fixture
def asset(tmp_path: Path) -> tuple[Path, GaussianCloud]:
    """A PLY whose splats move; ten show between frames only."""
    cloud = random_cloud(150, sh_degree=1, motion=True)
    assert cloud.durations is not None
    cloud = cloud.replace(
        opacity_logits=np.abs(cloud.opacity_logits),
        durations=np.where(np.arange(150) < 10, np.float32(1e-5), np.maximum(cloud.durations, np.float32(0.3))),
        times=np.where(np.arange(150) < 10, np.float32(0.123), cloud.times),
    )
    save(cloud, tmp_path / "asset.ply")
    return tmp_path / "asset.ply", cloud


def quick(*arguments: object) -> dict[str, object]:
    result = run(convert_command, *arguments, "--json", "--views", 0, "--no-progress")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def read(path: Path) -> GaussianCloud | GaussianSequence:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        return load(path)


def test_frames__bake_to_keyframes_and_count_what_never_shows(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    path, cloud = asset

    report = quick(path, tmp_path / "baked.sog4d", "--frames", 5, "--order", "none")

    assert report["frames"] == 5
    assert report["dropped"] == {"never-visible": 10}
    assert report["splats"] == 140
    sequence = read(tmp_path / "baked.sog4d")
    assert isinstance(sequence, GaussianSequence)
    kept = cloud.take(visible_splats(cloud, np.linspace(0, 1, 5)))
    for frame_id, t in enumerate(np.linspace(0, 1, 5)):
        expected = at_time(kept, t)
        assert np.abs(sequence.frame(frame_id).means - expected.means).max() < 1e-3
        hidden = np.isneginf(expected.opacity_logits)
        assert np.isneginf(sequence.frame(frame_id).opacity_logits[hidden]).all()


def test_frames__may_be_chosen_and_come_with_explicit_times(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    report = quick(asset[0], tmp_path / "auto.sog4d", "--frames", "auto", "--tolerance", 0.1)

    options = report["options"]
    assert isinstance(options, dict)
    assert options["baked_frames"] == report["frames"]
    assert options["baking_error"] <= 0.1
    sequence = read(tmp_path / "auto.sog4d")
    assert isinstance(sequence, GaussianSequence)
    assert not sequence.is_uniform
    assert len(sequence) == report["frames"]


def test_frame_times__of_an_asset_say_when_to_bake(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    quick(asset[0], tmp_path / "baked.sog4d", "--frame-times", "0,0.125,1")

    sequence = read(tmp_path / "baked.sog4d")
    assert isinstance(sequence, GaussianSequence)
    assert sequence.frame_times.tolist() == [0, 0.125, 1]


def test_time__takes_a_moment_of_an_asset(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    path, cloud = asset

    report = quick(path, tmp_path / "still.ply", "--time", 0.5)

    still = read(tmp_path / "still.ply")
    assert isinstance(still, GaussianCloud)
    shown = visible_splats(cloud, [0.5])
    assert report["dropped"] == {"not-visible-then": int(np.count_nonzero(~shown))}
    assert np.array_equal(still.means, at_time(cloud.take(shown), 0.5).means)
    assert not still.has_motion


def test_sequence__is_fitted_where_the_target_is_4d(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    path, cloud = asset
    quick(path, tmp_path / "baked.sog4d", "--frames", 9, "--order", "none")

    report = quick(tmp_path / "baked.sog4d", tmp_path / "back.splat4d", "--fit-report", tmp_path / "fit")

    assert report["frames"] == 1
    words = report["warnings"]
    assert isinstance(words, list)
    assert [entry["code"] for entry in words if entry["code"] == "fitted-motion"]
    back = read(tmp_path / "back.splat4d")
    assert isinstance(back, GaussianCloud)
    assert back.velocities is not None
    kept = cloud.take(visible_splats(cloud, np.linspace(0, 1, 9)))
    with np.load(tmp_path / "fit" / "motion_residuals.npz") as stored:
        residuals = dict(stored)
    told = residuals["visible_frames"] >= 3
    assert np.abs(back.velocities - kept.velocities)[told].max() < 0.01
    assert residuals["position_rms"].max() < 1e-3
    with Image.open(tmp_path / "fit" / "motion_residuals.png") as picture:
        assert picture.size[0] > 1000


def test_sequence__is_fitted_for_other_targets_when_asked(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    quick(asset[0], tmp_path / "baked.sog4d", "--frames", 5)

    refused = run(convert_command, tmp_path / "baked.sog4d", tmp_path / "out.ply")
    quick(tmp_path / "baked.sog4d", tmp_path / "out.ply", "--fit-motion", "gaussian")

    assert refused.exit_code == 1
    fitted = read(tmp_path / "out.ply")
    assert isinstance(fitted, GaussianCloud)
    assert fitted.time_model == "gaussian"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("asset.ply", "x.gspk", "--frames", "3"), "holds no sequence"),
        (("still.ply", "x.sog4d", "--frames", "3"), "has no motion"),
        (("still.ply", "x.ply", "--time", "0.5"), "has no motion"),
        (("asset.ply", "x.splat4d", "--fit-motion", "window"), "not a sequence"),
        (("asset.ply", "x.sog4d", "--time", "0.5", "--frame", "1"), "not both"),
        (("asset.ply", "x.sog4d", "--frames", "3", "--frame-times", "0,1"), "give one of them"),
    ],
)
def test_convert__refuses_what_makes_no_sense_in_one_line(
    arguments: tuple[str, ...], message: str, asset: tuple[Path, GaussianCloud], tmp_path: Path
) -> None:
    save(random_cloud(5, sh_degree=0), tmp_path / "still.ply")

    result = run(convert_command, tmp_path / arguments[0], tmp_path / arguments[1], *arguments[2:], "--no-progress")

    assert result.exit_code == 1
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / arguments[1]).exists()


@pytest.mark.parametrize("value", ["0", "-3", "many", "1.5"])
def test_frames__are_a_number_or_auto(value: str, asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    assert run(convert_command, asset[0], tmp_path / "x.sog4d", "--frames", value).exit_code == 2


def test_frames__count_invalid_splats_apart_from_those_that_never_show(
    asset: tuple[Path, GaussianCloud], tmp_path: Path
) -> None:
    path, cloud = asset
    assert cloud.times is not None
    times, velocities = cloud.times.copy(), np.array(cloud.velocities)
    times[50], velocities[51, 0] = np.nan, np.inf
    save_raw = cloud.replace(times=times, velocities=velocities)
    from gsplat_tools.formats.registry import FORMATS

    with path.open("wb") as stream:
        FORMATS["ply"].write(save_raw, stream, FORMATS["ply"].write_options())  # type: ignore[misc]

    report = quick(path, tmp_path / "baked.sog4d", "--frames", 5)
    strict = run(convert_command, path, tmp_path / "strict.sog4d", "--frames", 5, "--strict", "--no-progress")

    assert report["dropped"] == {"velocities-inf": 1, "times-nan": 1, "never-visible": 10}
    assert strict.exit_code == 1
    assert not (tmp_path / "strict.sog4d").exists()


def test_splat4d_version__is_apart_from_that_of_other_formats(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    quick(asset[0], tmp_path / "one.splat4d", "--splat4d-version", 1)
    wrong = run(convert_command, asset[0], tmp_path / "two.splat4d", "--sog4d-version", 1)

    assert (tmp_path / "one.splat4d").stat().st_size == 150 * 64
    assert wrong.exit_code == 2


def test_render__over_time_makes_a_contact_sheet_and_an_animation(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    common = ("--size", "40x30", "--no-progress")
    sheet = run(inspect_command, "render", asset[0], "-o", tmp_path / "a.png", "--times", "0,0.5,1", "--views", 2, *common)
    moving = run(
        inspect_command, "render", asset[0], "--animate", tmp_path / "a.webp", "--times", "0,0.2,0.4,0.6", "--fps", 20, *common
    )

    assert sheet.exit_code == 0, sheet.output
    assert moving.exit_code == 0, moving.output
    with Image.open(tmp_path / "a.png") as picture:
        width, height = picture.size
    assert 3 * 40 <= width < 4 * 40
    assert 2 * 30 <= height < 3 * 30
    with Image.open(tmp_path / "a.webp") as animation:
        assert (animation.n_frames, animation.size) == (4, (40, 30))  # type: ignore[attr-defined]
        animation.load()
        assert animation.info["duration"] == 50


def test_render__needs_something_to_write_and_one_kind_of_time(asset: tuple[Path, GaussianCloud], tmp_path: Path) -> None:
    assert run(inspect_command, "render", asset[0]).exit_code == 2
    both = run(inspect_command, "render", asset[0], "-o", tmp_path / "a.png", "--t", 0.5, "--times", "0,1")
    assert both.exit_code == 2


def test_info__shows_both_boxes(asset: tuple[Path, GaussianCloud]) -> None:
    facts = json.loads(run(inspect_command, "info", asset[0], "--json").stdout)

    for side, sign in (("min", 1), ("max", -1)):
        assert all(sign * (b - m) > 0 for b, m in zip(facts["bounds"][side], facts["motion_bounds"][side], strict=True))
