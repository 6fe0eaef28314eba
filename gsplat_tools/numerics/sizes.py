"""Errors of scales as lengths: what logarithms cannot say of axes that become flat."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Bounds, Format

Float64 = NDArray[np.float64]

ATTRIBUTE = "scales (linear)"

_ARITHMETIC = 2.0**-40
"""What measuring adds in float64: rounding of exponents below a thousand, as a share of the lengths."""

_FLOAT32_HALF_STEP, _HALF_HALF_STEP = 2.0**-24, 2.0**-11
_EIGENVALUES = 1e-14
"""What float64 adds to eigenvalues and their covariance, relative to the largest."""

_LARGEST_LOG = 300.0

_STORED_COVARIANCES = {
    # By way of float32.
    "visionary-f16": (65504.0, _HALF_HALF_STEP + 2 * _FLOAT32_HALF_STEP, 2.0**-25 + 2.0**-150),
    "visionary-f32": (float(np.finfo(np.float32).max), _FLOAT32_HALF_STEP, 2.0**-150),
}
"""Largest number, half a step relative to the number, and half of the smallest step of what covariances are stored in."""


def _lengths(log_scales: Float64, units: Float64) -> Float64:
    with np.errstate(over="ignore"):
        return np.asarray(np.exp(log_scales - units))


def _sorted_logs(cloud: GaussianCloud) -> Float64:
    return np.sort(cloud.log_scales.astype(np.float64), axis=1)


def _units(logs: Float64) -> Float64:
    return np.maximum(logs[:, 2:], 0.0)


def size_errors(source: GaussianCloud, decoded: GaussianCloud) -> Float64:
    """Return how far sorted scales are off, (N, 3): world units, of splats longer than one as a share of their longest axis.

    Scales beyond the units of float64, as of splats that are 1e38 times too large, are infinitely off.
    """
    logs, others = _sorted_logs(source), _sorted_logs(decoded)
    return np.abs(_lengths(others, _units(logs)) - _lengths(logs, _units(logs)))


def size_limits(source: GaussianCloud, limits: Bounds, reach: tuple[Float64, Float64] | None = None) -> Float64:
    """Return the bounds of `size_errors`, (N, 3); inf where nothing gives one.

    Parameters
    ----------
    source
        What was written.
    limits
        Bounds of `scales` and `covariances`, as far as there are any.
    reach
        Between what sorted logarithms come back, where that is known beside their largest move: see `covariance_reach`.

    Notes
    -----
    A logarithm that moves by at most e leaves a length s within s (exp(e) - 1). A covariance that moves by E moves no
    eigenvalue by more than |E| (Weyl), and |s' - s|^2 <= |s'^2 - s^2|: lengths move by at most the root of it. The smallest
    one holds.
    """
    logs = _sorted_logs(source)
    units = _units(logs)
    lengths = _lengths(logs, units)
    bounds = np.full(logs.shape, np.inf)
    if "scales" in limits:
        moves = np.broadcast_to(np.asarray(limits["scales"], np.float64), logs.shape)
        with np.errstate(invalid="ignore"):
            grown = np.where(moves == 0, 0.0, _lengths(logs + moves, units) - lengths)
        bounds = np.where(np.isfinite(grown) & np.isfinite(moves), grown, np.inf)
    if "covariances" in limits:
        relative = np.broadcast_to(np.asarray(limits["covariances"], np.float64), len(logs))
        with np.errstate(invalid="ignore"):
            moved = np.sqrt(relative * np.linalg.norm(np.square(lengths), axis=1))
        bounds = np.fmin(bounds, np.where(np.isfinite(relative), moved, np.inf)[:, None])
    if reach is not None:
        shortest, longest = (_lengths(ends, units) for ends in reach)
        bounds = np.fmin(bounds, np.maximum(longest - lengths, lengths - shortest))
    return np.asarray(np.where(bounds > 0, bounds + _ARITHMETIC * lengths, 0.0))


def covariance_reach(log_scales: NDArray[np.float32], record: Format) -> tuple[Float64, Float64] | None:
    """Return the least and the largest that sorted log scales come back as, (N, 3), from formats that hold covariances.

    Returns
    -------
    tuple or None
        -inf for what may vanish; None for formats that hold scales.

    Notes
    -----
    A covariance whose largest entry is beyond the largest number L is shrunk as a whole until it is L. That entry is on the
    diagonal, between a third of the largest eigenvalue and all of it, so that eigenvalues shrink to between L and 3 L of the
    largest. Entries are then rounded, together by at most their norm times half a step, or three times half of the smallest
    step; no eigenvalue moves by more (Weyl). Logarithms are rounded to float32. Encoders cut logarithms off at 300.
    """
    if record.id not in _STORED_COVARIANCES:
        return None
    largest, half_step, least = _STORED_COVARIANCES[record.id]
    logs = np.minimum(np.sort(log_scales.astype(np.float64), axis=1), _LARGEST_LOG)
    top = logs[:, 2:]
    shrunk_low, shrunk_high = (np.minimum(0.0, 0.5 * np.log(share * largest) - top) for share in (1.0, 3.0))
    noise = (np.sqrt(3.0) * half_step + _EIGENVALUES) * np.exp(2 * (top + shrunk_high)) + 3 * least
    with np.errstate(divide="ignore"):
        low = 0.5 * np.log(np.maximum(np.exp(2 * (logs + shrunk_low)) - noise, 0.0))
        high = 0.5 * np.log(np.exp(2 * (logs + shrunk_high)) + noise)
    rounding = _FLOAT32_HALF_STEP * (1 + 1e-6)
    return low - np.where(np.isfinite(low), np.abs(low), 0.0) * rounding, high + np.abs(high) * rounding


def reach_limits(source: GaussianCloud, reach: tuple[Float64, Float64]) -> Float64:
    """Return how far sorted logarithms may move, (N, 3), to the farther end of their reach; inf where there is none."""
    logs = _sorted_logs(source)
    with np.errstate(invalid="ignore"):
        moves = np.maximum(reach[1] - logs, logs - reach[0])
    return np.asarray(np.nan_to_num(moves, nan=np.inf, posinf=np.inf))
