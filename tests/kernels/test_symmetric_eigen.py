"""Eigenvalues and rotations of symmetric matrices against numpy's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_tools.kernels.symmetric_eigen import decompose

FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


def decomposed(triangles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float32]]:
    values, exponents = np.empty((len(triangles), 3)), np.empty(len(triangles), np.int64)
    quats = np.empty((len(triangles), 4), np.float32)
    decompose(triangles, values, exponents, quats)
    return values, exponents, quats


def rotations(quats: NDArray[np.float32]) -> NDArray[np.float64]:
    w, x, y, z = (quats.astype(np.float64) / np.linalg.norm(quats.astype(np.float64), axis=1)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def needles(rng: np.random.Generator) -> NDArray[np.float64]:
    axes = np.linalg.qr(rng.normal(size=(300, 3, 3)))[0]
    matrices = (axes * np.exp(rng.uniform(-40, 0, (300, 1, 3)))) @ axes.transpose(0, 2, 1)
    return np.ascontiguousarray(matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


@pytest.mark.uncompiled
@pytest.mark.parametrize("name", ["any", "needles", "halves", "diagonal", "nearly diagonal", "equal", "huge", "subnormal"])
def test_decompose__agrees_with_numpy(name: str, rng: np.random.Generator) -> None:
    any_, diagonal = rng.normal(size=(300, 6)), np.array([1.0, 0, 0, 1, 0, 1])
    triangles = {
        "any": any_,
        "needles": needles(rng),
        "halves": needles(rng).astype(np.float16).astype(np.float64),
        "diagonal": any_ * diagonal,
        "nearly diagonal": any_ * np.where(diagonal, 1.0, 1e-9),
        "equal": np.repeat([[2.0, 1, 1, 2, 1, 2], [3.0, 0, 0, 3, 0, 3], [0.0, 1, 0, 0, 0, 0]], 4, axis=0),
        "huge": any_ * 1e307,
        "subnormal": any_ * 1e-315,
    }[name]

    values, exponents, quats = decomposed(triangles)

    matrices = np.ldexp(triangles, -exponents[:, None])[:, FULL]
    assert 0.5 <= np.abs(matrices).max() <= 1
    assert np.abs(values - np.linalg.eigvalsh(matrices)).max() < 5e-15
    assert (np.diff(values, axis=1) >= 0).all()
    axes = rotations(quats)
    # Quaternions are float32, off by 2^-24 in each of four components: the matrix turns by less than 2^-22.
    assert np.abs((axes * values[:, None, :]) @ axes.transpose(0, 2, 1) - matrices).max() < 3 * 2.0**-22


@pytest.mark.uncompiled
def test_decompose__keeps_digits_of_eigenvalues_far_below_the_largest() -> None:
    # Eigenvectors in the plane of x and z, turned by 45 degrees, and y on its own.
    triangles = np.array([[0.5, 0, 0.5, 1e-30, 0, 0.5], [1.0, 1e-16, 0, 1e-20, 0, 0]])

    values, exponents, _ = decomposed(triangles)

    assert np.ldexp(values[0], exponents[0]) == pytest.approx([0, 1e-30, 1], rel=1e-15, abs=1e-45)
    # Determinant of the upper block: 1e-20 - 1e-32.
    assert np.ldexp(values[1], exponents[1]) == pytest.approx([0, 1e-20, 1], rel=2e-12, abs=1e-45)


@pytest.mark.uncompiled
def test_decompose__of_nothing_is_the_identity() -> None:
    values, _, quats = decomposed(np.zeros((1, 6)))

    np.testing.assert_array_equal(values, np.zeros((1, 3)))
    np.testing.assert_array_equal(quats, np.float32([[1, 0, 0, 0]]))


@pytest.mark.uncompiled
@pytest.mark.parametrize("variances", [(1, 2, 3), (1, 3, 2), (2, 1, 3), (2, 3, 1), (3, 1, 2), (3, 2, 1)], ids=str)
def test_decompose__sorts_axes_by_rotations(variances: tuple[float, float, float]) -> None:
    values, exponents, quats = decomposed(np.array([[variances[0], 0.0, 0, variances[1], 0, variances[2]]]))

    np.testing.assert_array_equal(np.ldexp(values[0], exponents[0]), [1, 2, 3])
    axes = rotations(quats)[0]
    assert np.linalg.det(axes) == pytest.approx(1, abs=1e-6)
    assert np.abs(axes[list(np.argsort(variances)), range(3)]) == pytest.approx(1, abs=1e-6)
