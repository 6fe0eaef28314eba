from __future__ import annotations

import itertools

import mpmath
import numpy as np
import pytest

from gsplat_tools.attributes import quaternions
from gsplat_tools.attributes import spherical_harmonics as sh


def _directions(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _definition(direction: np.ndarray, band: int, m: int) -> float:
    """Return the real harmonic from associated Legendre functions with the Condon-Shortley phase."""
    x, y, z = direction
    k = abs(m)
    norm = mpmath.sqrt((2 * band + 1) / (4 * mpmath.pi) * mpmath.factorial(band - k) / mpmath.factorial(band + k))
    legendre = mpmath.re(mpmath.legenp(band, k, float(z)))
    phi = mpmath.atan2(float(y), float(x))
    angular = 1 if m == 0 else mpmath.sqrt(2) * (mpmath.cos(k * phi) if m > 0 else mpmath.sin(k * phi))
    return float(norm * legendre * angular)


def test_evaluate_basis__is_the_textbook_definition() -> None:
    directions = _directions(5)

    basis = sh.evaluate_basis(directions, 4)

    orders = [(band, m) for band in range(5) for m in range(-band, band + 1)]
    expected = [[_definition(direction, band, m) for band, m in orders] for direction in directions]
    np.testing.assert_allclose(basis, expected, atol=1e-14)


def test_evaluate_basis__is_orthonormal_by_quadrature() -> None:
    heights, weights = np.polynomial.legendre.leggauss(12)
    angles = np.arange(24) * 2 * np.pi / 24
    z, phi = (grid.ravel() for grid in np.meshgrid(heights, angles, indexing="ij"))
    areas = np.repeat(weights, 24) * 2 * np.pi / 24
    r = np.sqrt(1 - z * z)

    basis = sh.evaluate_basis(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 4)

    # 288 products of at most 0.8 with weights of at most 0.07, rounded in float64.
    np.testing.assert_allclose(basis.T @ (basis * areas[:, None]), np.eye(25), rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", range(5))
def test_evaluate_basis__of_a_lower_degree_is_a_prefix(degree: int) -> None:
    directions = _directions(7)

    np.testing.assert_array_equal(
        sh.evaluate_basis(directions, degree), sh.evaluate_basis(directions, 4)[:, : (degree + 1) ** 2]
    )


def test_evaluate_colors__sums_coefficients_and_adds_one_half() -> None:
    rng = np.random.default_rng(3)
    directions, sh0, shN = _directions(9), rng.normal(size=(9, 3)), rng.normal(size=(9, 24, 3))

    colors = sh.evaluate_colors(sh0, shN, directions)

    coefficients = np.concatenate([sh0[:, None], shN], axis=1)
    np.testing.assert_allclose(
        colors, np.einsum("nk,nkc->nc", sh.evaluate_basis(directions, 4), coefficients) + 0.5, atol=1e-13
    )
    np.testing.assert_allclose(sh.evaluate_colors(sh0, shN, directions, degree=0), 0.5 + sh0 * 0.28209479177387814, rtol=1e-15)


@pytest.mark.parametrize("signs", list(itertools.product([1.0, -1.0], repeat=3)))
def test_flip_signs__are_what_the_basis_does(signs: tuple[float, float, float]) -> None:
    directions = _directions(11)

    flipped = sh.evaluate_basis(directions * signs, 4)

    np.testing.assert_allclose(flipped, sh.evaluate_basis(directions, 4) * sh.flip_signs(np.array(signs), 4), atol=1e-14)


@pytest.mark.parametrize("handedness", [1, -1])
def test_band_rotations__move_the_color_with_the_direction(handedness: int) -> None:
    directions = _directions(30)
    matrix = handedness * quaternions.to_matrix(np.random.default_rng(8).normal(size=(1, 4)))[0]
    coefficients = np.random.default_rng(9).normal(size=25)

    rotations = sh.band_rotations(matrix, 4)

    moved = np.concatenate([rotations[band] @ coefficients[band**2 : (band + 1) ** 2] for band in range(5)])
    old = sh.evaluate_basis(directions, 4) @ coefficients
    np.testing.assert_allclose(sh.evaluate_basis(directions @ matrix.T, 4) @ moved, old, atol=1e-13)
    for rotation in rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(len(rotation)), atol=1e-14)


@pytest.mark.parametrize("signs", list(itertools.product([1.0, -1.0], repeat=3)))
def test_band_rotations__of_axis_flips_are_exactly_signs(signs: tuple[float, float, float]) -> None:
    rotations = sh.band_rotations(np.diag(signs), 4)

    found = np.concatenate([np.diagonal(rotation) for rotation in rotations])
    np.testing.assert_array_equal(found, sh.flip_signs(np.array(signs), 4))
    assert all(np.count_nonzero(rotation) == len(rotation) for rotation in rotations)


def test_rotate__acts_on_every_band_of_every_splat() -> None:
    shN = np.random.default_rng(4).normal(size=(6, 24, 3)).astype(np.float32)
    matrix = quaternions.to_matrix(np.random.default_rng(5).normal(size=(1, 4)))[0]

    found = sh.rotate(shN, matrix)

    expected = np.concatenate(
        [
            np.einsum("jk,nkc->njc", d, shN[:, b * b - 1 : (b + 1) ** 2 - 1])
            for b, d in enumerate(sh.band_rotations(matrix, 4))
            if b
        ],
        axis=1,
    )
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert found.dtype == np.float32
    assert sh.rotate(shN[:, :0], matrix).shape == (6, 0, 3)


def test_num_bases__refuses_degrees_that_do_not_exist() -> None:
    for degree in (-1, 5):
        with pytest.raises(ValueError, match="0 to 4"):
            sh.num_bases(degree)
