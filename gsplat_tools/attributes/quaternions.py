"""Quaternions wxyz (local to world): normalize, multiply, to and from rotation matrices, other orders.

float32 comes out as float32 and is computed in float64 in between; float64 stays float64.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floating = TypeVar("Floating", np.float32, np.float64)


def normalize(quats: NDArray[Floating]) -> NDArray[Floating]:
    """Return unit quaternions.

    Parameters
    ----------
    quats
        (N, 4) wxyz, any length.

    Returns
    -------
    NDArray
        (N, 4) of unit length; the identity where the length is zero, NaN where a component is not finite.
    """
    wide = quats.astype(np.float64)
    # Halving by the largest component keeps the squares of float64 input in range.
    largest = np.abs(wide).max(axis=-1, keepdims=True, initial=0.0)
    is_null = largest == 0
    with np.errstate(invalid="ignore"):
        wide /= np.where(is_null, 1.0, largest)
        wide /= np.where(is_null, 1.0, np.sqrt((wide * wide).sum(axis=-1, keepdims=True)))
    return np.where(is_null, np.array([1.0, 0.0, 0.0, 0.0]), wide).astype(quats.dtype)


def canonical_sign(quats: NDArray[Floating]) -> NDArray[Floating]:
    """Return the one of q and -q whose first component that is not zero is positive.

    Parameters
    ----------
    quats
        (N, 4) wxyz.

    Returns
    -------
    NDArray
        (N, 4), each row unchanged or negated, hence without rounding.
    """
    is_negative = np.zeros(quats.shape[:-1], np.bool_)
    undecided = np.ones(quats.shape[:-1], np.bool_)
    for i in range(4):
        is_negative |= undecided & (quats[..., i] < 0)
        undecided &= quats[..., i] == 0
    return np.where(is_negative[..., None], -quats, quats)


def multiply(left: NDArray[np.floating], right: NDArray[Floating]) -> NDArray[Floating]:
    """Return the Hamilton product: the rotation `right` followed by `left`.

    Parameters
    ----------
    left, right
        (N, 4) wxyz each, or (4,), which is used for every row.

    Returns
    -------
    NDArray
        (N, 4) in the dtype of `right`; lengths multiply.
    """
    aw, ax, ay, az = np.moveaxis(np.asarray(left, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(right, np.float64), -1, 0)
    product = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return np.stack(product, axis=-1).astype(right.dtype)


def to_matrix(quats: NDArray[Floating]) -> NDArray[Floating]:
    """Return the rotation matrices of quaternions, which are normalized first.

    Parameters
    ----------
    quats
        (N, 4) wxyz, any length; zero is taken as the identity.

    Returns
    -------
    NDArray
        (N, 3, 3); column i is the local axis i in world coordinates.
    """
    w, x, y, z = np.moveaxis(normalize(quats.astype(np.float64)), -1, 0)
    matrices = np.empty((*quats.shape[:-1], 3, 3))
    matrices[..., 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[..., 0, 1] = 2 * (x * y - w * z)
    matrices[..., 0, 2] = 2 * (x * z + w * y)
    matrices[..., 1, 0] = 2 * (x * y + w * z)
    matrices[..., 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[..., 1, 2] = 2 * (y * z - w * x)
    matrices[..., 2, 0] = 2 * (x * z - w * y)
    matrices[..., 2, 1] = 2 * (y * z + w * x)
    matrices[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return matrices.astype(quats.dtype)


def from_matrix(matrices: NDArray[Floating]) -> NDArray[Floating]:
    """Return the unit quaternions of rotation matrices.

    Parameters
    ----------
    matrices
        (N, 3, 3) orthonormal with determinant +1.

    Returns
    -------
    NDArray
        (N, 4) wxyz with the sign of `canonical_sign`.

    Notes
    -----
    The symmetric products q_i q_j are linear in the matrix; the row with the largest q_i^2 (at least 1/4) is divided by
    its length, so that nothing cancels.

    Source
    ------
    Shepperd 1978, Quaternion from rotation matrix.
    """
    m: NDArray[np.float64] = matrices.astype(np.float64)
    products = np.empty((*m.shape[:-2], 4, 4))
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    for i, diagonal in enumerate((1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)):
        products[..., i, i] = diagonal
    pairs = {
        (0, 1): m[..., 2, 1] - m[..., 1, 2],
        (0, 2): m[..., 0, 2] - m[..., 2, 0],
        (0, 3): m[..., 1, 0] - m[..., 0, 1],
        (1, 2): m[..., 0, 1] + m[..., 1, 0],
        (1, 3): m[..., 0, 2] + m[..., 2, 0],
        (2, 3): m[..., 1, 2] + m[..., 2, 1],
    }
    for (i, j), value in pairs.items():
        products[..., i, j] = products[..., j, i] = value
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    rows = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    return canonical_sign(normalize(rows)).astype(matrices.dtype)


def from_xyzw(quats_xyzw: NDArray[Floating]) -> NDArray[Floating]:
    """Return (N, 4) quaternions with the scalar part moved from last to first."""
    return np.roll(quats_xyzw, 1, axis=-1)


def to_xyzw(quats: NDArray[Floating]) -> NDArray[Floating]:
    """Return (N, 4) quaternions with the scalar part moved from first to last."""
    return np.roll(quats, -1, axis=-1)
