import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

from gsplat_tools.cli import _options as options
from gsplat_tools.cli.convert import main
from gsplat_tools.formats import load, save
from tests.clouds import random_cloud


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    save(random_cloud(300, sh_degree=2), path)
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_convert__prints_one_json_object_with_the_fixed_names(scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "out.gspk", "--json", "--quiet")

    report = json.loads(result.stdout)
    assert result.exit_code == 0
    assert {"source", "target", "splats", "sh_degree", "frames", "dropped", "warnings", "seconds", "validation"} <= set(report)
    assert set(report["target"]) == {"path", "format", "bytes"}
    assert set(report["seconds"]) == {"read", "encode", "write", "validate"}
    assert report["target"]["bytes"] == (tmp_path / "out.gspk").stat().st_size
    assert report["splats"] == 300
    assert report["validation"]["passed"] is True
    assert {"psnr_min", "psnr_mean", "ssim_mean", "max_abs", "attributes"} <= set(report["validation"])
    assert result.stderr == ""


def test_convert__says_in_words_what_it_did(scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "out.gspk")

    assert result.exit_code == 0
    assert result.stdout == ""
    assert "300 splats, SH degree 2" in result.stderr
    assert "validation passed" in result.stderr


def test_convert__keeps_a_target_that_is_there(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.gspk"
    target.write_bytes(b"precious")

    result = run(scene, target)

    assert result.exit_code == 1
    assert result.stderr.splitlines() == [
        f"error: {target}: the target exists; use --overwrite (library: overwrite=True) to replace it"
    ]
    assert target.read_bytes() == b"precious"
    assert run(scene, target, "--overwrite").exit_code == 0


def test_convert__leaves_the_target_when_it_renders_below_min_psnr(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.gspk"
    target.write_bytes(b"precious")

    result = run(scene, target, "--overwrite", "--min-psnr", 150)

    assert result.exit_code == 1
    assert "below --min-psnr 150" in result.stderr
    assert target.read_bytes() == b"precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.gspk", "scene.ply"]


def test_convert__writes_several_formats_into_a_folder(scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "out", "--to", "spark", "--to", "uncompressed", "--to", "sog4d", "--json", "--no-validate")

    reports = json.loads(result.stdout)["conversions"]
    assert [r["target"]["format"] for r in reports] == ["spark", "uncompressed", "sog4d"]
    assert all(Path(r["target"]["path"]).is_file() for r in reports)
    assert len({r["target"]["path"] for r in reports}) == 3
    assert all(r["validation"] is None for r in reports)


def test_convert__drops_and_counts_invalid_splats_or_refuses_them(tmp_path: Path) -> None:
    cloud = random_cloud(10, sh_degree=0)
    means = cloud.means.copy()
    means[2] = np.nan
    quats = cloud.quats.copy()
    quats[[2, 5]] = 0
    save_raw = tmp_path / "bad.ply"
    save(cloud, save_raw)
    broken = np.fromfile(save_raw, np.uint8)
    header = bytes(broken).index(b"end_header\n") + len(b"end_header\n")
    rows = broken[header:].view(np.float32).reshape(10, -1)
    rows[:, :3], rows[:, -4:] = means, quats
    broken.tofile(save_raw)

    result = run(save_raw, tmp_path / "out.ply", "--json")
    strict = run(save_raw, tmp_path / "strict.ply", "--strict")

    report = json.loads(result.stdout)
    assert report["dropped"] == {"means-nan": 1, "quats-zero": 1}
    assert report["splats"] == 8
    assert [w["code"] for w in report["warnings"]] == ["non-finite"]
    assert strict.exit_code == 1
    assert len(strict.stderr.splitlines()) == 1
    assert "means-nan 1" in strict.stderr
    assert not (tmp_path / "strict.ply").exists()


def test_convert__says_what_a_target_cannot_hold(tmp_path: Path) -> None:
    source = tmp_path / "moving.ply"
    save(random_cloud(20, sh_degree=4, motion=True), source)

    report = json.loads(run(source, tmp_path / "out.sog4d", "--json", "--quiet").stdout)
    strict = run(source, tmp_path / "strict.sog4d", "--strict")

    assert {w["code"] for w in report["warnings"]} >= {"dropped-motion", "dropped-sh-bands"}
    assert report["sh_degree"] == 3
    assert strict.exit_code == 1
    assert "--strict" in strict.stderr


def test_convert__prunes_faint_splats_on_request(scene: Path, tmp_path: Path) -> None:
    opacities = 1 / (1 + np.exp(-load(scene).opacity_logits.astype(np.float64)))  # type: ignore[union-attr]

    report = json.loads(run(scene, tmp_path / "a.ply", "--json", "--prune-opacity", 0.5, "--no-validate").stdout)
    none = json.loads(run(scene, tmp_path / "b.ply", "--json", "--prune-opacity", 0, "--no-validate").stdout)

    assert report["dropped"] == {"pruned-opacity": int((opacities < 0.5).sum())}
    assert none["dropped"] == {}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--spark-encoding", "fit", "--to", "ply"], "--spark-encoding does not apply to ply"),
        (["--sh-degree", "7"], "is not 0 to 4 or auto"),
        (["--to", "nonsense"], "nonsense"),
        (["--min-psnr", "30", "--no-validate"], "--min-psnr needs --validate"),
    ],
)
def test_convert__treats_wrong_words_as_usage_errors(scene: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    result = run(scene, tmp_path / "out.ply", *arguments)

    assert result.exit_code == 2
    assert words in result.stderr
    assert not (tmp_path / "out.ply").exists()


def test_convert__names_a_missing_source(tmp_path: Path) -> None:
    result = run(tmp_path / "no.ply", tmp_path / "out.gspk")

    assert result.exit_code == 2
    assert "does not exist" in result.stderr


def test_convert__names_file_field_and_offset_of_damage(scene: Path, tmp_path: Path) -> None:
    scene.write_bytes(scene.read_bytes()[:-10])

    result = run(scene, tmp_path / "out.gspk")

    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1
    assert str(scene) in result.stderr
    assert "bytes" in result.stderr


def test_convert__assumes_axes_for_unity_and_says_so(scene: Path, tmp_path: Path) -> None:
    assumed = json.loads(run(scene, tmp_path / "a.gscc", "--json", "--quiet").stdout)
    stated = json.loads(run(scene, tmp_path / "b.gscc", "--json", "--quiet", "--source-coordinates", "RUB").stdout)

    assert "assumed-coordinates" in {w["code"] for w in assumed["warnings"]}
    assert "assumed-coordinates" not in {w["code"] for w in stated["warnings"]}
    assert (tmp_path / "a.gscc").read_bytes() == (tmp_path / "b.gscc").read_bytes()


def test_convert__stores_an_origin_where_that_gains_precision(tmp_path: Path) -> None:
    far = random_cloud(200, sh_degree=0)
    far = far.replace(means=far.means + np.float32(3000))
    save(far, tmp_path / "far.ply")

    run(tmp_path / "far.ply", tmp_path / "auto.gspk", "--quiet")
    run(tmp_path / "far.ply", tmp_path / "off.gspk", "--quiet", "--recenter", "off")

    auto, off = load(tmp_path / "auto.gspk"), load(tmp_path / "off.gspk")
    world = auto.origin + auto.means  # type: ignore[union-attr]
    assert np.abs(world - far.means).max() < 4e-3
    assert np.abs(off.means - far.means).max() > 0.5  # type: ignore[union-attr]


def test_convert__writes_every_frame_of_a_sequence_into_a_folder(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    clouds = [random_cloud(50, sh_degree=1, seed=1).replace(opacity_logits=np.full(50, float(i))) for i in range(3)]
    for i, cloud in enumerate(clouds):
        save(cloud, tmp_path / "frames" / f"f{i}.ply")
    (tmp_path / "back").mkdir()

    bundled = run(tmp_path / "frames", tmp_path / "s.sog4d", "--quiet", "--order", "none")
    unbundled = run(tmp_path / "s.sog4d", tmp_path / "back", "--to", "ply", "--json", "--quiet")

    assert bundled.exit_code == 0
    assert [r["splats"] for r in json.loads(unbundled.stdout)["conversions"]] == [50, 50, 50]
    back = [load(tmp_path / "back" / f"s_{i:05d}.ply") for i in range(3)]
    for cloud, read in zip(clouds, back, strict=True):
        assert np.abs(cloud.opacity_logits - read.opacity_logits).max() < 0.05  # type: ignore[union-attr]


def test_convert__takes_zero_for_an_answer(scene: Path, tmp_path: Path) -> None:
    report = json.loads(run(scene, tmp_path / "a.gspk", "--sh-degree", 0, "--json", "--quiet").stdout)

    assert report["sh_degree"] == 0


@pytest.mark.parametrize("target", ["gscc", "sog4d", "splat4d", "spz", "sog", "splat"])
def test_convert__recenters_for_targets_without_an_origin_and_says_where_it_was(target: str, tmp_path: Path) -> None:
    far = random_cloud(60, sh_degree=0)
    save(far.replace(means=far.means + np.float32(500), coordinate_system="RUF"), tmp_path / "far.ply")

    result = run(tmp_path / "far.ply", tmp_path / f"out.{target}", "--recenter", "on", "--json", "--quiet")

    report = json.loads(result.stdout)
    assert report["validation"]["passed"] is True
    assert "origin-lost" in {warning["code"] for warning in report["warnings"]}
    assert report["validation"]["attributes"]["means"]["max"] < 0.01


def test_convert__refuses_axes_that_do_not_exist(scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "a.gspk", "--source-coordinates", "QQQ")

    assert result.exit_code == 2
    assert "is not three axis letters" in result.stderr


@pytest.mark.parametrize("arguments", [["--prune-opacity", "nan"], ["--min-psnr", "nan"], ["--prune-opacity", "1.5"]])
def test_convert__refuses_numbers_that_are_none(scene: Path, tmp_path: Path, arguments: list[str]) -> None:
    result = run(scene, tmp_path / "a.gspk", *arguments)

    assert result.exit_code == 2
    assert "is not a number" in result.stderr


def test_convert__prunes_under_strict(scene: Path, tmp_path: Path) -> None:
    assert run(scene, tmp_path / "a.ply", "--strict", "--prune-opacity", 0.5, "--quiet").exit_code == 0


def test_convert__makes_no_folder_for_a_source_that_is_not_there(tmp_path: Path) -> None:
    result = run(tmp_path / "no.ply", tmp_path / "out", "--to", "spark", "--to", "ply")

    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_convert__that_is_ended_removes_its_temporary_file(tmp_path: Path) -> None:
    save(random_cloud(30_000, sh_degree=3), tmp_path / "scene.ply")
    (tmp_path / "out").mkdir()
    command = [str(Path(sys.executable).parent / "gsplat-convert"), "scene.ply", "out/scene.sog4d", "--preset", "best"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not any((tmp_path / "out").iterdir()) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)

    process.send_signal(signal.SIGTERM)

    assert process.wait(60) == 128 + signal.SIGTERM
    assert not any((tmp_path / "out").iterdir())


def test_a_second_signal__does_not_disturb_what_is_done_at_the_very_end() -> None:
    text = """
import atexit, os, signal
from gsplat_tools.cli._errors import reports_errors

@atexit.register
def end():
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGHUP)
    print("cleaned")

reports_errors(lambda: os.kill(os.getpid(), signal.SIGTERM))()
"""
    ended = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)

    assert (ended.returncode, ended.stdout) == (128 + signal.SIGTERM, "cleaned\n")
    assert ended.stderr == "ended by SIGTERM; the target is as it was\n"


def test_a_signal_while_a_finalizer_runs__is_not_forgotten() -> None:
    text = """
import os, signal, time
from gsplat_tools.cli._errors import reports_errors

class Finalized:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)

def command():
    Finalized()
    time.sleep(30)

reports_errors(command)()
"""
    ended = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)

    assert ended.returncode == 128 + signal.SIGTERM
    assert ended.stderr == "ended by SIGTERM; the target is as it was\n"


def test_dry_run__estimates_and_writes_nothing(tmp_path: Path) -> None:
    source = tmp_path / "scene.ply"
    save(random_cloud(200, sh_degree=1), source)

    result = run(source, tmp_path / "out.gspk", "--dry-run", "--json")

    report = json.loads(result.stdout)
    assert result.exit_code == 0
    assert not (tmp_path / "out.gspk").exists()
    assert report["exact"]
    assert report["target"]["format"] == "spark"
    run(source, tmp_path / "out.gspk")
    assert (tmp_path / "out.gspk").stat().st_size == report["bytes"]


def test_help__has_every_option_once_under_a_heading() -> None:
    text = run("--help").stdout

    for heading in ("Target:", "Budget:", "Splats:", "Sequences and motion:", "Check:", "Single formats:", "Running:"):
        assert text.count(f"\n{heading}\n") == 1
    for option in main.params:
        if option.param_type_name == "option" and not getattr(option, "hidden", False):
            assert (
                text.count(f"\n  {option.opts[-1]} ")
                + text.count(f", {option.opts[-1]} ")
                + text.count(f"\n  {option.opts[0]} ")
                >= 1
            )
    assert text.count("--visual-tolerance") == 1


def test_option_types__are_those_of_click_before_its_types_took_parameters() -> None:
    own = [each for each in vars(options).values() if getattr(each, "__module__", None) == options.__name__]
    types = [each for each in own if isinstance(each, type) and issubclass(each, click.ParamType)]

    assert len(types) > 8
    assert [each.__name__ for each in types if "__orig_bases__" in vars(each)] == []


def test_position_bits__are_8_or_16(scene: Path, tmp_path: Path) -> None:
    result = run(scene, tmp_path / "a.vis", "--to", "visionary-i8", "--position-bits", 9)

    assert result.exit_code == 2
    assert "'9' is not one of '8', '16'" in result.stderr
