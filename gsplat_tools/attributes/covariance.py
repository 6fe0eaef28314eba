"""Covariances of Gaussians: from quaternions and log scales, as six numbers or as matrices."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gsplat_tools.attributes import activations, quaternions

Floating = TypeVar("Floating", np.float32, np.float64)

_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
_FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


def covariance_matrices(
    quats: NDArray[np.float32] | NDArray[np.float64],
    log_scales: NDArray[np.float32] | NDArray[np.float64],
    *,
    dtype: DTypeLike = np.float32,
) -> NDArray[np.floating]:
    """Return the covariances R S S R^T as matrices.

    Parameters
    ----------
    quats
        (N, 4) wxyz, any length; normalized here.
    log_scales
        (N, 3) natural logarithm of the standard deviations in world units; -inf is a flat axis.
    dtype
        Of the result; everything is computed in float64.

    Returns
    -------
    NDArray
        (N, 3, 3) world units squared, exactly symmetric. float32 overflows to inf from a log scale of 44.36.
    """
    halves = quaternions.to_matrix(quats.astype(np.float64)) * activations.exp_scales(log_scales.astype(np.float64))[:, None, :]
    # One product an entry pair, so that both halves of the matrix have the same bits.
    upper = (halves[:, _UPPER[0], :] * halves[:, _UPPER[1], :]).sum(axis=2)
    with np.errstate(over="ignore"):
        return to_matrices(upper.astype(dtype))


def covariance_triangles(
    quats: NDArray[np.float32] | NDArray[np.float64],
    log_scales: NDArray[np.float32] | NDArray[np.float64],
    *,
    dtype: DTypeLike = np.float32,
) -> NDArray[np.floating]:
    """Return the covariances R S S R^T as their upper triangles.

    Parameters
    ----------
    quats
        (N, 4) wxyz, any length; normalized here.
    log_scales
        (N, 3) natural logarithm of the standard deviations in world units; -inf is a flat axis.
    dtype
        Of the result; everything is computed in float64.

    Returns
    -------
    NDArray
        (N, 6) world units squared: xx, xy, xz, yy, yz, zz.
    """
    return to_triangles(covariance_matrices(quats, log_scales, dtype=dtype))


def to_triangles(matrices: NDArray[Floating]) -> NDArray[Floating]:
    """Return (N, 6) upper triangles xx, xy, xz, yy, yz, zz of (N, 3, 3) symmetric matrices."""
    return np.ascontiguousarray(matrices[..., _UPPER[0], _UPPER[1]])


def to_matrices(triangles: NDArray[Floating]) -> NDArray[Floating]:
    """Return (N, 3, 3) symmetric matrices of (N, 6) upper triangles xx, xy, xz, yy, yz, zz."""
    return triangles[..., _FULL]
