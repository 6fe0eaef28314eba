import numpy as np

from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges
from tests.oracles.smallest_three import covariance


def test_bound_of_ranges__holds_for_random_moves_and_turns():
    rng = np.random.default_rng(0)
    logs = rng.uniform(-14, 2, (400, 3))
    low, high = np.clip(logs, -10, 1) - 0.03, np.clip(logs, -10, 1) + 0.03
    angle = 0.02
    bound = covariance_bound_of_ranges(logs, low, high, angle)

    for i in range(len(logs)):
        axis = rng.normal(size=3)
        turn = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis / np.linalg.norm(axis))])
        before = covariance(np.array([1.0, 0, 0, 0]), logs[i])
        after = covariance(turn, rng.uniform(low[i], high[i]))
        assert np.linalg.norm(after - before) <= bound[i] * np.linalg.norm(before)


def test_bound_of_ranges__knows_flat_axes():
    flat = np.array([[-np.inf, -np.inf, -1.0], [-np.inf, -np.inf, -np.inf]])

    clamped = covariance_bound_of_ranges(flat, np.maximum(flat, -10), np.maximum(flat, -10), 0.0)
    kept = covariance_bound_of_ranges(flat, flat, flat, 0.0)

    assert 0 < clamped[0] < 1e-7
    assert clamped[1] == np.inf
    np.testing.assert_array_equal(kept, 0)
