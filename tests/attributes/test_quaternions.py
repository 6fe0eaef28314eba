from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.attributes import quaternions


def _random_quats(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 4))


def test_to_matrix__turns_x_into_y_by_90_degrees_about_z() -> None:
    half = np.sqrt(0.5)

    matrix = quaternions.to_matrix(np.array([[half, 0, 0, half]]))[0]

    np.testing.assert_allclose(matrix @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_to_matrix__agrees_with_the_sandwich_product() -> None:
    quats, vectors = _random_quats(50), np.random.default_rng(1).normal(size=(50, 3))
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    pure = np.concatenate([np.zeros((50, 1)), vectors], axis=1)
    conjugate = unit * [1, -1, -1, -1]

    turned = quaternions.multiply(quaternions.multiply(unit, pure), conjugate)

    np.testing.assert_allclose(np.einsum("nij,nj->ni", quaternions.to_matrix(quats), vectors), turned[:, 1:], atol=1e-14)


def test_multiply__is_the_rotation_on_the_right_followed_by_the_left() -> None:
    a, b = _random_quats(50, 2), _random_quats(50, 3)

    product = quaternions.to_matrix(quaternions.multiply(a, b))

    np.testing.assert_allclose(product, quaternions.to_matrix(a) @ quaternions.to_matrix(b), atol=1e-14)
    # Hamilton's i j = k.
    np.testing.assert_array_equal(quaternions.multiply(np.eye(4)[1], np.eye(4)[[2]]), np.eye(4)[[3]])


def test_from_matrix__inverts_to_matrix_for_every_branch() -> None:
    # Half turns about the axes have w = 0 and each branch its own largest component.
    quats = np.concatenate([_random_quats(500), np.eye(4), [[0, 1, 1, 0], [0, 0, 1, -1], [0, 1, -1, 1], [1e-9, 1, 0, 0]]])
    unit = quaternions.canonical_sign(quats / np.linalg.norm(quats, axis=1, keepdims=True))

    found = quaternions.from_matrix(quaternions.to_matrix(quats))

    np.testing.assert_allclose(np.abs((found * unit).sum(axis=1)), 1, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-15)


def test_normalize__takes_zero_as_the_identity_and_survives_extremes() -> None:
    quats = np.array([[0, 0, 0, 0], [3e200, 0, 0, 4e200], [1e-200, 0, 0, 0], [0, np.nan, 0, 1]])

    found = quaternions.normalize(quats)

    np.testing.assert_allclose(found[:3], [[1, 0, 0, 0], [0.6, 0, 0, 0.8], [1, 0, 0, 0]], rtol=1e-15)
    assert np.isnan(found[3]).any()
    narrow = quaternions.normalize(np.float32([[1e38, 1e38, 0, 0], [1e-45, 0, 0, 0]]))
    assert narrow.dtype == np.float32
    np.testing.assert_allclose(narrow, [[0.70710678, 0.70710678, 0, 0], [1, 0, 0, 0]], rtol=1e-7)


def test_canonical_sign__makes_the_first_nonzero_component_positive() -> None:
    quats = np.float32([[-1, 2, 3, 4], [1, -2, 0, 0], [0, -1, 2, 0], [0, 0, 0, -1], [0, 0, 0, 0]])

    found = quaternions.canonical_sign(quats)

    np.testing.assert_array_equal(
        found, np.float32([[1, -2, -3, -4], [1, -2, 0, 0], [0, 1, -2, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
    )


def test_xyzw__moves_the_scalar_part() -> None:
    wxyz = np.array([[1.0, 2.0, 3.0, 4.0]])

    np.testing.assert_array_equal(quaternions.to_xyzw(wxyz), [[2, 3, 4, 1]])
    np.testing.assert_array_equal(quaternions.from_xyzw(quaternions.to_xyzw(wxyz)), wxyz)


@pytest.mark.parametrize("function", [quaternions.normalize, quaternions.canonical_sign, quaternions.to_matrix])
def test_quaternions__accept_no_rows(function) -> None:
    assert len(function(np.empty((0, 4), np.float32))) == 0
