"""Real spherical harmonics of degree 0 to 4 as 3DGS uses them: counts, basis, color, axis flips, rotations.

Coefficients are ordered by band l and, within a band, by m = -l..l; coefficient k of band l has m = k - l.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.constants import MAX_SH_DEGREE, SH_C0

C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
C4 = (
    2.5033429417967046,
    -1.7701307697799304,
    0.9461746957575601,
    -0.6690465435572892,
    0.10578554691520431,
    -0.6690465435572892,
    0.47308734787878004,
    -1.7701307697799304,
    0.6258357354491761,
)

_UNIT_ROUNDING = 4 * 2.0**-52


def num_bases(degree: int) -> int:
    """Return the number of basis functions up to a degree, (degree + 1)^2.

    Raises
    ------
    ValueError
        The degree is not in 0..4.
    """
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"the SH degree must be 0 to {MAX_SH_DEGREE}, got {degree}")
    return (degree + 1) ** 2


def band_slice(band: int) -> slice:
    """Return where band 1 to 4 stands along the second axis of `shN`, which leaves out the constant term."""
    return slice(band * band - 1, (band + 1) ** 2 - 1)


def evaluate_basis(directions: NDArray[np.floating], degree: int) -> NDArray[np.float64]:
    """Evaluate the orthonormal basis.

    Parameters
    ----------
    directions
        (N, 3) from the camera to the splat, of any length; zero is taken as +z, as renderers do.
    degree
        Highest band, 0 to 4.

    Returns
    -------
    NDArray
        (N, (degree + 1)^2) float64; NaN where a direction is not finite.

    Raises
    ------
    ValueError
        The degree is not in 0..4.

    Source
    ------
    Bands 0 to 3 with the signs of Kerbl et al. 2023; band 4 in the same convention (gsplat, SPZ).
    """
    basis = np.empty((len(directions), num_bases(degree)))
    x, y, z = np.moveaxis(_unit_vectors(np.asarray(directions, np.float64)), -1, 0)
    basis[:, 0] = SH_C0
    if degree >= 1:
        basis[:, 1:4] = np.stack([-C1 * y, C1 * z, -C1 * x], axis=1)
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        second = (x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy)
        basis[:, 4:9] = np.stack(second, axis=1) * C2
    if degree >= 3:
        third = (
            y * (3 * xx - yy),
            x * y * z,
            y * (4 * zz - xx - yy),
            z * (2 * zz - 3 * xx - 3 * yy),
            x * (4 * zz - xx - yy),
            z * (xx - yy),
            x * (xx - 3 * yy),
        )
        basis[:, 9:16] = np.stack(third, axis=1) * C3
    if degree >= 4:
        fourth = (
            x * y * (xx - yy),
            y * z * (3 * xx - yy),
            x * y * (6 * zz - xx - yy),
            y * z * (4 * zz - 3 * xx - 3 * yy),
            zz * (35 * zz - 30) + 3,
            x * z * (4 * zz - 3 * xx - 3 * yy),
            (xx - yy) * (6 * zz - xx - yy),
            x * z * (xx - 3 * yy),
            xx * (xx - 6 * yy) + yy * yy,
        )
        basis[:, 16:25] = np.stack(fourth, axis=1) * C4
    return basis


def _unit_vectors(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions of length 1, +z for zero; those that already are to the last place keep their bits."""
    largest = np.abs(directions).max(axis=-1, keepdims=True, initial=0.0)
    is_null = largest == 0
    # By the largest component first, so that no square overflows or vanishes.
    with np.errstate(invalid="ignore"):
        scaled = directions / np.where(is_null, 1.0, largest)
        lengths = np.sqrt((scaled * scaled).sum(axis=-1, keepdims=True))
        units = scaled / np.where(is_null, 1.0, lengths)
    is_unit = np.abs(lengths * largest - 1.0) <= _UNIT_ROUNDING
    return np.where(is_null, np.array([0.0, 0.0, 1.0]), np.where(is_unit, directions, units))


def evaluate_colors(
    sh0: NDArray[np.floating], shN: NDArray[np.floating], directions: NDArray[np.floating], *, degree: int | None = None
) -> NDArray[np.float64]:
    """Return the colors that splats show in given directions.

    Parameters
    ----------
    sh0
        (N, 3) constant term.
    shN
        (N, K - 1, 3) higher terms, basis-major.
    directions
        (N, 3) from the camera to the splat, in the frame of the cloud, of any length; zero is taken as +z.
    degree
        Highest band that is evaluated; by default all of them.

    Returns
    -------
    NDArray
        (N, 3) float64, SH + 0.5, not clamped.
    """
    available = int(np.sqrt(shN.shape[1] + 1)) - 1
    degree = available if degree is None else min(degree, available)
    basis = evaluate_basis(directions, degree)
    colors = 0.5 + SH_C0 * np.asarray(sh0, np.float64)
    for k in range(1, basis.shape[1]):
        colors += basis[:, k, None] * shN[:, k - 1]
    return colors


def flip_signs(signs: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the signs of SH coefficients when coordinate axes change sign.

    Parameters
    ----------
    signs
        (3,) +-1 for x, y, z.
    degree
        Highest band, 0 to 4.

    Returns
    -------
    NDArray
        ((degree + 1)^2,) +-1, the constant term included.

    Notes
    -----
    m > 0 goes with cos(m phi), m < 0 with sin(|m| phi). A flip of x maps phi to pi - phi: (-1)^m, and another -1 for
    sines; a flip of y maps phi to -phi: -1 for sines; a flip of z gives (-1)^(l + m).
    """
    x, y, z = signs
    result = np.ones(num_bases(degree))
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            is_sine = m < 0
            result[band * band + band + m] = (
                (x if (m % 2 == 1) != is_sine else 1.0) * (y if is_sine else 1.0) * (z if (band + m) % 2 else 1.0)
            )
    return result


def band_rotations(matrix: NDArray[np.floating], degree: int) -> list[NDArray[np.float64]]:
    """Return the matrices that act on SH coefficients when the splats are rotated or reflected.

    Parameters
    ----------
    matrix
        (3, 3) orthogonal matrix Q, a reflection or not, that takes old coordinates to new ones.
    degree
        Highest band, 0 to 4.

    Returns
    -------
    list of NDArray
        For each band l from 0: (2l + 1, 2l + 1) float64 orthogonal D, exact to 1e-14. New coefficients = D @ old ones
        give in direction Q d the color that the old ones gave in direction d.

    Notes
    -----
    D_jk is the integral of Y_j(d) Y_k(Q^T d) over the sphere. The integrand is a polynomial of degree 2l <= 8, for which
    the product rule below (Gauss-Legendre in z, evenly spaced in phi) is exact.
    """
    heights, weights = np.polynomial.legendre.leggauss(MAX_SH_DEGREE + 1)
    num_angles = 2 * MAX_SH_DEGREE + 1
    angles = 2 * np.pi / num_angles * np.arange(num_angles)
    radii = np.sqrt(1 - heights**2)
    directions = np.stack(
        [np.outer(radii, np.cos(angles)), np.outer(radii, np.sin(angles)), np.outer(heights, np.ones(num_angles))], axis=-1
    ).reshape(-1, 3)
    areas = np.repeat(weights * 2 * np.pi / num_angles, num_angles)
    new = evaluate_basis(directions, degree) * areas[:, None]
    old = evaluate_basis(directions @ np.asarray(matrix, np.float64), degree)
    rotations = []
    for band in range(degree + 1):
        part = slice(band * band, (band + 1) ** 2)
        rotation = new[:, part].T @ old[:, part]
        # Entries that are 0 or +-1 but for rounding become so, and axis maps stay as sparse as they are.
        nearest = np.round(rotation)
        rotations.append(np.where(np.abs(rotation - nearest) < 1e-14, nearest, rotation))
    return rotations


def rotate(shN: NDArray[np.float32], matrix: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the higher SH coefficients of splats that are rotated or reflected.

    Parameters
    ----------
    shN
        (N, K - 1, 3), basis-major.
    matrix
        (3, 3) orthogonal matrix that takes old coordinates to new ones.

    Returns
    -------
    NDArray
        (N, K - 1, 3) float32, computed in float64.
    """
    degree = int(np.sqrt(shN.shape[1] + 1)) - 1
    result = np.empty_like(shN)
    for band, rotation in enumerate(band_rotations(matrix, degree)[1:], start=1):
        old, new = shN[:, band_slice(band)], result[:, band_slice(band)]
        # Sums run in a fixed order over the entries that are not zero; a matrix product would promise neither.
        for j, row in enumerate(rotation):
            total = np.zeros((len(shN), 3))
            for k in np.flatnonzero(row):
                total += row[k] * old[:, k]
            new[:, j] = total
    return result
