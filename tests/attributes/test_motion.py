import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.attributes.motion import MotionBox, half_width, positions_at, reach, weights_at
from tests.oracles import motion as oracle

MODELS = ["window", "gaussian"]
unit = st.floats(0, 1, width=32)
# Numbers whose sums float32 holds exactly: the ends of windows fall exactly on times.
exact = st.integers(0, 1024).map(lambda n: n / 1024)
speeds = st.floats(-16, 16, width=32)


@given(st.lists(st.tuples(speeds, speeds, speeds, speeds, unit), min_size=1, max_size=20), unit)
def test_positions_at__match_the_oracle(rows: list[tuple[float, ...]], t: float) -> None:
    means = np.array([[x, -x, 2 * x] for x, *_ in rows])
    velocities = np.array([row[1:4] for row in rows])
    times = np.array([row[4] for row in rows])

    found = positions_at(means, velocities, times, t)
    narrow = positions_at(means.astype(np.float32), velocities.astype(np.float32), times.astype(np.float32), t)

    expected = np.array([oracle.position(*row, t) for row in zip(means, velocities, times, strict=True)])
    assert np.array_equal(found, expected)
    assert narrow.dtype == np.float32
    # Three roundings of 2^-24, of an age up to 1, its product with a speed up to 16, and a sum up to 48.
    assert np.abs(narrow - expected).max() <= (16 + 16 + 48) * 2.0**-24


@given(st.lists(st.tuples(exact, exact), min_size=1, max_size=30), exact, st.sampled_from(["float32", "float64"]))
def test_weights_at__open_windows_as_the_oracle_does_with_their_ends(
    windows: list[tuple[float, float]], t: float, dtype: str
) -> None:
    # The moment itself and both ends are among the windows.
    windows = [*windows, (t, 0.0), (t, 0.5), (t / 2, t / 2), (0.0, t)]
    times, durations = np.array(windows, dtype).T

    found = weights_at(times, durations, t, "window")

    assert found.tolist() == [oracle.weight(time, duration, t, "window", 0.01) for time, duration in windows]
    assert found[-4:].tolist() == [1, 1, 1, 1]


@given(
    st.lists(st.tuples(st.floats(-1, 2), st.floats(1e-6, 4)), min_size=1, max_size=30),
    unit,
    st.floats(1e-4, 0.9),
    st.sampled_from(["float32", "float64"]),
)
def test_weights_at__fade_as_the_oracle_does(curves: list[tuple[float, float]], t: float, cutoff: float, dtype: str) -> None:
    times, durations = np.array(curves, dtype).T

    found = weights_at(times, durations, t, "gaussian", cutoff)

    rounding = float(np.finfo(dtype).eps)
    for weight, time, duration in zip(found, times.astype(float), durations.astype(float), strict=True):
        ratio = abs(t - time) / duration
        expected = oracle.weight(time, duration, t, "gaussian", 0.0)
        # An age is rounded relative to |t| + |time|; its effect on the exponent is ratio times that, over the duration.
        slack = (4 + ratio * (ratio + (abs(t) + abs(time)) / duration)) * rounding
        if abs(expected - cutoff) <= slack * max(expected, cutoff) + 1e-300:
            continue  # on the cutoff it may fall either way
        if expected < cutoff:
            assert weight == 0
        else:
            assert weight == pytest.approx(expected, rel=slack + 1e-12)


def test_weights_at__know_the_curve() -> None:
    times, durations = np.full(4, 0.5), np.full(4, 0.1)

    assert weights_at(times, durations, 0.5, "gaussian").tolist() == [1] * 4
    assert weights_at(times, durations, 0.6, "gaussian")[0] == pytest.approx(0.6065306597126334, rel=1e-12)
    assert weights_at(times, durations, 0.5 + 0.1 * 3.04, "gaussian")[0] == 0  # 0.00985
    assert weights_at(times, durations, 0.5 + 0.1 * 3.03, "gaussian")[0] == pytest.approx(0.01015, rel=1e-3)


@pytest.mark.parametrize("model", MODELS)
def test_weights_at__hide_what_is_not_a_number(model: str) -> None:
    times, durations = np.array([np.nan, 0.5, np.inf, 0.5]), np.array([0.5, np.nan, 0.5, -1.0])

    hidden = weights_at(times, durations, 0.75, model)  # type: ignore[arg-type]

    assert hidden[:3].tolist() == [0, 0, 0]
    if model == "window":
        assert hidden[3] == 0


def test_weights_at__of_sigma_zero_show_at_most_one_moment() -> None:
    hidden = weights_at(np.array([0.5, 0.25]), np.zeros(2), 0.5, "gaussian")

    assert hidden.tolist() == [0, 0]


@given(st.floats(1e-6, 0.999))
def test_half_width__is_where_the_weight_falls_to_the_cutoff(cutoff: float) -> None:
    width = half_width("gaussian", cutoff)

    assert math.exp(-0.5 * width * width) == pytest.approx(cutoff, rel=1e-9)
    assert half_width("window", cutoff) == 1


def test_reach__of_known_motion() -> None:
    assert reach(2.0, 0.25, "window") == 0.5
    assert reach(2.0, 0.25, "gaussian", math.exp(-0.5)) == pytest.approx(0.5)
    assert reach(2.0, -1.0, "window") == 0


@given(
    st.lists(st.tuples(speeds, speeds, unit, unit), min_size=1, max_size=20),
    st.floats(0, 1, width=32),
    st.sampled_from(MODELS),
)
def test_motion_box__holds_every_visible_splat(rows: list[tuple[float, ...]], t: float, model: str) -> None:
    means = np.array([[x, x / 2, -x] for x, *_ in rows])
    velocities = np.array([[v, -v, v / 3] for _, v, *_ in rows])
    times, durations = np.array([row[2] for row in rows]), np.maximum([row[3] for row in rows], 1e-6)
    box = MotionBox(model)  # type: ignore[arg-type]
    for part in np.array_split(np.arange(len(rows)), 3):
        box.add(means[part], velocities[part], durations[part])

    bounds = box.motion_box()

    assert bounds is not None
    for row in range(len(rows)):
        if oracle.weight(times[row], durations[row], t, model, 0.01) > 0:
            place = np.array(oracle.position(means[row], velocities[row], times[row], t))
            assert (place >= np.array(bounds[0]) - 1e-9).all()
            assert (place <= np.array(bounds[1]) + 1e-9).all()


def test_motion_box__finds_the_splat_that_the_static_box_loses() -> None:
    # One splat starts at the edge of a scene of size 1 and flies out by 3 before its window closes.
    means = np.array([[0.0, 0, 0], [1.0, 1, 1]])
    velocities, times, durations = np.array([[0.0, 0, 0], [6.0, 0, 0]]), np.array([0.0, 0.5]), np.array([1.0, 0.5])
    box = MotionBox("window")
    box.add(means, velocities, durations)

    place = oracle.position(means[1], velocities[1], times[1], 1.0)
    static, moving = box.box(), box.motion_box(np.array([10.0, 0, 0]))

    assert oracle.weight(times[1], durations[1], 1.0, "window", 0.01) == 1
    assert static is not None
    assert place[0] == 4 > static[1][0]
    assert moving == ([10 - 6.0, -6.0, -6.0], [10 + 7.0, 7.0, 7.0])


def test_motion_box__leaves_out_what_is_not_finite() -> None:
    box = MotionBox("window")
    box.add(np.array([[np.nan, 0, 0], [1, 2, 3]]), np.array([[0, 0, 0], [np.inf, 0, 0]]), np.ones(2))
    assert box.box() is None
    assert box.motion_box() is None

    box.add(np.array([[1.0, 2, 3]]), np.array([[2.0, 0, 0]]), np.array([0.5]))
    assert box.motion_box() == ([0, 1, 2], [2, 3, 4])


@given(st.lists(unit, min_size=1, max_size=8), unit)
def test_weights_at__never_leave_0_to_1(values: list[float], t: float) -> None:
    numbers = np.array(values, np.float32)
    for model in MODELS:
        weights = weights_at(numbers, numbers[::-1].copy(), t, model)  # type: ignore[arg-type]
        assert ((weights >= 0) & (weights <= 1)).all()
