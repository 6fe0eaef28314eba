"""Bits where they show: a frame's codes moved to cheap neighbors, as far as the visual tolerance lets them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.codecs import relaxation
from gsplat_tools.ops.visibility import MAX_TURN, MOST, VisibleCosts

Float32 = NDArray[np.float32]


def positions(
    means: Float32, low: Float32, high: Float32, plain: NDArray[np.uint16], costs: VisibleCosts
) -> NDArray[np.uint16]:
    """Return codes of positions; `plain` are the nearest."""
    codes = plain.copy()
    for axis in range(3):
        step = (float(high[axis]) - float(low[axis])) / 65535
        if step > 0:
            targets = np.clip((means[:, axis].astype(np.float64) - float(low[axis])) / step, 0, 65535)
            codes[:, axis] = relaxation.relax_numbers(targets, costs.position * step**2, low=0, high=65535, most=MOST)
    return codes


def rotations(
    quats: Float32, is_fixed: NDArray[np.bool_] | None, plain: NDArray[np.uint8], costs: VisibleCosts
) -> NDArray[np.uint8]:
    """Return bytes of rotations; those that are fixed stay."""
    codes = relaxation.relax_rotations(quats, costs.rotation, plain, most=MOST, max_turn=MAX_TURN)
    if is_fixed is not None:
        codes[is_fixed] = plain[is_fixed]
    return codes
