"""Visionary's precisions one after the other, and int8 ranges by rendering."""

from __future__ import annotations

import numpy as np

from gsplat_tools.tuning.precision import change_precision, choose_clip
from tests.clouds import random_cloud


def test_change_precision__holds_every_step_against_its_bounds() -> None:
    steps = change_precision(random_cloud(400, sh_degree=4), ("f32", "f16", "i8", "f32"))

    assert [step.exceeded for step in steps] == [[], [], [], []]
    assert [round(step.bytes_per_splat) for step in steps] == [232, 116, 63, 232]
    assert steps[0].attributes["sh0"]["max"] == 0
    assert (steps[1].attributes["covariances"]["max"] or 0) > 1e-4 > (steps[0].attributes["covariances"]["max"] or 0)
    assert any("thinnest axis" in text for text in steps[1].warnings)
    assert len(steps[-1].cloud) == 400
    assert steps[-1].cloud.sh_degree == 3


def test_choose_clip__takes_what_renders_best() -> None:
    cloud = random_cloud(300, sh_degree=0)
    # Colors that matter lie far out: clipping a twentieth of them shows.
    cloud = cloud.replace(sh0=np.where(np.arange(300)[:, None] % 25 == 0, np.float32(2.5), cloud.sh0 * np.float32(0.1)))

    choice = choose_clip(cloud, candidates=(0.05, 0.0), views=1, size=(160, 90))

    assert choice.clip == 0.0
    assert (choice.psnr[0.0] or 0) > (choice.psnr[0.05] or 0) + 3
