"""Splats that hardly show: how much light each can add, and that writers leave out and count those below a threshold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_tools import GaussianCloud, load, save
from gsplat_tools.chunks import as_chunks
from gsplat_tools.convert import convert
from gsplat_tools.errors import CapabilityError
from gsplat_tools.ops import visibility
from gsplat_tools.ops.filtering import prune_faint
from gsplat_tools.ops.visibility import Viewpoint, faint_pixels, lit_pixels, use_viewpoint, viewpoint, viewpoint_of
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud

FAINT, SMALL = slice(0, 30), slice(30, 50)


@pytest.fixture(scope="module")
def scene() -> GaussianCloud:
    """600 opaque splats, of which 30 are made nearly transparent and 20 so small that the low-pass is all that shows."""
    cloud = random_cloud(600, sh_degree=0)
    logits, log_scales = np.full(600, 3, np.float32), np.full((600, 3), np.log(0.05), np.float32)
    logits[FAINT] = -9
    log_scales[SMALL] = -9.9
    return cloud.replace(opacity_logits=logits, log_scales=log_scales)


def test_lit_pixels__is_the_light_of_the_trace_summed_over_pixels() -> None:
    x, y = np.meshgrid(np.arange(-60, 60.25, 0.25), np.arange(-60, 60.25, 0.25))
    a, b, opacity = 9.0, 4.0, 0.6
    cloud = random_cloud(1, sh_degree=0).replace(
        means=np.zeros((1, 3), np.float32),
        log_scales=np.log(np.sqrt(np.square([[a, b, b]]) - visibility.LOW_PASS)).astype(np.float32),
        opacity_logits=np.array([np.log(opacity / (1 - opacity))], np.float32),
    )

    trace = opacity * np.exp(-(np.square(x / a) + np.square(y / b)) / 2)
    assert lit_pixels(cloud, Viewpoint((0.0, 0.0, 0.0), 500.0))[0] == pytest.approx(np.square(trace).sum() / 16, rel=1e-4)


def test_lit_pixels__takes_moving_splats_as_near_as_the_bulk_is() -> None:
    view = Viewpoint((0.0, 0.0, 0.0), 1.0)
    far = random_cloud(1, sh_degree=0).replace(means=np.array([[10, 0, 0]], np.float32))
    moving = far.replace(
        velocities=np.ones((1, 3), np.float32), times=np.zeros(1, np.float32), durations=np.ones(1, np.float32)
    )

    near = far.replace(means=np.zeros((1, 3), np.float32))
    assert lit_pixels(far, view)[0] < lit_pixels(near, view)[0]
    assert lit_pixels(moving, view)[0] == lit_pixels(near, view)[0]


@pytest.mark.parametrize("size", [7, 64, 600])
def test_viewpoint__is_the_same_of_pieces(scene: GaussianCloud, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "_MAX_SAMPLES", 100)

    assert viewpoint_of(as_chunks(scene, size), len(scene)) == viewpoint(scene)


def test_viewpoint__is_that_of_the_whole_where_a_part_stands_for_it(scene: GaussianCloud) -> None:
    part, whole = scene.take(slice(0, 50)), viewpoint(scene)

    with use_viewpoint(whole), use_viewpoint(None):
        assert viewpoint(part) == whole
    assert viewpoint(part) != whole


def test_viewpoint__of_nothing_is_somewhere() -> None:
    assert viewpoint_of([], 0).radius > 0


def test_faint_pixels__grow_with_the_tolerance_and_are_none_without() -> None:
    assert faint_pixels(0) == 0
    assert faint_pixels(0.2) == pytest.approx(4 * faint_pixels(0.1)) == pytest.approx(80 * np.pi / 2 * 0.04 / 9)


def test_prune_faint__drops_what_is_below_and_keeps_the_cloud_where_nothing_is(scene: GaussianCloud) -> None:
    view = viewpoint(scene)

    kept, count = prune_faint(scene, 1e-3, view)

    assert (len(kept), count) == (570, 30)
    assert prune_faint(scene, 1e-12, view) == (scene, 0)


@pytest.mark.parametrize("name", ["a.sog", "a.spz", "a.ply"])
def test_writers__leave_out_and_count_faint_splats(scene: GaussianCloud, tmp_path: Path, name: str) -> None:
    def dropped(source: object, **options: object) -> dict[str, int]:
        return save(source, tmp_path / name, overwrite=True, **options).dropped  # type: ignore[arg-type] # a cloud or chunks

    assert dropped(scene) == {}
    for source in (scene, as_chunks(scene, 100)):
        assert dropped(source, prune_faint=1e-3) == {"pruned-faint": 30}
        assert dropped(source, prune_faint=10) == {"pruned-faint": 50}
        assert dropped(source, prune_faint=10, prune_opacity=0.01) == {"pruned-opacity": 30, "pruned-faint": 20}
    assert len(load(tmp_path / name)) == 550
    with pytest.raises(CapabilityError, match=r"are left to write|needs at least one"):
        save(scene, tmp_path / "none.sog", prune_faint=1e12)
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(CapabilityError, match="prune_faint"):
            dropped(scene, prune_faint=wrong)


def test_tolerance__leaves_out_what_its_bits_are_not_worth_unless_told_otherwise(scene: GaussianCloud, tmp_path: Path) -> None:
    def dropped(**options: object) -> dict[str, int]:
        return save(scene, tmp_path / "a.sog4d", overwrite=True, **options).dropped

    assert dropped(visual_tolerance=0.02) == {"pruned-faint": 30}
    assert dropped(visual_tolerance=0.02, prune_faint=0) == {}


def test_sequences__leave_out_only_what_is_faint_in_every_frame(scene: GaussianCloud, tmp_path: Path) -> None:
    bright = scene.opacity_logits.copy()
    bright[:10] = 3  # these show in the second frame
    frames = [scene, scene.replace(opacity_logits=bright)]
    sequence = GaussianSequence(frames.__getitem__, num_splats=600, sh_degree=0, num_frames=2)

    report = save(sequence, tmp_path / "a.sog4d", prune_faint=1e-3)

    assert (report.dropped, report.splats) == ({"pruned-faint": 20}, 580)


def test_conversion__says_how_many_are_left_out(scene: GaussianCloud, tmp_path: Path) -> None:
    save(scene, tmp_path / "a.ply")

    report = convert([tmp_path / "a.ply"], tmp_path / "a.splat", prune_faint=1e-3)

    assert report.dropped == {"pruned-faint": 30}
    assert report.splats == 570
    assert report.validation is not None
