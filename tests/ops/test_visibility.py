"""What changes show, against pictures of one splat summed pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.ops.visibility import LOW_PASS, Tolerance, Viewpoint, tolerance_from_json, viewpoint, visible_costs
from tests.clouds import random_cloud

X, Y = np.meshgrid(np.arange(-60, 60.25, 0.25), np.arange(-60, 60.25, 0.25))


def picture(a: float, b: float, *, opacity: float = 1.0, shift: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """A splat of half axes a and b, shifted along b, turned."""
    u, v = np.cos(turn) * X + np.sin(turn) * Y, -np.sin(turn) * X + np.cos(turn) * Y - shift
    return opacity * np.exp(-(u * u / a**2 + v * v / b**2) / 2)


def energy(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.square(first - second).sum() / 16)


def splat(a: float, b: float, opacity: float) -> GaussianCloud:
    """A flat splat at the center whose trace has the half axes a and b, where a unit spans a pixel."""
    scales = np.sqrt(np.square([[a, b, b]]) - LOW_PASS)
    logit = np.log(opacity / (1 - opacity))
    return GaussianCloud(
        means=np.zeros((1, 3), np.float32),
        log_scales=np.log(scales).astype(np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        opacity_logits=np.array([logit], np.float32),
        sh0=np.zeros((1, 3), np.float32),
        shN=np.zeros((1, 0, 3), np.float32),
    )


ONE_PIXEL = Viewpoint((0.0, 0.0, 0.0), 500.0)


@pytest.mark.parametrize(("a", "b", "opacity"), [(4.0, 4.0, 0.5), (12.0, 3.0, 0.8)])
def test_costs__are_energies_of_differences_of_pictures(a: float, b: float, opacity: float) -> None:
    cloud = splat(a, b, opacity)
    plain = picture(a, b, opacity=opacity)
    bit = energy(picture(5, 5), picture(5, 5, shift=0.01))  # an opaque round splat, shifted by a hundredth

    costs = visible_costs(cloud, cloud.log_scales, 0.01, ONE_PIXEL)

    small = 1e-3
    shown = {
        "position": energy(plain, picture(a, b, opacity=opacity, shift=small)),
        "opacity": energy(plain, picture(a, b, opacity=opacity + small)),
        "scale": energy(plain, picture(a * np.exp(small), b, opacity=opacity)),
        "turn": energy(plain, picture(a, b, opacity=opacity, turn=small)),
    }
    factors = {"position": 1, "opacity": 1, "scale": 8 / 2}  # two of three axes show
    for name, factor in factors.items():
        assert getattr(costs, name)[0] * small**2 == pytest.approx(factor * shown[name] / bit, rel=1e-3)
    assert costs.rotation[0, 2] * small**2 == pytest.approx(
        3 * shown["turn"] / bit / 3, rel=1e-3, abs=1e-9
    )  # of three planes one
    assert costs.rotation[0, 0] < 1e-9  # b and b are alike


def test_viewpoint__is_that_of_the_bulk() -> None:
    cloud = random_cloud(2000, sh_degree=0)
    means = cloud.means.copy()
    means[:5] = 1e4

    assert viewpoint(cloud.replace(means=means)).radius == pytest.approx(viewpoint(cloud).radius, rel=0.02)


def test_far_splats__span_fewer_pixels() -> None:
    view = Viewpoint((1.0, 0.0, 0.0), 2.0)

    scales = view.pixels_per_unit(np.array([[1, 0, 0], [3, 0, 0], [9, 0, 0]], np.float32))

    assert scales.tolist() == [250.0, 250.0, 62.5]


@pytest.mark.parametrize("means", [np.zeros((3, 3)), np.ones((1, 3))])
def test_viewpoint__has_a_radius_where_all_is_in_one_place(means: np.ndarray) -> None:
    cloud = random_cloud(len(means), sh_degree=0).replace(means=means.astype(np.float32))

    assert 0 < viewpoint(cloud).radius < np.inf


def test_tolerance__survives_its_text() -> None:
    tolerance = Tolerance(0.05, Viewpoint((0.1, -2.0, 1e-7), 3.3))

    assert tolerance_from_json(tolerance.to_json()) == tolerance


@pytest.mark.parametrize(
    "value",
    [None, [], {}, {"pixels": 1}, {"pixels": "x", "radius": 1, "center": {"x": 0, "y": 0, "z": 0}},
     {"pixels": 1, "radius": 0, "center": {"x": 0, "y": 0, "z": 0}}, {"pixels": 1, "radius": 1, "center": {"x": 0, "y": 0}}],
)  # fmt: skip
def test_other_texts__are_no_tolerance(value: object) -> None:
    assert tolerance_from_json(value) is None
