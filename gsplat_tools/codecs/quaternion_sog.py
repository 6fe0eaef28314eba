"""Quaternions in four bytes: the three smaller components, and a tag 252 + index of the largest (SOG)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.codecs.smallest_three import Grid
from gsplat_tools.errors import CloudError
from gsplat_tools.parallel import run_blocks

GRID = Grid(steps=127.5 * np.sqrt(2.0), offset=0.5)
"""Eight bits over -sqrt(1/2)..sqrt(1/2)."""

FIRST_TAG = 252
"""Fourth byte where w is the largest component; smaller bytes mean the identity."""


def encode(quats: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Quantize rotations to four bytes, rounded to nearest.

    Parameters
    ----------
    quats
        (N, 4) wxyz, of any length; length 0 is taken as the identity.

    Returns
    -------
    NDArray[np.uint8]
        (N, 4): three components in the order of w, x, y, z without the largest (the first of equals), then the tag.

    Raises
    ------
    CloudError
        A component is not finite.
    """
    from gsplat_tools.kernels.quaternion_sog import quantize

    values = np.ascontiguousarray(quats, np.float32)
    if not np.isfinite(values).all():
        bad = int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        raise CloudError(f"{bad} of {len(values)} quaternions are not finite; drop them first", field="quats")
    codes = np.empty(values.shape, np.uint8)
    run_blocks(lambda start, stop: quantize(values[start:stop], codes[start:stop]), len(values))
    return codes


def encode_covariances(
    quats: NDArray[np.floating[Any]], log_scales: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Quantize rotations so that covariances err least: in the best of 24 frames, each component rounded down or up.

    Parameters
    ----------
    quats
        (N, 4) wxyz, finite, of any length; length 0 is taken as the identity.
    log_scales
        (N, 3); -inf is flat.

    Returns
    -------
    tuple
        (N, 4) codes, and the frame of each splat (`kernels.rotation_frames`), in which its scales are to be stored.
    """
    from gsplat_tools.kernels.quaternion_sog import quantize_covariances

    values, logs = np.ascontiguousarray(quats, np.float32), np.ascontiguousarray(log_scales, np.float32)
    codes, frames = np.empty(values.shape, np.uint8), np.empty(len(values), np.uint8)

    def choose(start: int, stop: int) -> None:
        part = slice(start, stop)
        quantize_covariances(values[part], logs[part], frames[part], codes[part])

    run_blocks(choose, len(values))
    return codes, frames


def decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the quaternions wxyz that (N, 4) codes stand for; a tag below 252 is the identity."""
    smaller, largest = _components(codes)
    tags = codes[:, 3].astype(np.int64) - FIRST_TAG
    quats = np.zeros((len(codes), 4), np.float32)
    for index in range(4):
        rows = np.flatnonzero(tags == index)
        quats[rows, index] = largest[rows]
        quats[rows[:, None], [k for k in range(4) if k != index]] = smaller[rows]
    quats[tags < 0] = (1, 0, 0, 0)
    return quats


def max_angle(codes: NDArray[np.uint8]) -> float:
    """Return the largest rotation error, radians, of the codes nearest to rotations whose components lie near these.

    Parameters
    ----------
    codes
        (N, 4) as `encode` or `encode_covariances` gives them: each component within a step of its source. Codes that
        are not the nearest were chosen because their covariance errs less than that of the nearest.

    Returns
    -------
    float
        At most `GRID.max_angle`, 1.12 degrees; less where every largest component is large.

    Notes
    -----
    As for `Grid.max_angle`: three components move by half a step each, together by e, and the component left out is at
    least sqrt(1 - v^2) on the way, v their length, which is at most that of the codes and three steps together.
    """
    smaller, _ = _components(codes)
    moved = np.sqrt(3.0) / (2 * GRID.steps)
    longest = np.sqrt(np.square(smaller).sum(axis=1).max(initial=0.0)) + 2 * moved
    left_out = np.sqrt(max(1 - longest**2, 0.0))
    return float(min(2 * moved / left_out if left_out > 0 else np.inf, GRID.max_angle))


def _components(codes: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the three components that are stored, (N, 3), and the one that is not, (N,)."""
    smaller = (codes[:, :3].astype(np.float64) - 127.5) / GRID.steps
    return smaller, np.sqrt(np.maximum(1.0 - np.square(smaller).sum(axis=1), 0.0))
