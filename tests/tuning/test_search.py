from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import ValidationError
from gsplat_tools.formats import load, save
from gsplat_tools.formats.registry import find_format
from gsplat_tools.ops.sampling import crop
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.auto import tune, without_what_never_changes
from gsplat_tools.tuning.measuring import Workbench
from gsplat_tools.tuning.search import Budget, Searcher, turnable

SMALL = {"views": 2, "size": (96, 64)}


@pytest.fixture(scope="module")
def scene() -> GaussianCloud:
    return crop(load(Path(__file__).parents[2] / "fixtures" / "garden.ply"), 600)


@pytest.fixture(scope="module")
def searcher(scene: GaussianCloud) -> Searcher:
    return Searcher(scene, find_format("spz"), **SMALL)


def test_search__holds_a_psnr_with_fewer_bytes_than_the_presets_that_hold_it(searcher: Searcher) -> None:
    presets = [searcher.whole.encode(dict(searcher.whole.record.presets[name])) for name in ("fast", "balanced", "best")]
    wanted = min(each.level for each in presets) - 1

    found = searcher.find(Budget(min_psnr=wanted))

    assert found.psnr_min >= wanted
    assert found.bytes < min(each.bytes for each in presets)
    assert {each["stream"] for each in found.decisions} == {"splats", "sh", "positions", "rotations", "container"}


def test_search__finds_what_save_writes_and_what_the_bench_sees(searcher: Searcher, scene: GaussianCloud, tmp_path) -> None:
    found = searcher.find(Budget(min_psnr=30))

    saved = save(scene, tmp_path / "scene.spz", **found.options)
    record = find_format("spz")
    errors = Workbench(scene, **SMALL).squared_errors([load(saved.path)], record.model)
    assert saved.bytes == found.bytes
    assert -10 * np.log10(max(errors)) == pytest.approx(found.psnr_min)
    assert found.psnr_min >= 30


def test_search__asks_more_bytes_for_more_dB_and_fits_into_bytes(searcher: Searcher) -> None:
    highest = searcher.whole.encode(dict(searcher.whole.record.presets["best"])).level
    coarse, fine = searcher.find(Budget(min_psnr=highest - 8)), searcher.find(Budget(min_psnr=highest - 1))

    between = searcher.find(Budget(max_bytes=(coarse.bytes + fine.bytes) // 2))

    assert coarse.bytes < between.bytes < fine.bytes
    assert between.psnr_min > coarse.psnr_min


def test_search__within_bytes_is_no_worse_than_a_preset_of_that_size(searcher: Searcher, monkeypatch) -> None:
    preset = searcher.whole.encode(dict(searcher.whole.record.presets["best"]))
    assert searcher.find(Budget(max_bytes=preset.bytes)).psnr_min >= preset.level

    monkeypatch.setattr("gsplat_tools.tuning.hunting.Hunt.run", _fail)
    found = searcher.find(Budget(max_bytes=preset.bytes))

    assert found.psnr_min >= preset.level
    assert found.bytes <= preset.bytes


def test_search__improves_on_what_it_found_by_what_lies_beside_it(scene: GaussianCloud, monkeypatch) -> None:
    monkeypatch.setattr("gsplat_tools.tuning.hunting.Hunt.preset", lambda *_: None)
    record = find_format("sog4d")
    with monkeypatch.context() as patch:
        patch.setattr("gsplat_tools.tuning.hunting._MOST_STEPS", 0)
        before = Searcher(scene, record, **SMALL).find(Budget(max_bytes=16_000))
    after = Searcher(scene, record, **SMALL).find(Budget(max_bytes=16_000))

    assert after.psnr_min > before.psnr_min
    assert after.bytes <= 16_000


def test_search__says_how_close_it_gets(searcher: Searcher) -> None:
    with pytest.raises(ValidationError, match=r"reaches 120 dB: the finest has \d+\.\d\d dB in the worst view at \d+ bytes"):
        searcher.find(Budget(min_psnr=120))
    with pytest.raises(ValidationError, match=r"fits into 100 bytes: the smallest has \d+ bytes"):
        searcher.find(Budget(max_bytes=100))
    with pytest.raises(ValidationError, match=r"30 dB within 100 bytes cannot be had: 30 dB take \d+ bytes"):
        searcher.find(Budget(min_psnr=30, max_bytes=100))


def test_search__leaves_pinned_options_and_splats_alone(scene: GaussianCloud) -> None:
    searcher = Searcher(scene, find_format("spz"), pinned={"sh1_bits": 7, "sh_degree": 1}, **SMALL)

    found = searcher.find(Budget(max_bytes_per_splat=16.0))

    assert not {"sh1_bits", "sh_degree", "sh_rest_bits", "prune_opacity"} & set(found.options)
    assert found.bytes <= 16 * len(scene)


def test_search__takes_sequences(scene: GaussianCloud) -> None:
    few = scene.take(slice(0, 200))
    sequence = GaussianSequence(
        lambda i: few.replace(means=few.means + np.float32(0.01 * i)), num_splats=200, sh_degree=3, num_frames=4
    )

    found = Searcher(sequence, find_format("sog4d"), views=1, size=(64, 48), pinned={"sh_degree": 0}).find(Budget(min_psnr=30))

    assert found.psnr_min >= 30
    assert "keep_tolerance" in found.options


def test_turnable__offers_no_band_that_is_zero_everywhere(scene: GaussianCloud) -> None:
    dark = scene.replace(shN=np.zeros_like(scene.shN))
    linear = scene.shN.copy()
    linear[:, 3:] = 0

    assert not {"sh_degree", "sh_palette_size"} & set(turnable(dark, find_format("sog4d"), {}))
    assert turnable(scene.replace(shN=linear), find_format("sog4d"), {})["sh_degree"].values == (0, 1)


def test_auto__drops_motion_that_moves_nothing_and_frames_that_are_the_same(scene: GaussianCloud) -> None:
    count = len(scene)
    still = scene.replace(
        velocities=np.zeros((count, 3), np.float32), times=np.zeros(count, np.float32), durations=np.ones(count, np.float32)
    )
    late = still.replace(times=np.full(count, 0.5, np.float32))
    frames = GaussianSequence(lambda _: scene, num_splats=count, sh_degree=3, num_frames=3)

    assert not without_what_never_changes(still)[0].has_motion
    assert without_what_never_changes(late) == (late, [])
    assert len(without_what_never_changes(frames)[0]) == 1


def test_auto__holds_choices_that_are_no_knobs_against_what_else_there_is(scene: GaussianCloud) -> None:
    count = len(scene)
    means, logits = scene.means.copy(), scene.opacity_logits.copy()
    center = np.median(means, axis=0)
    means[0], logits[0] = center + 40 * (means.max(axis=0) - center), -7.0
    still = scene.replace(
        means=means,
        opacity_logits=logits,
        velocities=np.zeros((count, 3), np.float32),
        times=np.zeros(count, np.float32),
        durations=np.ones(count, np.float32),
    )
    tuned = tune(still, find_format("compressed-ply"), preset="balanced", options={}, **SMALL)
    decisions = {each["option"]: each for each in tuned.decisions}

    assert decisions["outliers"]["value"] == "drop" == tuned.options["outliers"]
    assert decisions["outliers"]["bytes_saved"] > 0 >= decisions["outliers"]["db_lost"] - 0.01
    kept = tune(still, find_format("compressed-ply"), preset="balanced", options={"outliers": "keep"}, **SMALL)
    assert "outliers" not in {each["option"] for each in kept.decisions}

    moving = tune(still, find_format("ply"), preset="balanced", options={}, **SMALL)
    assert next(each for each in moving.decisions if each["option"] == "motion")["bytes_saved"] >= count * 5 * 4


def test_preset__is_taken_a_step_coarser_where_the_search_finds_nothing_smaller(scene: GaussianCloud, monkeypatch) -> None:
    searcher = Searcher(scene, find_format("spz"), **SMALL)
    reached = searcher.whole.encode({})
    monkeypatch.setattr("gsplat_tools.tuning.hunting.Hunt.run", _fail)
    found = searcher.find(Budget(min_psnr=reached.level - 0.5))

    assert found.bytes < reached.bytes
    assert found.psnr_min >= reached.level - 0.5
    assert found.decisions[0]["stream"].startswith("preset")


def test_search__makes_splats_coarser_where_predictions_leave_dB_to_spare(scene: GaussianCloud, monkeypatch) -> None:
    small = scene.replace(log_scales=scene.log_scales - np.float32(1.5))
    searcher = Searcher(small, find_format("splat"), **SMALL)
    finest = searcher.whole.encode({"rotation": "best"})
    monkeypatch.setattr("gsplat_tools.tuning.hunting.Hunt._propose", lambda hunt, _margin: hunt._rates.settle())
    monkeypatch.setattr("gsplat_tools.tuning.hunting.Hunt.preset", lambda *_: None)

    found = searcher.find(Budget(min_psnr=finest.level - 3))

    assert finest.level - 3 <= found.psnr_min < finest.level
    assert found.bytes < finest.bytes


def _fail(*_: object) -> None:
    raise ValidationError("nothing")
