"""Coordinate systems named by axis letters, and the maps between them.

A system is three letters: where x, y and z point. R or L (right, left), U or D (up, down), F or B (front, back), one of
each pair in any order: 48 systems. RUB is three.js, RDF is COLMAP and 3DGS training, LUF is glTF, RUF is Unity, RFU is
Blender.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

UNKNOWN = "unknown"
"""Name of a system that nobody stated."""

Y_UP_OR_DOWN = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
"""The eight systems that differ from RUB by signs only, in the order of SPZ's numbers 1 to 8."""

Z_UP_OR_DOWN = ("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU")
"""The eight systems that need a turn about x as well, in the order of SPZ's numbers 9 to 16."""

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}


def is_known(system: str) -> bool:
    """Return whether `system` names one of the 48 systems; case matters."""
    axes = [_DIRECTIONS[letter] for letter in system if letter in _DIRECTIONS]
    return len(system) == len(axes) == 3 and abs(round(float(np.linalg.det(np.array(axes))))) == 1


def axis_directions(system: str) -> NDArray[np.float64]:
    """Return where the axes of a system point.

    Parameters
    ----------
    system
        Three axis letters; upper or lower case.

    Returns
    -------
    NDArray
        (3, 3) float64; row i is the direction of axis i as (right, up, front).

    Raises
    ------
    ValueError
        The letters do not name a coordinate system.
    """
    if not is_known(system.upper()):
        raise ValueError(f"expected three axis letters, one each of R/L, U/D and F/B, such as RUB or RDF, got {system!r}")
    return np.array([_DIRECTIONS[letter] for letter in system.upper()], np.float64)


def axis_map(source: str, target: str) -> NDArray[np.float64]:
    """Return the matrix that takes coordinates in one system to coordinates in another.

    Parameters
    ----------
    source, target
        Three axis letters each.

    Returns
    -------
    NDArray
        (3, 3) float64 signed permutation: target coordinates = matrix @ source coordinates. Its inverse is its transpose.

    Raises
    ------
    ValueError
        The letters do not name a coordinate system.
    """
    return axis_directions(target) @ axis_directions(source).T


def changes_signs_only(matrix: NDArray[np.float64]) -> bool:
    """Return whether a (3, 3) axis map keeps every axis but for its sign."""
    return bool(np.count_nonzero(np.diagonal(matrix)) == 3)


def changes_handedness(matrix: NDArray[np.float64]) -> bool:
    """Return whether a (3, 3) axis map is a reflection."""
    return bool(np.linalg.det(matrix) < 0)


def quaternion_signs(signs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the signs of w, x, y, z of a local-to-world quaternion when world axes change sign.

    Parameters
    ----------
    signs
        (3,) +-1 for x, y, z.

    Returns
    -------
    NDArray
        (4,) +-1.

    Notes
    -----
    With P the diagonal of the signs, the covariance P (R S S R^T) P is that of the rotation P R P, because P and S
    commute; its axis is the pseudovector det(P) P axis, which holds for reflections too.
    """
    x, y, z = signs
    return np.array([1.0, y * z, x * z, x * y])
