import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.attributes.activations import sigmoid
from gsplat_tools.cloud import GaussianCloud, TimeModel
from gsplat_tools.errors import CloudError, LossyConversionWarning
from gsplat_tools.ops.motion import at_time, bake, motion_bounds, visible_splats, with_time_model
from gsplat_tools.reference.motion import evaluate_scene
from tests.clouds import random_cloud
from tests.oracles import motion as oracle

MODELS: list[TimeModel] = ["window", "gaussian"]


def moving(count: int = 200, model: TimeModel = "window", seed: int = 0) -> GaussianCloud:
    cloud = random_cloud(count, sh_degree=1, seed=seed, motion=True)
    return cloud.replace(time_model=model, opacity_logits=np.abs(cloud.opacity_logits))


def one(time: float, duration: float, model: TimeModel = "window") -> GaussianCloud:
    """One opaque splat that moves along x."""
    changes = {"times": np.array([time]), "durations": np.array([duration]), "velocities": np.array([[2.0, 0, 0]])}
    return moving(1).replace(time_model=model, means=np.zeros((1, 3)), opacity_logits=np.array([3.0]), **changes)


@given(st.integers(0, 100), st.floats(0, 1), st.sampled_from(MODELS))
def test_at_time__matches_the_oracle(seed: int, t: float, model: TimeModel) -> None:
    cloud = random_cloud(20, sh_degree=0, seed=seed, motion=True).replace(time_model=model)
    assert cloud.velocities is not None
    assert cloud.times is not None
    assert cloud.durations is not None

    still = at_time(cloud, t)

    moment = float(np.float32(t))
    for i in range(len(cloud)):
        place = oracle.position(cloud.means[i].astype(float), cloud.velocities[i].astype(float), float(cloud.times[i]), moment)
        assert still.means[i] == pytest.approx(place, abs=1e-5)
        end = float(np.float32(cloud.times[i] + cloud.durations[i]))  # shaders add in float32
        duration = end - float(cloud.times[i]) if model == "window" else float(cloud.durations[i])
        factor = oracle.weight(float(cloud.times[i]), duration, moment, model, cloud.temporal_cutoff)
        opacity = float(sigmoid(cloud.opacity_logits.astype(float))[i])
        expected, found = oracle.baked_opacity(opacity, factor), float(sigmoid(still.opacity_logits.astype(float))[i])
        # On the gate of 1/255 and on the cutoff float32 may fall either way.
        edges = (1 / 255, opacity * cloud.temporal_cutoff)
        is_on_edge = any(abs(max(found, expected) - edge) < 1e-6 for edge in edges)
        assert found == pytest.approx(expected, abs=1e-6) or (min(found, expected) == 0 and is_on_edge)
    assert not still.has_motion


@given(st.integers(0, 50), st.floats(0, 1), st.sampled_from(MODELS))
def test_at_time__is_what_the_renderer_evaluates(seed: int, t: float, model: TimeModel) -> None:
    cloud = moving(30, model, seed).replace(temporal_cutoff=0.05)

    still, state = at_time(cloud, t), evaluate_scene(cloud, t)

    assert np.array_equal(still.means, state.means)
    assert state.weights is not None
    shown = sigmoid(cloud.opacity_logits.astype(np.float64)) * state.weights
    assert np.allclose(sigmoid(still.opacity_logits.astype(np.float64)), np.where(shown >= 1 / 255, shown, 0), atol=1e-6)


def test_at_time__keeps_what_does_not_change() -> None:
    cloud = moving()

    still = at_time(cloud, 0.5)

    for name in ("log_scales", "quats", "sh0", "shN"):
        assert np.array_equal(getattr(still, name), getattr(cloud, name))
    full = evaluate_scene(cloud, 0.5).weights == 1
    assert np.array_equal(still.opacity_logits[full], cloud.opacity_logits[full])


def test_at_time__refuses_times_that_are_no_numbers() -> None:
    with pytest.raises(ValueError, match="finite"):
        at_time(moving(), float("nan"))


def test_motion_bounds__hold_a_splat_that_culling_by_the_static_box_would_lose() -> None:
    cloud = one(0.25, 0.5)

    static, moved = cloud.bounds(), motion_bounds(cloud)

    assert static is not None
    assert moved is not None
    late = at_time(cloud, 0.75)
    assert late.means[0, 0] > static[1][0]
    assert sigmoid(late.opacity_logits)[0] > 0.9
    assert late.means[0, 0] <= moved[1][0] == 1.0


def test_motion_bounds__of_gaussians_reach_to_the_cutoff() -> None:
    cloud = one(0.5, 0.1, "gaussian").replace(temporal_cutoff=float(np.exp(-2.0)))

    moved = motion_bounds(cloud)

    assert moved is not None
    assert moved[1][0] == pytest.approx(2.0 * 0.1 * 2.0)  # speed, sigma, and the 2 sigma where the weight is exp(-2)
    wider = motion_bounds(cloud, temporal_cutoff=float(np.exp(-8.0)))
    assert wider is not None
    assert wider[1][0] == pytest.approx(2.0 * 0.1 * 4.0)


@given(st.integers(0, 30), st.sampled_from(MODELS), st.floats(0, 1))
def test_motion_bounds__hold_every_visible_splat(seed: int, model: TimeModel, t: float) -> None:
    cloud = moving(50, model, seed)
    box = motion_bounds(cloud)
    assert box is not None

    state = evaluate_scene(cloud, t)

    assert state.is_visible is not None
    places = state.means[state.is_visible]
    assert (places >= box[0] - 1e-5).all()
    assert (places <= box[1] + 1e-5).all()


def test_motion_bounds__without_splats_or_motion() -> None:
    assert motion_bounds(moving(0)) is None
    still = random_cloud(5)
    assert np.array_equal(motion_bounds(still), still.bounds())  # type: ignore[arg-type]


@pytest.mark.parametrize("model", MODELS)
def test_bake__drops_what_no_frame_shows_and_keeps_the_order(model: TimeModel) -> None:
    cloud = moving(300, model)
    cloud = cloud.replace(durations=np.where(np.arange(300) % 3 == 0, np.float32(1e-4), cloud.durations))
    times = np.linspace(0, 1, 7)
    shown = visible_splats(cloud, times)
    assert 0 < np.count_nonzero(~shown) < 200

    with pytest.warns(LossyConversionWarning, match=f"dropped {np.count_nonzero(~shown)} of 300"):
        sequence = bake(cloud, 7)

    assert sequence.is_uniform
    assert sequence.num_splats == np.count_nonzero(shown)
    assert np.array_equal(sequence.frame_times, times)
    for frame_id, t in enumerate(times):
        expected = at_time(cloud, t).take(shown)
        frame = sequence.frame(frame_id)
        for name, values in expected.arrays().items():
            assert np.array_equal(values, getattr(frame, name)), name


def test_bake__takes_explicit_times() -> None:
    sequence = bake(one(0, 1), [0.0, 0.1, 0.1, 1.0])

    assert not sequence.is_uniform
    assert sequence.frame_times.tolist() == [0, 0.1, 0.1, 1]
    assert [round(float(sequence.frame(i).means[0, 0]), 6) for i in range(4)] == [0, 0.2, 0.2, 2]


def test_bake__is_exact_between_frames_for_splats_that_always_show() -> None:
    cloud = moving().replace(times=np.zeros(200), durations=np.ones(200))

    sequence = bake(cloud, 5)

    between, true = sequence.at(0.3), at_time(cloud, 0.3)
    assert np.allclose(between.means, true.means, atol=1e-5)
    assert np.allclose(between.opacity_logits, true.opacity_logits, atol=1e-4)


@pytest.mark.parametrize("times", [[0.5, 0.2], [0.0, 1.5], [], [float("nan")]])
def test_bake__refuses_times_that_no_sequence_has(times: list[float]) -> None:
    with pytest.raises(CloudError):
        bake(moving(), times)


def test_bake__refuses_a_still_cloud() -> None:
    with pytest.raises(CloudError, match="no motion"):
        bake(random_cloud(3), 5)


@given(st.floats(0, 1), st.floats(0.01, 1))
def test_with_time_model__states_the_error_of_a_gaussian(time: float, duration: float) -> None:
    duration = min(duration, 1 - time) + 1e-3
    cloud = one(time, duration)
    assert cloud.times is not None
    assert cloud.durations is not None

    converted, errors = with_time_model(cloud, "gaussian")

    assert converted.times is not None
    assert converted.durations is not None
    window = (float(cloud.times[0]), float(cloud.durations[0]), "window")
    curve = (float(converted.times[0]), float(converted.durations[0]), "gaussian")
    assert errors[0] ** 2 == pytest.approx(oracle.mean_square_of_weights(window, curve, 2000), abs=2e-3)
    # No window is farther from its Gaussian than a lone one of its length.
    assert errors[0] <= 0.357 * np.sqrt(duration) + 1e-3


@given(st.floats(-0.5, 1.5), st.floats(0.01, 2))
def test_with_time_model__states_the_error_of_a_window(center: float, sigma: float) -> None:
    cloud = one(center, sigma, "gaussian")

    converted, errors = with_time_model(cloud, "window")

    assert cloud.times is not None
    assert cloud.durations is not None
    assert converted.times is not None
    assert converted.durations is not None
    start, length = float(converted.times[0]), float(converted.durations[0])
    assert 0 <= start <= start + length <= 1 + 1e-6
    hidden = np.isneginf(converted.opacity_logits[0])
    window = (2.0, 0.0, "window") if hidden else (start, length, "window")
    curve = (float(cloud.times[0]), float(cloud.durations[0]), "gaussian")
    assert errors[0] ** 2 == pytest.approx(oracle.mean_square_of_weights(window, curve, 2000), abs=2e-3)


def test_with_time_model__is_the_best_window() -> None:
    _, errors = with_time_model(one(0.5, 0.1, "gaussian"), "window")

    best = min(
        oracle.mean_square_of_weights((0.5 - half, 2 * half, "window"), (0.5, 0.1, "gaussian"), 2000)
        for half in np.linspace(0.05, 0.3, 101)
    )
    assert errors[0] ** 2 <= best + 1e-3


@pytest.mark.parametrize(("source", "target"), [("window", "gaussian"), ("gaussian", "window")])
def test_with_time_model__leaves_paths_as_they_are(source: TimeModel, target: TimeModel) -> None:
    cloud = moving(100, source)

    converted, errors = with_time_model(cloud, target)

    assert converted.time_model == target
    assert (errors > 0).all()
    for t in (0.0, 0.4, 1.0):
        assert np.allclose(evaluate_scene(cloud, t).means, evaluate_scene(converted, t).means, atol=2e-6)


def test_with_time_model__of_a_splat_that_always_shows_changes_nothing_that_shows() -> None:
    converted, errors = with_time_model(one(0, 1), "gaussian")

    weights = [evaluate_scene(converted, t).weights[0] for t in (0.0, 0.5, 1.0)]  # type: ignore[index]
    assert min(weights) > 1 - 0.5 / 255
    assert errors[0] < 1e-3


def test_with_time_model__hides_what_is_never_at_half() -> None:
    converted, _ = with_time_model(one(-0.5, 0.1, "gaussian"), "window")

    assert np.isneginf(converted.opacity_logits[0])


def test_with_time_model__needs_motion_and_returns_what_is_already_right() -> None:
    cloud = moving()
    same, errors = with_time_model(cloud, "window")
    assert same is cloud
    assert not errors.any()
    with pytest.raises(CloudError, match="no motion"):
        with_time_model(random_cloud(2), "gaussian")
