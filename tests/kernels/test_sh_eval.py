"""The basis of spherical harmonics, by integration over the sphere."""

import numpy as np
import pytest

from gsplat_tools.kernels.sh_eval import BAND_4_FIRST, evaluate_basis
from gsplat_tools.reference.models import MODELS

pytestmark = pytest.mark.uncompiled


def quadrature():  # type: ignore[no-untyped-def]
    """Directions and weights that integrate polynomials up to degree 11 over the sphere exactly."""
    z, z_weights = np.polynomial.legendre.leggauss(6)
    angles = 2 * np.pi * np.arange(12) / 12
    radii = np.sqrt(1 - z * z)
    directions = np.stack(
        [np.outer(radii, np.cos(angles)), np.outer(radii, np.sin(angles)), np.outer(z, np.ones(12))], axis=-1
    ).reshape(-1, 3)
    return directions, np.repeat(z_weights, 12) * (2 * np.pi / 12)


def gram(degree: int, first: float):  # type: ignore[no-untyped-def]
    directions, weights = quadrature()
    values = np.empty((len(directions), (degree + 1) ** 2))
    evaluate_basis(directions, degree, first, values)
    return np.einsum("n,ni,nj->ij", weights, values, values)


@pytest.mark.parametrize("degree", range(5))
def test_basis__is_orthonormal(degree: int) -> None:
    assert np.abs(gram(degree, BAND_4_FIRST) - np.eye((degree + 1) ** 2)).max() < 1e-12


def test_basis__of_gsplat_unity_has_one_term_at_a_quarter() -> None:
    product = gram(4, MODELS["unity"]["1.2.1"].band_4_first)
    wanted = np.eye(25)
    wanted[16, 16] = 1 / 16

    assert np.abs(product - wanted).max() < 1e-12
    assert all(
        model.band_4_first == BAND_4_FIRST
        for name, variants in MODELS.items()
        if name != "unity"
        for model in variants.values()
    )


def test_basis__has_the_signs_of_the_ply() -> None:
    values = np.empty((3, 4))
    evaluate_basis(np.eye(3), 1, BAND_4_FIRST, values)

    # Coefficients 1, 2, 3 go with -y, z, -x.
    assert np.allclose(values[:, 1:] / 0.4886025119029199, [[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
