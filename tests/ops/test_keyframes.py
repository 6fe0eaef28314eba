import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.ops.keyframes import RESOLUTION, choose_frames, interpolation_error
from tests.clouds import random_cloud


def crowd(times: np.ndarray, durations: np.ndarray, **changes: object) -> GaussianCloud:
    """Equal opaque splats with these windows."""
    count = len(times)
    cloud = random_cloud(count, sh_degree=0, motion=True)
    equal = {"log_scales": np.full((count, 3), -3.0), "opacity_logits": np.full(count, 20.0)}
    return cloud.replace(**{**equal, "times": times, "durations": durations, **changes})


def test_choose_frames__needs_two_where_nothing_comes_or_goes() -> None:
    choice = choose_frames(crowd(np.zeros(50), np.ones(50)), 0.01)

    assert choice.times.tolist() == [0, 1]
    assert choice.error == 0
    assert choice.uniform_frames == 2


def test_choose_frames__puts_them_where_splats_come() -> None:
    times = np.concatenate([np.zeros(100), np.linspace(0.5, 0.6, 101)[1:]])

    choice = choose_frames(crowd(times, np.ones(200)), 0.05)

    assert choice.error <= 0.05
    inside = (choice.times > 0.45) & (choice.times < 0.65)
    assert np.count_nonzero(inside) >= len(choice.times) - 2
    assert choice.uniform_frames is not None
    assert choice.uniform_frames > 2 * len(choice.times)


@pytest.mark.parametrize("model", ["window", "gaussian"])
def test_choose_frames__holds_the_tolerance_and_spends_more_for_less(model: str) -> None:
    rng = np.random.default_rng(3)
    cloud = crowd(rng.uniform(0, 1, 3000), rng.uniform(0.1, 0.5, 3000), time_model=model)

    coarse, fine = choose_frames(cloud, 0.1), choose_frames(cloud, 0.02)

    assert coarse.error <= 0.1
    assert fine.error <= 0.02
    assert 2 < len(coarse.times) < len(fine.times)
    for choice in (coarse, fine):
        assert choice.times[0] == 0
        assert choice.times[-1] == 1
        assert (np.diff(choice.times) > 0).all()
        assert interpolation_error(cloud, choice.times) == pytest.approx(choice.error, abs=1e-5)


def test_choose_frames__says_what_is_left_where_all_come_at_once() -> None:
    # Half of the splats appear between two steps of time: halfway there the first keyframe still hides them.
    appears = (200 + 0.25) / RESOLUTION
    choice = choose_frames(crowd(np.where(np.arange(100) < 50, 0.0, appears), np.ones(100)), 0.01)

    assert choice.error == pytest.approx(0.25, abs=1e-3)  # half of the splats, half faded in
    assert len(choice.times) == 4
    assert choice.times[1:3].tolist() == [200 / RESOLUTION, 201 / RESOLUTION]


def test_interpolation_error__of_a_known_fade() -> None:
    # All splats appear at 0.5; with keyframes at 0 and 1 the error is largest just before and after: one half.
    cloud = crowd(np.full(10, 0.5), np.ones(10))

    assert interpolation_error(cloud, np.array([0.0, 1.0])) == pytest.approx(0.5, abs=2 / RESOLUTION)
    # Of the moments that are looked at, 511/1024 lies in the fade from 0.499 to 0.5.
    tight = interpolation_error(cloud, np.array([0.0, 0.499, 0.5, 1.0]))
    assert tight == pytest.approx((511 / 1024 - 0.499) / 0.001, rel=1e-3)


@pytest.mark.parametrize("tolerance", [0.0, 1.0, -0.1, float("nan")])
def test_choose_frames__refuses_tolerances_that_mean_nothing(tolerance: float) -> None:
    with pytest.raises(ValueError, match="tolerance"):
        choose_frames(crowd(np.zeros(2), np.ones(2)), tolerance)


def test_choose_frames__needs_motion() -> None:
    with pytest.raises(CloudError):
        choose_frames(random_cloud(3), 0.1)
    with pytest.raises(CloudError):
        choose_frames(random_cloud(0, motion=True), 0.1)
