from __future__ import annotations

import itertools

import numpy as np
import pytest

from gsplat_tools.attributes.coordinate_systems import Y_UP_OR_DOWN, Z_UP_OR_DOWN, axis_map
from gsplat_tools.attributes.covariance import covariance_matrices
from gsplat_tools.attributes.spherical_harmonics import evaluate_colors
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.ops.coordinates import convert_coordinates

TARGETS = [*Y_UP_OR_DOWN, *Z_UP_OR_DOWN, "FUR", "BRD", "UFL", "DLB"]


def _cloud(count: int = 12, seed: int = 0, *, motion: bool = False, **changes) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(count, 3)),
        "log_scales": rng.uniform(-3, 0, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "opacity_logits": rng.normal(size=count),
        "sh0": rng.normal(size=(count, 3)),
        "shN": rng.normal(size=(count, 24, 3)),
        "coordinate_system": "RUB",
        "origin": np.array([1.0, 2.0, 3.0]),
    }
    if motion:
        arrays |= {
            "velocities": rng.normal(size=(count, 3)),
            "times": rng.uniform(size=count),
            "durations": rng.uniform(size=count),
        }
    return GaussianCloud(**arrays | changes)


@pytest.mark.parametrize("target", TARGETS)
def test_convert_coordinates__leaves_what_is_seen_unchanged(target: str) -> None:
    cloud = _cloud(motion=True)
    matrix = axis_map("RUB", target)
    directions = np.random.default_rng(1).normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    found = convert_coordinates(cloud, target)

    np.testing.assert_array_equal(found.means, cloud.means @ matrix.T.astype(np.float32))
    np.testing.assert_array_equal(found.velocities, cloud.velocities @ matrix.T.astype(np.float32))
    np.testing.assert_array_equal(found.origin, matrix @ cloud.origin)
    np.testing.assert_array_equal(found.log_scales, cloud.log_scales)
    np.testing.assert_allclose(
        evaluate_colors(found.sh0, found.shN, directions @ matrix.T),
        evaluate_colors(cloud.sh0, cloud.shN, directions),
        # 24 coefficients of about 1, each rounded to float32, times basis values below 2.3.
        atol=24 * 2.3 * 4 * 2.0**-24,
    )
    old = covariance_matrices(cloud.quats, cloud.log_scales, dtype=np.float64)
    new = covariance_matrices(found.quats, found.log_scales, dtype=np.float64)
    np.testing.assert_allclose(new, matrix @ old @ matrix.T, atol=1e-6)
    assert found.coordinate_system == target


@pytest.mark.parametrize("target", Y_UP_OR_DOWN)
def test_convert_coordinates__by_signs_restores_every_bit(target: str) -> None:
    cloud = _cloud(motion=True, means=np.float32([[0.0, -0.0, np.nan]] * 12))

    back = convert_coordinates(convert_coordinates(cloud, target), "RUB")

    for name, values in cloud.arrays().items():
        assert back.arrays()[name].tobytes() == values.tobytes(), name
    np.testing.assert_array_equal(back.origin, cloud.origin)


def test_convert_coordinates__uses_the_signs_of_the_specification() -> None:
    # RUB to RUF flips z: quaternion signs (sy sz, sx sz, sx sy) = (-1, -1, 1), SH -1 for odd k within the band.
    cloud = _cloud(1)

    found = convert_coordinates(cloud, "RUF")

    np.testing.assert_array_equal(found.quats, cloud.quats * np.float32([1, -1, -1, 1]))
    band_index = np.concatenate([np.arange(2 * band + 1) for band in range(1, 5)])
    np.testing.assert_array_equal(found.shN, cloud.shN * np.where(band_index % 2, -1, 1)[None, :, None])


def test_convert_coordinates__goes_around_through_any_system() -> None:
    cloud = _cloud(5)
    for first, second in itertools.product(["RFU", "LUB", "BRD"], ["LBD", "RDF"]):
        direct = convert_coordinates(cloud, second)

        around = convert_coordinates(convert_coordinates(cloud, first), second)

        np.testing.assert_array_equal(around.means, direct.means)
        np.testing.assert_allclose(around.shN, direct.shN, atol=2e-6)
        covariances = [covariance_matrices(c.quats, c.log_scales) for c in (around, direct)]
        np.testing.assert_allclose(*covariances, atol=1e-6)


def test_convert_coordinates__asks_for_the_source_where_it_is_unknown() -> None:
    cloud = _cloud(coordinate_system="unknown")

    with pytest.raises(CloudError, match="--source-coordinates"):
        convert_coordinates(cloud, "RUF")
    assert convert_coordinates(cloud, "RUF", source="RUB").coordinate_system == "RUF"
    np.testing.assert_array_equal(convert_coordinates(cloud, "RUB", source="rub").means, cloud.means)


@pytest.mark.parametrize(("target", "source"), [("RRU", None), ("RUF", "XYZ"), ("unknown", None)])
def test_convert_coordinates__refuses_names_that_are_no_system(target: str, source: str | None) -> None:
    with pytest.raises(CloudError, match="three axis letters"):
        convert_coordinates(_cloud(1), target, source)


def test_convert_coordinates__turns_normals_and_keeps_other_extras() -> None:
    extra = {"nx": np.float32([1]), "ny": np.float32([2]), "nz": np.float32([3]), "label": np.array([7])}

    found = convert_coordinates(_cloud(1, extra=extra), "RFU").extra

    assert [found[name][0] for name in ("nx", "ny", "nz", "label")] == [1, -3, 2, 7]


def test_convert_coordinates__leaves_its_argument_alone() -> None:
    cloud = _cloud(3, motion=True)
    before = {name: values.copy() for name, values in cloud.arrays().items()}

    convert_coordinates(cloud, "RDF")
    convert_coordinates(cloud, "RFU")

    for name, values in before.items():
        np.testing.assert_array_equal(cloud.arrays()[name], values)


@pytest.mark.parametrize("target", ["RUF", "RFU"])
def test_convert_coordinates__accepts_an_empty_cloud(target: str) -> None:
    assert len(convert_coordinates(_cloud(0), target)) == 0
