"""Where a moving splat is and how much of it shows, one splat and one number at a time, in plain Python."""

from __future__ import annotations

import math
from collections.abc import Sequence


def position(mean: Sequence[float], velocity: Sequence[float], time: float, t: float) -> list[float]:
    """Where the center is at time t."""
    return [mean[axis] + velocity[axis] * (t - time) for axis in range(3)]


def weight(time: float, duration: float, t: float, model: str, cutoff: float) -> float:
    """How much of the opacity is left at time t."""
    if model == "window":
        return 1.0 if time <= t <= time + duration else 0.0
    value = math.exp(-0.5 * ((t - time) / duration) ** 2)
    return 0.0 if value < cutoff else value


def baked_opacity(opacity: float, factor: float) -> float:
    """What a keyframe stores: nothing below one 255th."""
    return 0.0 if opacity * factor < 1 / 255 else opacity * factor


def mean_square_of_weights(first: Sequence[object], second: Sequence[object], steps: int = 20000) -> float:
    """Mean over [0, 1] of the squared difference of two (time, duration, model), by midpoints, without a cutoff."""
    total = 0.0
    for step in range(steps):
        t = (step + 0.5) / steps
        a, b = (weight(*entry[:2], t, entry[2], 0.0) for entry in (first, second))  # type: ignore[misc, arg-type]
        total += (a - b) ** 2
    return total / steps
