"""Covariances of Gaussians: from quaternions and log scales, as six numbers or as matrices."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gsplat_tools.attributes import activations, quaternions

Floating = TypeVar("Floating", np.float32, np.float64)

_LARGEST_LOG = 350.0
"""Half of the largest logarithm in float64, with room for sums."""

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
        (N, 3, 3) world units squared, exactly symmetric. float32 overflows to inf from a log scale of 44.36; entries that
        are nothing beside those are 0 where float64 overflows too.
    """
    logs = log_scales.astype(np.float64)
    longest = logs.max(axis=1, keepdims=True, initial=-np.inf)
    # Beyond, squares overflow: they are taken relative to the longest axis, so that no infinities meet.
    unit = np.where((longest > _LARGEST_LOG) & np.isfinite(longest), longest, 0.0)
    halves = quaternions.to_matrix(quats.astype(np.float64)) * activations.exp_scales(logs - unit)[:, None, :]
    # One product an entry pair, so that both halves of the matrix have the same bits.
    upper = (halves[:, _UPPER[0], :] * halves[:, _UPPER[1], :]).sum(axis=2)
    with np.errstate(over="ignore", invalid="ignore"):
        upper = np.where(upper == 0, 0.0, upper * np.exp(2 * unit))
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


def decompose(triangles: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the rotations and sizes of covariances, from their eigenvectors.

    Parameters
    ----------
    triangles
        (N, 6) upper triangles xx, xy, xz, yy, yz, zz, world units squared.

    Returns
    -------
    tuple
        quats (N, 4) unit, wxyz · log_scales (N, 3), ascending. An eigenvalue of 0 or below, which rounding leaves of a
        thin axis, is a flat one: -inf. Covariances that are not finite have log scales of NaN.

    Notes
    -----
    Dropping what is negative does not move a matrix further from any covariance: covariances are a convex cone.
    """
    from gsplat_tools.kernels.symmetric_eigen import decompose as decompose_block

    is_finite = np.isfinite(triangles).all(axis=1)
    finite = np.where(is_finite[:, None], triangles, 0.0).astype(np.float64)
    values, exponents = np.empty((len(finite), 3)), np.empty(len(finite), np.int64)
    quats = np.empty((len(finite), 4), np.float32)
    decompose_block(finite, values, exponents, quats)
    with np.errstate(divide="ignore"):
        logs = 0.5 * (np.log(np.maximum(values, 0.0)) + exponents[:, None] * np.log(2.0))
    logs[~is_finite] = np.nan
    return quats, logs.astype(np.float32)
