"""Codes moved to cheap neighbors: the choice of code with the smallest sum of bits and of what the error shows.

Bits are those of an entropy coder with one table for the whole stream, estimated from the codes themselves, a few rounds
of choosing and counting; what an error shows is cost x distance^2 (`ops.visibility`). No code shows more than a given most
unless it is the nearest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.parallel import run_blocks

Float64 = NDArray[np.float64]

_ROUNDS = 3
# A code that is not in use costs 4 bits more than one that is used once.
_UNUSED = 1 / 16
# Leaving the high byte costs a high byte that its neighbors do not predict.
_CARRY_BITS = 3.0
_COLOR_REACH = 32
_TRIED_LABELS = 512
_FIRST_LEVELS = 7
_BLOCK = 1 << 13


def code_bits(codes: NDArray[np.integer[Any]], size: int = 256) -> NDArray[np.float32]:
    """Return the length of each code in bits, (size,), from how often it occurs."""
    counts = np.bincount(np.ravel(codes), minlength=size)[:size] + _UNUSED
    return np.asarray(-np.log2(counts / counts.sum()), np.float32)


def relax_numbers(targets: Float64, costs: Float64, *, low: int, high: int, most: float) -> NDArray[np.int64]:
    """Return integers near targets whose low bytes compress.

    Parameters
    ----------
    targets
        (N,) numbers in [low, high].
    costs
        (N,) bits per squared step, positive.
    low, high
        Range of the integers.
    most
        Largest cost x distance^2 of a number that is not the nearest.
    """
    from gsplat_tools.kernels import relaxation

    targets, costs = np.ascontiguousarray(targets, np.float64), np.ascontiguousarray(costs, np.float64)
    # Multiples of a power of two that suits each number break the symmetry: all low bytes are equally frequent at first.
    # The error of a step s, s^2 / 12, then costs what the next bit would: 1 / (2 ln 2).
    levels = np.clip(np.floor(np.log2(12 / (2 * np.log(2)) / costs) / 2), 0, _FIRST_LEVELS)
    steps = np.exp2(levels)
    codes: NDArray[np.int64] = np.clip(np.rint(targets / steps) * steps, low, high).astype(np.int64)
    for _ in range(_ROUNDS):
        bits = code_bits(codes & 255)
        _fill(codes, relaxation.relax_numbers, targets, costs, bits, _CARRY_BITS, most, low, high)
    return codes


def relax_colors(
    targets: NDArray[np.float32], costs: Float64, codebook: NDArray[np.float32], codes: NDArray[np.uint8], *, most: float
) -> NDArray[np.uint8]:
    """Return indices of red, green and blue near the targets that compress where green is subtracted from the others.

    Parameters
    ----------
    targets
        (N, 3) values.
    costs
        (N,) bits per squared value, positive.
    codebook
        (K,) ascending, at most 256 entries.
    codes
        (N, 3) the nearest entries.
    most
        Largest cost x distance^2 in one channel of an entry that is not the nearest.
    """
    from gsplat_tools.kernels import relaxation

    targets, costs = np.ascontiguousarray(targets, np.float32), np.ascontiguousarray(costs, np.float64)
    nearest = np.ascontiguousarray(codes, np.uint8)
    chosen = nearest.copy()
    for _ in range(_ROUNDS):
        bits = np.stack(
            [code_bits(chosen[:, 0] - chosen[:, 1]), code_bits(chosen[:, 1]), code_bits(chosen[:, 2] - chosen[:, 1])]
        )
        chosen = nearest.copy()
        _fill(chosen, relaxation.relax_colors, targets, costs, codebook, bits, _COLOR_REACH, most)
    return chosen


def relax_rotations(
    quats: NDArray[np.float32], costs: Float64, codes: NDArray[np.uint8], *, most: float, max_turn: float
) -> NDArray[np.uint8]:
    """Return bytes w x y z, (b - 128) a component, near rotations, that compress.

    Parameters
    ----------
    quats
        (N, 4) wxyz, any length but 0.
    costs
        (N, 3) bits per squared radian about each local axis, positive.
    codes
        (N, 4) where the search starts: codes of these rotations.
    most
        Largest cost of codes that are not those.
    max_turn
        Sine of half the largest angle of codes that are not those.
    """
    from gsplat_tools.kernels import relaxation

    wide = quats.astype(np.float64)
    lengths = np.linalg.norm(wide, axis=1, keepdims=True)
    wide = np.where(lengths > 0, wide / np.where(lengths > 0, lengths, 1.0), (1.0, 0.0, 0.0, 0.0))
    costs = np.ascontiguousarray(costs, np.float64)
    start_codes = np.ascontiguousarray(codes, np.uint8)
    chosen = start_codes.copy()
    for _ in range(_ROUNDS):
        bits = np.stack([code_bits(chosen[:, k]) for k in range(4)])
        chosen = start_codes.copy()
        _fill(chosen, relaxation.relax_rotations, wide, costs, bits, most, max_turn)
    return chosen


def relax_labels(
    points: NDArray[np.float32],
    costs: Float64,
    centroids: NDArray[np.float32],
    labels: NDArray[np.integer[Any]],
    *,
    most: float,
) -> NDArray[np.int64]:
    """Return entries near the points whose labels compress.

    Parameters
    ----------
    points
        (N, D).
    costs
        (N,) bits per squared distance, positive.
    centroids
        (K, D).
    labels
        (N,) the nearest entries.
    most
        Largest cost that is added to that of the nearest.

    Notes
    -----
    Only the most frequent entries are tried: the others save little.
    """
    from gsplat_tools.kernels import relaxation

    points, centroids = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(centroids, np.float32)
    costs = np.ascontiguousarray(costs, np.float64)
    nearest = np.ascontiguousarray(labels, np.int64)
    chosen = nearest
    for _ in range(_ROUNDS):
        bits = code_bits(chosen, len(centroids))
        order = np.argsort(bits, kind="stable")[:_TRIED_LABELS]
        chosen = nearest.copy()
        _fill(chosen, relaxation.relax_labels, points, costs, centroids, bits, order, most)
    return chosen


def _fill(codes: NDArray[Any], kernel: Callable[..., Any], *arguments: Any) -> None:
    """Run a kernel over blocks of its last argument."""
    run_blocks(lambda start, stop: kernel(*arguments, start, stop, codes), len(codes), _BLOCK)
