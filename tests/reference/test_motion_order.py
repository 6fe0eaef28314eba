"""Sorting, drawing and baking agree with one oracle about where splats are and which show."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.cloud import TimeModel
from gsplat_tools.ops.motion import at_time
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.sorting import sort_by_depth
from tests.clouds import random_cloud
from tests.oracles import motion as oracle

CAMERA = Camera.look_at((0, 0, -6), (0, 0, 0), fov_y=50, width=48, height=32)
MODELS: list[TimeModel] = ["window", "gaussian"]


@given(st.integers(0, 1000), st.integers(0, 64), st.sampled_from(MODELS))
def test_sort_by_depth__puts_what_the_oracle_hides_last_and_the_rest_far_first(seed: int, step: int, model: TimeModel) -> None:
    rng = np.random.default_rng(seed)
    t = step / 64
    # Windows in 64ths: their ends fall on the times that are looked at.
    times, durations = rng.integers(0, 65, 40) / 64, np.maximum(rng.integers(0, 33, 40), model == "gaussian") / 64
    cloud = random_cloud(40, sh_degree=0, seed=seed, motion=True).replace(times=times, durations=durations, time_model=model)
    shows = np.array([oracle.weight(a, d, t, model, 0.01) > 0 for a, d in zip(times, durations, strict=True)])
    assert cloud.velocities is not None
    places = [oracle.position(cloud.means[i].astype(float), cloud.velocities[i].astype(float), times[i], t) for i in range(40)]
    depths = np.array(places)[:, 2]

    order = sort_by_depth(cloud, CAMERA, t=t)

    count = int(np.count_nonzero(shows))
    assert shows[order[:count]].all()
    assert order[count:].tolist() == sorted(order[count:].tolist())
    assert (np.diff(depths[order[:count]]) < 1e-5).all()


@settings(max_examples=8)
@given(st.integers(0, 100), st.floats(0, 1), st.sampled_from(MODELS))
def test_render__of_an_asset_is_that_of_its_moment(seed: int, t: float, model: TimeModel) -> None:
    cloud = random_cloud(30, sh_degree=0, seed=seed, motion=True).replace(time_model=model)

    moving = render(cloud, CAMERA, model="unity", variant="fork-4d", t=t).image
    frozen = render(at_time(cloud, t), CAMERA, model="unity", variant="fork-4d").image

    assert np.abs(moving - frozen).max() <= 2.5 / 255  # opacity rounds differently, and the gate of 1/255 may fall either way


def test_render__draws_beyond_the_static_box() -> None:
    one = random_cloud(1, sh_degree=0, motion=True).replace(
        means=np.array([[-9.0, 0, 0]]),  # outside of the picture when its window opens
        log_scales=np.full((1, 3), -1.5),
        opacity_logits=np.array([4.0]),
        sh0=np.ones((1, 3)),
        velocities=np.array([[18.0, 0, 0]]),
        times=np.array([0.25]),
        durations=np.array([0.5]),
    )

    assert render(one, CAMERA, t=0.25).alphas.max() == 0
    assert render(one, CAMERA, t=0.75).alphas.max() > 0.8
    assert render(one, CAMERA, t=0.7501).alphas.max() == pytest.approx(0)
