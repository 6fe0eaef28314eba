from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.attributes import covariance, quaternions


def test_covariance__of_an_axis_aligned_splat_is_its_squared_scales() -> None:
    triangles = covariance.covariance_triangles(np.float32([[2, 0, 0, 0]]), np.log(np.float32([[1, 2, 3]])))

    np.testing.assert_allclose(triangles, [[1, 0, 0, 4, 0, 9]], rtol=3e-7)
    assert triangles.dtype == np.float32


def test_covariance__has_the_squared_scales_as_eigenvalues_along_the_axes() -> None:
    rng = np.random.default_rng(0)
    quats, log_scales = rng.normal(size=(40, 4)), rng.uniform(-3, 1, (40, 3))

    matrices = covariance.covariance_matrices(quats, log_scales, dtype=np.float64)

    axes = quaternions.to_matrix(quats)
    np.testing.assert_allclose(matrices @ axes, axes * np.exp(2 * log_scales)[:, None, :], atol=1e-14)
    np.testing.assert_array_equal(matrices, matrices.transpose(0, 2, 1))


def test_covariance__keeps_flat_axes_and_overflows_to_infinity_without_warning() -> None:
    log_scales = np.float32([[-np.inf, 0, 0], [45, 0, 0]])

    triangles = covariance.covariance_triangles(np.float32([[1, 0, 0, 0]] * 2), log_scales)

    np.testing.assert_array_equal(triangles, np.float32([[0, 0, 0, 1, 0, 1], [np.inf, 0, 0, 1, 0, 1]]))


def test_triangles__and_matrices_are_the_same_numbers() -> None:
    triangles = np.arange(12.0).reshape(2, 6)

    matrices = covariance.to_matrices(triangles)

    np.testing.assert_array_equal(matrices[0], [[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    np.testing.assert_array_equal(covariance.to_triangles(matrices), triangles)


def test_decompose__gives_back_covariances_and_sorted_scales(rng: np.random.Generator) -> None:
    quats, log_scales = rng.normal(size=(500, 4)), rng.uniform(-6, 3, (500, 3))
    triangles = covariance.covariance_triangles(quats, log_scales, dtype=np.float64)

    found_quats, found_scales = covariance.decompose(triangles)
    back = covariance.covariance_triangles(found_quats, found_scales, dtype=np.float64)

    assert np.abs(found_scales - np.sort(log_scales, axis=1)).max() < 1e-5
    assert np.linalg.norm(found_quats, axis=1) == pytest.approx(np.ones(500), abs=1e-6)
    assert (np.abs(back - triangles).max(axis=1) <= 4e-6 * np.abs(triangles).max(axis=1)).all()


def test_decompose__of_flat_tiny_and_broken_covariances() -> None:
    triangles = np.array(
        [[4, 0, 0, 1, 0, 0], [1, 0, 0, 1, 0, -0.5], [0, 0, 0, 0, 0, 0], [1e-44, 0, 0, 1e-44, 0, 1e-44], [np.inf, 0, 0, 1, 0, 1]]
    )

    quats, log_scales = covariance.decompose(triangles)

    assert log_scales[0] == pytest.approx([-np.inf, 0, np.log(2)])
    assert log_scales[1] == pytest.approx([-np.inf, 0, 0])
    assert np.isneginf(log_scales[2]).all()
    assert log_scales[3] == pytest.approx([0.5 * np.log(1e-44)] * 3)
    assert np.isnan(log_scales[4]).all()
    assert np.isfinite(quats).all()
