import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.codecs.rotation_bounds import relative_covariance_bound


def turn(axis, angle):
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@given(st.integers(0, 2**32), st.floats(0, np.pi / 2), st.floats(0, 2), st.sampled_from([0.1, 1.0, 6.0]))
def test_relative_covariance_bound__holds_for_every_turn_and_stretch(seed, angle, stretch, spread):
    rng = np.random.default_rng(seed)
    log_scales = rng.normal(-3, spread, 3)
    moved = log_scales + rng.choice([-1, 1, rng.uniform(-1, 1)], 3) * stretch
    source, target = np.diag(np.exp(2 * log_scales)), np.diag(np.exp(2 * moved))
    rotation = turn(rng.normal(size=3) * rng.choice([0, 1], 3) + 1e-9, angle)

    error = np.linalg.norm(rotation @ target @ rotation.T - source) / np.linalg.norm(source)

    assert error <= relative_covariance_bound(log_scales[None], np.float64(stretch), angle)[0] * (1 + 1e-9)


def test_relative_covariance_bound__is_near_what_a_needle_reaches():
    angle = 0.03
    needle = np.diag([1.0, 0, 0])
    rotation = turn(np.array([0, 0, 1]), angle)

    error = np.linalg.norm(rotation @ needle @ rotation.T - needle)

    bound = relative_covariance_bound(np.array([[0, -np.inf, -np.inf]]), np.zeros(3), angle)[0]
    assert error <= bound <= 1.2 * error


def test_relative_covariance_bound__takes_flat_and_flattened_axes():
    log_scales = np.array([[-np.inf] * 3, [0, 0, -np.inf], [0, -31, -40]])
    errors = np.array([[0.0] * 3, [0, 0, 0], [0, np.inf, np.inf]])

    bounds = relative_covariance_bound(log_scales, errors, 0.0)

    np.testing.assert_allclose(bounds, [0, 0, np.exp(-62)], rtol=1e-6)
