import numpy as np
import pytest

from gsplat_tools.reference.motion import evaluate_scene
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.reference.splats import splats


def moving(**changes):  # type: ignore[no-untyped-def]
    """One splat that starts at x = 1 at time 0.25, lasts 0.5 and moves by 8 a unit of time."""
    values = {"velocities": [[8, 0, 0]], "times": [0.25], "durations": [0.5]} | changes
    return splats((1, 0, 3), **{name: np.array(v) if isinstance(v, list) else v for name, v in values.items()})


@pytest.mark.parametrize(("t", "shows"), [(0.0, False), (0.25, True), (0.5, True), (0.75, True), (0.751, False), (1.0, False)])
def test_evaluate_scene__opens_a_window_with_its_ends(t: float, shows: bool) -> None:
    state = evaluate_scene(moving(), t)

    assert state.is_visible is not None
    assert state.is_visible.tolist() == [shows]
    assert state.weights is not None
    assert state.weights.tolist() == [float(shows)]
    assert state.means[0, 0] == pytest.approx(1 + 8 * (t - 0.25))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_evaluate_scene__weighs_by_a_gaussian_in_time(dtype: str) -> None:
    cloud = moving(time_model="gaussian", durations=[0.1])

    state = evaluate_scene(cloud, 0.4, dtype=dtype)
    late = evaluate_scene(cloud, 0.25 + 0.1 * 3.1, dtype=dtype)

    assert state.weights is not None
    assert state.weights.dtype == state.means.dtype == dtype
    assert state.weights[0] == pytest.approx(np.exp(-0.5 * 1.5**2), rel=1e-6)
    assert late.is_visible is not None
    assert late.is_visible.tolist() == [False]  # exp(-4.8) is below 0.01
    assert late.weights is not None
    assert late.weights.tolist() == [0]
    assert evaluate_scene(cloud, 0.56, temporal_cutoff=1e-3).is_visible.tolist() == [True]  # type: ignore[union-attr]


def test_evaluate_scene__without_a_time_is_what_is_stored() -> None:
    state = evaluate_scene(moving(), None)

    assert state.is_visible is None
    assert state.weights is None
    assert state.means[0, 0] == 1
    assert evaluate_scene(random_cloud(3), 0.5).is_visible is None


def test_evaluate_scene__interpolates_sequences() -> None:
    clouds = [splats((0, 0, 1)), splats((4, 0, 1))]
    sequence = GaussianSequence(clouds.__getitem__, num_splats=1, sh_degree=0, num_frames=2)

    assert evaluate_scene(sequence, 0.25).means[0, 0] == pytest.approx(1)
    assert evaluate_scene(sequence, None).means[0, 0] == 0
