from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.ops.recentering import choose_origin, position_step, recenter, without_origin


def _cloud(means, origin=(0, 0, 0)) -> GaussianCloud:
    count = len(means)
    return GaussianCloud(
        means=means,
        log_scales=np.zeros((count, 3)),
        quats=np.ones((count, 4)),
        opacity_logits=np.zeros(count),
        sh0=np.zeros((count, 3)),
        shN=np.zeros((count, 0, 3)),
        origin=origin,
    )


def test_recenter__adds_in_float64_before_narrowing() -> None:
    # 4e6 + 0.125 needs 26 bits: float32 alone would lose the eighth.
    cloud = _cloud([[0.125, 0, 0]], origin=(4e6, 0, 0))

    found = recenter(cloud, (4e6 - 1, 0, 0))

    np.testing.assert_array_equal(found.means, [[1.125, 0, 0]])
    np.testing.assert_array_equal(found.origin, [4e6 - 1, 0, 0])


def test_without_origin__gives_world_positions() -> None:
    found = without_origin(_cloud([[1, 2, 3]], origin=(10, -20, 0.5)))

    np.testing.assert_array_equal(found.means, [[11, -18, 3.5]])
    np.testing.assert_array_equal(found.origin, np.zeros(3))


@pytest.mark.parametrize("origin", [(np.nan, 0, 0), (1, 2), 5.0])
def test_recenter__refuses_an_origin_that_is_not_three_numbers(origin) -> None:
    with pytest.raises(CloudError, match="three finite numbers"):
        recenter(_cloud([[1, 2, 3]]), origin)


@given(st.floats(-1e6, 1e6, width=32), st.floats(2.0**-6, 1e5, width=32), st.integers(0, 2**32 - 1))
def test_choose_origin__is_near_the_center_and_costs_next_to_nothing(low: float, size: float, seed: int) -> None:
    values = (low + size * np.random.default_rng(seed).uniform(size=(20, 3))).astype(np.float32)
    box = values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64)
    extent = box[1] - box[0]

    origin = choose_origin(*box)

    assert (np.abs(origin - (box[0] + box[1]) / 2) <= extent / 8).all()
    back = without_origin(recenter(_cloud(values), origin))
    restored = back.means.astype(np.float64)
    # Rounding of the difference, then of the sum, to float32.
    tolerance = 2.0**-24 * extent + np.spacing(np.abs(values)) / 2
    assert (np.abs(restored - values) <= tolerance).all()
    is_far = (np.abs(box[0]) > extent) & (np.abs(box[1]) > extent) & (box[0] * box[1] > 0)
    np.testing.assert_array_equal(back.means[:, is_far], values[:, is_far])


def test_choose_origin__leaves_a_box_about_zero_where_it_is() -> None:
    np.testing.assert_array_equal(choose_origin([-4, -4.1, -1], [4, 4, 1.05]), np.zeros(3))


def test_choose_origin__is_round_for_a_far_box_and_exact_for_a_flat_one() -> None:
    np.testing.assert_array_equal(choose_origin([995, -1007.3, 0.1], [1006, -1000, 0.1]), [1000, -1004, 0.1])


@pytest.mark.parametrize("box", [([0, 0, np.inf], [1, 1, np.inf]), ([1, 0, 0], [0, 1, 1]), ([0], [1])])
def test_choose_origin__refuses_a_box_that_is_none(box) -> None:
    with pytest.raises(CloudError, match="finite box"):
        choose_origin(*box)


@pytest.mark.parametrize(
    ("max_abs", "position_type", "step"),
    [
        (500, "f16", 0.25),
        (1024, "f16", 1.0),
        (0, "f16", 2.0**-24),
        (7e4, "f16", np.inf),
        (np.nan, "f16", np.inf),
        (1.0, "f32", 2.0**-23),
        (4e6, "f32", 0.25),
        (0, "f32", 2.0**-149),
    ],
)
def test_position_step__is_the_spacing_of_the_type(max_abs: float, position_type: str, step: float) -> None:
    assert position_step(max_abs, position_type) == step
    dtype = {"f16": np.float16, "f32": np.float32}[position_type]
    if np.isfinite(step):
        assert float(np.spacing(dtype(max_abs))) == step


def test_position_step__refuses_other_types() -> None:
    with pytest.raises(ValueError, match="f64"):
        position_step(1.0, "f64")
