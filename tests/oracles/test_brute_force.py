"""The oracle itself, held against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.oracles.brute_force import render_oracle
from tests.oracles.oracle_accumulator import requantize
from tests.oracles.oracle_projection import Camera

SIZE = 33
FRONT = Camera(np.eye(4), 50, 50, SIZE / 2, SIZE / 2, SIZE, SIZE, near=0.01, far=100)
MIDDLE = SIZE // 2


def _splats(*depths: float, sigma: float = 0.1, opacity: float = 0.5, colors=((1.0, 0.5, 0.25),)) -> dict:
    count = len(depths)
    rgb = np.array([colors[i % len(colors)] for i in range(count)])
    return {
        "means": np.array([[0, 0, z] for z in depths]),
        "log_scales": np.full((count, 3), np.log(sigma)),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacity_logits": np.full(count, np.log(opacity / (1 - opacity))),
        "sh0": (rgb - 0.5) / 0.28209479177387814,
        "shN": np.zeros((count, 0, 3)),
    }


# One splat on the axis at depth 2: sigma^2 = (50 * 0.1 / 2)^2 = 6.25 px^2 plus the low-pass filter.
# The pixel three to the right is 3 px off; unity's 1.2.1 takes exp((u - 1.16) * 25) away.
@pytest.mark.parametrize(
    ("model", "variant", "compensation", "blurred", "taken"),
    [
        ("inria", None, 1.0, 6.55, 0.0),
        ("unity", "1.0", 1.0, 6.325, 0.0),
        ("unity", "1.2.1", 1.0, 6.325, np.exp((3 / np.sqrt(8 * 6.325) - 1.16) * 25)),
        ("spark", "none", 6.25 / 6.55, 6.55, 0.0),
        ("visionary", "float", np.sqrt(6.25**2 / (6.35**2 + 1e-6) + 1e-6), 6.35, 0.0),
    ],
)
def test_oracle__of_one_splat_is_a_gaussian(model, variant, compensation, blurred, taken) -> None:
    picture = render_oracle(_splats(2.0), FRONT, model, variant)

    expected = 0.5 * compensation * (np.exp(-9 / (2 * blurred)) - taken)
    assert picture.alphas[MIDDLE, MIDDLE + 3] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(picture.image[MIDDLE, MIDDLE + 3], expected * np.array([1, 0.5, 0.25]), rtol=1e-12)


@pytest.mark.parametrize(("model", "variant"), [("inria", None), ("unity", "1.0"), ("spark", "none"), ("visionary", "float")])
def test_oracle__puts_the_near_splat_over_the_far_one(model, variant) -> None:
    near, far = (1.0, 0, 0), (0, 1.0, 0)
    splats = _splats(2.0, 3.0, colors=(near, far), opacity=0.8, sigma=1.0)

    picture = render_oracle(splats, FRONT, model, variant)

    red, green, _ = picture.image[MIDDLE, MIDDLE]
    # The blurs differ; sigma is at least 16 px, so that compensation stays above 0.999.
    assert red == pytest.approx(0.8, abs=2e-3)
    assert green == pytest.approx(0.16, abs=2e-3)


def test_oracle__stops_before_the_splat_that_would_leave_less_than_1e_4() -> None:
    splats = _splats(2.0, 2.1, 2.2, opacity=0.99999)

    picture = render_oracle(splats, FRONT, "inria")

    # 0.01 after the first, 1e-4 after the second but for rounding, the third would leave 1e-6.
    assert picture.alphas[MIDDLE, MIDDLE] in (pytest.approx(0.99), pytest.approx(0.9999))
    assert picture.margin[MIDDLE, MIDDLE] < 1e-9


def test_oracle__cuts_the_footprint_where_each_model_says() -> None:
    splats = _splats(2.0, opacity=0.9, sigma=0.2)

    def reach(model: str, variant: str | None) -> int:
        return int(np.count_nonzero(render_oracle(splats, FRONT, model, variant).alphas[MIDDLE, MIDDLE:])) - 1

    # sigma about 5 px: sqrt(8) sigma = 14 px for unity and spark, 3.0685 sigma = 15 px for visionary.
    assert reach("unity", "1.0") == 14
    assert reach("spark", "none") == 14
    assert reach("visionary", "half") == 15


def test_oracle__counts_axes_that_no_gpu_can_know() -> None:
    assert render_oracle(_splats(2.0), FRONT, "unity").num_undefined == 1
    assert render_oracle(_splats(2.0), FRONT, "inria").num_undefined == 0


def test_oracle__with_an_8_bit_target_holds_bytes_and_clamps_negative_colors() -> None:
    splats = _splats(2.0, 3.0, colors=((-1.0, 0.5, 0.5), (1.0, 1.0, 1.0)), opacity=0.5)

    picture = render_oracle(splats, FRONT, "unity", framebuffer="unorm8")

    np.testing.assert_allclose(picture.image * 255, np.round(picture.image * 255), atol=1e-9)
    assert picture.image[MIDDLE, MIDDLE, 0] == pytest.approx(0.25, abs=2 / 255)
    assert render_oracle(splats, FRONT, "unity").image[MIDDLE, MIDDLE, 0] == pytest.approx(-0.25, abs=2e-2)


def test_accumulator__steps_are_those_of_the_packed_format() -> None:
    offset, scales, quat, opacity, color, _ = requantize(
        "packed", np.array([1.0001, 0, 0]), [-12.0, -40.0, 20.0], [1, 0, 0, 0], 0.3, np.array([-1.0, 0.31, 2.0])
    )

    assert offset[0] == 1.0
    np.testing.assert_allclose(scales, [np.exp(-12), 0, np.exp(9)])
    np.testing.assert_allclose(quat, [1, 0, 0, 0])
    assert opacity == pytest.approx(38 / 255 * 2)
    np.testing.assert_allclose(color, [0, 79 / 255, 1])


def test_accumulator__rotations_err_by_less_than_the_specified_bounds() -> None:
    quats = np.random.default_rng(0).normal(size=(300, 4))
    for accumulator, bound in (("packed", 1.9), ("ext", 0.5)):
        dots = [
            abs(requantize(accumulator, np.zeros(3), np.zeros(3), q, 0.5, np.zeros(3))[2] @ q) / np.linalg.norm(q)
            for q in quats
        ]
        assert np.degrees(2 * np.arccos(np.clip(dots, 0, 1))).max() < bound
