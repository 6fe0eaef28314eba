"""Far splats that hardly show: which they are, and that writers count them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_tools import GaussianCloud, save
from gsplat_tools.ops.outliers import find_outliers

OUTLIERS = [3, 500]


@pytest.fixture(scope="module")
def stretched() -> GaussianCloud:
    """A unit cube of splats of a fifth of a percent of its width, and two faint ones ten cubes away."""
    rng = np.random.default_rng(7)
    count = 1000
    means = rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32)
    means[OUTLIERS] = [[10, 0, 0], [0, -8, 0]]
    logits = np.full(count, 3, np.float32)
    logits[OUTLIERS] = -4
    return GaussianCloud(
        means=means,
        log_scales=np.full((count, 3), np.log(0.002), np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=logits,
        sh0=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
    )


def _with(cloud: GaussianCloud, **rows: float) -> GaussianCloud:
    """Return the cloud with other values of the far splats."""
    changes = {}
    for name, value in rows.items():
        changes[name] = cloud.arrays()[name].copy()
        changes[name][OUTLIERS] = value
    return cloud.replace(**changes)


def test_find_outliers__finds_faint_splats_that_stretch_the_box(stretched: GaussianCloud) -> None:
    assert np.flatnonzero(find_outliers(stretched)).tolist() == OUTLIERS


def test_find_outliers__leaves_what_shows_and_what_saves_nothing(stretched: GaussianCloud) -> None:
    assert not find_outliers(_with(stretched, log_scales=np.log(2.0))).any()  # a veil over the picture
    assert not find_outliers(_with(stretched, opacity_logits=3, log_scales=np.log(0.05))).any()  # opaque and large
    held = stretched.means.copy()
    held[:2] = [[12, 12, 12], [-12, -12, -12]]  # opaque, so that the box stays
    logits, scales = stretched.opacity_logits.copy(), stretched.log_scales.copy()
    logits[:2], scales[:2] = 6, np.log(1.0)
    assert not find_outliers(stretched.replace(means=held, opacity_logits=logits, log_scales=scales)).any()
    near = stretched.means.copy()
    near[OUTLIERS] = 0
    assert not find_outliers(stretched.replace(means=near)).any()
    assert not find_outliers(stretched.take(slice(0, 0))).any()


def test_save__drops_and_counts_them_with_a_tolerance_or_when_told_and_not_otherwise(
    stretched: GaussianCloud, tmp_path: Path
) -> None:
    def dropped(**options: object) -> dict[str, int]:
        return save(stretched, tmp_path / "a.sog", overwrite=True, **options).dropped

    assert dropped() == {}
    assert dropped(visual_tolerance=0.05) == {"outliers": 2}
    assert dropped(visual_tolerance=0.05, outliers="keep", prune_faint=0) == {}
    assert dropped(outliers="drop") == {"outliers": 2}
    assert dropped(outliers="drop", prune_opacity=0.1) == {"pruned-opacity": 2}
    assert save(stretched, tmp_path / "a.spz", outliers="drop").dropped == {"outliers": 2}  # a writer that streams
