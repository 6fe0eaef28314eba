"""How far a covariance can be off when its rotation and its scales are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def relative_covariance_bound(
    log_scales: NDArray[np.floating[Any]], scale_errors: NDArray[np.floating[Any]], angle: float
) -> NDArray[np.float64]:
    """Return the largest ||Sigma' - Sigma|| / ||Sigma||, Frobenius norms.

    Parameters
    ----------
    log_scales
        (N, 3) natural logs of the source's scales; -inf is flat.
    scale_errors
        Broadcastable to (N, 3): how far each log scale may move, up or down; inf where it may become flat.
    angle
        How far the rotation may turn, radians.

    Returns
    -------
    NDArray[np.float64]
        (N,). Where every axis is flat the covariance is 0 and so is the bound.

    Notes
    -----
    With D the turn and L the diagonal of squared scales, ||D L' D^T - L|| <= ||L' - L|| + ||D L D^T - L||. A squared
    scale moves by at most l (exp(2 e) - 1), or by l where it becomes flat. A turn by up to 90 degrees moves a traceless
    symmetric matrix by at most 2 sin(angle) of its norm, because its parts turn by at most twice the angle, and the
    traceless part of a covariance has at most sqrt(2/3) of the norm: tr(L)^2 >= ||L||^2.
    """
    logs = np.asarray(log_scales, np.float64)
    errors = np.broadcast_to(np.asarray(scale_errors, np.float64), logs.shape)
    longest = logs.max(axis=1, keepdims=True, initial=-np.inf)
    squares = np.exp(2 * (logs - np.where(np.isfinite(longest), longest, 0.0)))
    norms = np.linalg.norm(squares, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        moves = np.where(squares > 0, squares * np.where(np.isinf(errors), 1.0, np.expm1(2 * errors)), 0.0)
        stretched = np.linalg.norm(moves, axis=1) / norms
    turned = np.sqrt(8.0 / 3.0) * np.sin(min(angle, np.pi / 2))
    return np.where(norms > 0, stretched + turned, 0.0)


def covariance_bound_of_ranges(
    log_scales: NDArray[np.floating[Any]], low: NDArray[np.floating[Any]], high: NDArray[np.floating[Any]], angle: float
) -> NDArray[np.float64]:
    """Return the largest ||Sigma' - Sigma|| / ||Sigma|| where each log scale ends in a known interval.

    Parameters
    ----------
    log_scales
        (N, 3) natural logs of the source's scales; -inf is flat.
    low, high
        Broadcastable to (N, 3): where the decoded log scale lies, however far it was clamped.
    angle
        How far the rotation may turn, radians.

    Returns
    -------
    NDArray[np.float64]
        (N,). Where every axis is flat and may not stay so, inf.

    Notes
    -----
    As `relative_covariance_bound`, with each squared scale's own largest move.
    """
    logs = np.asarray(log_scales, np.float64)
    longest = logs.max(axis=1, keepdims=True, initial=-np.inf)
    longest = np.where(np.isfinite(longest), longest, 0.0)
    with np.errstate(over="ignore"):
        squares, lowest, highest = (np.exp(2 * (np.broadcast_to(ends, logs.shape) - longest)) for ends in (logs, low, high))
    norms = np.linalg.norm(squares, axis=1)
    moves = np.linalg.norm(np.maximum(np.abs(highest - squares), np.abs(squares - lowest)), axis=1)
    turned = np.sqrt(8.0 / 3.0) * np.sin(min(angle, np.pi / 2))
    stretched = np.divide(moves, norms, out=np.where(moves > 0, np.inf, 0.0), where=norms > 0)
    return np.asarray(np.where(norms > 0, stretched + turned, stretched))
