"""Our int8 for Visionary's pipeline: channels of signed bytes, each with a scale and a zero point.

value = zero + scale q, as Visionary's shader decodes int8 colors: the zero point is added in the units of the value. Ranges
are symmetric, q in -127..127; -128 stands for log scale -inf, a flat axis. Positions have ranges of their own for every
block of BLOCK splats. The axes of a splat are sorted, longest first, so that each rank has a range of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.codecs import quaternion_u8
from gsplat_tools.parallel import run_blocks

Float32 = NDArray[np.float32]

BLOCK = 256
"""Splats that share the ranges of their positions."""

LEVEL = 127
"""Largest code of a byte; the ranges of positions in 16 bits reach to 32767."""

FLAT = -128
"""Code of log scale -inf."""

SAMPLE = 1 << 15
"""Splats at most that ranges are calibrated on, evenly spaced."""

_LOW_SHARES = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.05, 0.1, 0.2, 0.3)
_HIGH_SHARES = (0.0, 1e-5, 1e-4, 1e-3, 1e-2)
_STEPS = 12
_SLACK = 2.0**-22
_LEAST_SPAN = 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class Ranges:
    """Scales and zero points, one a channel.

    Parameters
    ----------
    scales, zeros
        (C,) float32; channel c holds zeros[c] + scales[c] q.
    level
        Largest |q|.
    """

    scales: Float32
    zeros: Float32
    level: int = LEVEL

    @property
    def max_error(self) -> NDArray[np.float64]:
        """Largest error inside of each range, (C,): half a step."""
        return np.asarray(self.scales.astype(np.float64) / 2)

    @property
    def low(self) -> NDArray[np.float64]:
        """Smallest value of each channel, (C,)."""
        return np.asarray(self.zeros.astype(np.float64) - self.level * self.scales.astype(np.float64))

    @property
    def high(self) -> NDArray[np.float64]:
        """Largest value of each channel, (C,)."""
        return np.asarray(self.zeros.astype(np.float64) + self.level * self.scales.astype(np.float64))

    def encode(self, values: NDArray[Any]) -> tuple[NDArray[np.int64], int]:
        """Return the codes of finite values (N, C), and how many were clamped to their range."""
        steps = (values.astype(np.float64) - self.zeros) / self.scales.astype(np.float64)
        codes = np.rint(np.clip(steps, -self.level, self.level)).astype(np.int64)
        return codes, int(np.count_nonzero(np.abs(steps) > self.level + 0.5))

    def decode(self, codes: NDArray[Any]) -> Float32:
        """Return the values of codes (N, C)."""
        return np.asarray(self.zeros + self.scales.astype(np.float64) * codes, np.float32)


def make_ranges(low: NDArray[Any], high: NDArray[Any], level: int = LEVEL) -> Ranges:
    """Return ranges that hold [low, high] of every channel, (C,) each, in spite of the rounding to float32."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    zeros = ((low + high) / 2).astype(np.float32)
    span = high - low + _SLACK * np.maximum(np.abs(low), np.abs(high))
    return Ranges((np.maximum(span, _LEAST_SPAN) / (2 * level)).astype(np.float32), zeros, level)


def full_ranges(values: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and largest finite value of each channel of (N, C); 0 where there is none."""
    is_finite = np.isfinite(values)
    low = np.where(is_finite, values, np.inf).min(axis=0, initial=np.inf).astype(np.float64)
    high = np.where(is_finite, values, -np.inf).max(axis=0, initial=-np.inf).astype(np.float64)
    is_empty = low > high
    return np.where(is_empty, 0.0, low), np.where(is_empty, 0.0, high)


def clipped_ranges(values: NDArray[Any], share: float) -> Ranges:
    """Return ranges that leave out a share of the values at either end of each channel.

    Parameters
    ----------
    values
        (N, C); values that are not finite do not count.
    share
        0 leaves out nothing.
    """
    low, high = full_ranges(values)
    if share > 0 and len(values):
        for channel in range(values.shape[1]):
            finite = values[np.isfinite(values[:, channel]), channel].astype(np.float64)
            if len(finite):
                low[channel], high[channel] = np.quantile(finite, [share, 1 - share])
    return make_ranges(low, high)


def calibrated_ranges(values: NDArray[Any], weights: NDArray[Any], sizes: NDArray[Any] | None = None) -> Ranges:
    """Return the ranges with the least squared error under several weights: finer steps against values that are clamped.

    Parameters
    ----------
    values
        (N, C); values that are not finite do not count.
    weights
        (N,) how much each splat matters.
    sizes
        (N,) the longest scale of each splat where values are log scales: errors are then those of the scales relative to
        it, since a thin axis may be far off in its logarithm and no one sees it. None: errors of the values.

    Notes
    -----
    Both ends of every channel are tried at several percentiles and at steps towards the median, 320 pairs in all. Within
    the range rounding gives a twelfth of a step squared; beyond it the distance to the end counts. Weights do not know what
    hides what: the pair is taken whose error, relative to that of the whole range, is least under the worst of the weights,
    their roots, and no weights.
    """
    low, high = full_ranges(values)
    stride = max(1, -(-len(values) // SAMPLE))
    sample, weights = values[::stride].astype(np.float64), np.asarray(weights, np.float64)[::stride]
    logs = None if sizes is None else np.log(np.asarray(sizes, np.float64))[::stride]

    def calibrate(channel: int, _stop: int) -> None:
        is_finite = np.isfinite(sample[:, channel])
        column = sample[is_finite, channel]
        if not len(column):
            return
        order = np.argsort(column, kind="stable")
        column, own = column[order], weights[is_finite][order]
        gain = np.ones(len(column)) if logs is None else np.exp(np.minimum(2 * (column - logs[is_finite][order]), 0.0))
        weightings = [own * gain, np.sqrt(own) * gain, gain]
        low[channel], high[channel] = _best_ends(column, weightings, low[channel], high[channel], is_log=logs is not None)

    run_blocks(calibrate, values.shape[1], 1)
    return make_ranges(low, high)


def _best_ends(
    column: NDArray[np.float64], weightings: list[NDArray[np.float64]], low: float, high: float, *, is_log: bool
) -> tuple[float, float]:
    """Return the ends of the range of one sorted channel; `low` and `high` are those of all splats."""
    last = len(column) - 1
    middle = float(column[last // 2])

    def tail(values: NDArray[np.float64], own: NDArray[np.float64], end: float) -> float:
        with np.errstate(over="ignore"):
            moved = np.expm1(end - values) if is_log else end - values
        return float((own * moved**2).sum())

    # Percentiles, and steps towards the median for what lies far out without being rare.
    starts = np.array([low, *column[[int(share * last) for share in _LOW_SHARES]], *np.linspace(low, middle, _STEPS)[1:-1]])
    ends = np.array(
        [high, *column[[last - int(share * last) for share in _HIGH_SHARES]], *np.linspace(high, middle, _STEPS)[1:-1]]
    )
    below, above = np.searchsorted(column, starts), np.searchsorted(column, ends, side="right")
    spans = ends[None, :] - starts[:, None]
    worst = np.zeros(spans.shape)
    for own in weightings:
        first = np.array([tail(column[:i], own[:i], start) for start, i in zip(starts, below, strict=True)])
        second = np.array([tail(column[i:], own[i:], end) for end, i in zip(ends, above, strict=True)])
        costs = float(own.sum()) / 12 * (spans / (2 * LEVEL)) ** 2 + first[:, None] + second[None, :]
        worst = np.maximum(worst, costs / max(float(costs[0, 0]), 1e-300))
    worst[spans < 0] = np.inf
    row, end_id = np.unravel_index(np.argmin(worst), worst.shape)
    return float(starts[row]), float(ends[end_id])


def sort_axes(quats: Float32, log_scales: Float32) -> tuple[NDArray[np.int8], Float32]:
    """Return rotations in four signed bytes wxyz, value q / 128, and log scales, with the axes of each splat longest first.

    Parameters
    ----------
    quats, log_scales
        (N, 4) wxyz, any length, and (N, 3).

    Returns
    -------
    tuple
        codes (N, 4) int8 · log_scales (N, 3) descending. Of the four frames with that order of axes, which are turns by
        180 degrees of one another, the one whose bytes are closest.
    """
    from gsplat_tools.kernels.rotation_frames import FRAME_AXES, apply_frames

    quats, log_scales = np.ascontiguousarray(quats, np.float32), np.ascontiguousarray(log_scales, np.float32)
    order = np.argsort(-log_scales, axis=1, kind="stable")
    frames_of = np.zeros((4, 27), np.uint8)
    for frame_id in range(4):
        for order_id in range(27):
            matching = np.flatnonzero(order_id == FRAME_AXES @ (9, 3, 1))
            if len(matching):
                frames_of[frame_id, order_id] = matching[frame_id]
    order_ids = order @ (9, 3, 1)
    codes, turned = np.empty((len(quats), 4), np.uint8), np.empty_like(quats)
    scales, closest = np.empty_like(log_scales), np.full(len(quats), -1.0)
    for frames_by_order in frames_of:
        frames = frames_by_order[order_ids]

        def turn(start: int, stop: int, frames: NDArray[np.uint8] = frames) -> None:
            part = slice(start, stop)
            apply_frames(quats[part], log_scales[part], frames[part], turned[part], scales[part])

        run_blocks(turn, len(quats))
        candidates = quaternion_u8.encode(turned)
        with np.errstate(invalid="ignore", divide="ignore"):
            wide = turned.astype(np.float64)  # squares of float32 overflow and vanish
            lengths = np.sqrt(np.square(wide).sum(axis=1))
            closeness = np.abs((quaternion_u8.decode(candidates) * wide).sum(axis=1)) / lengths
        is_closer = closeness > closest
        codes[is_closer], closest[is_closer] = candidates[is_closer], closeness[is_closer]
    codes[closest < 0] = quaternion_u8.encode(quats[closest < 0])
    return (codes.astype(np.int16) - 128).astype(np.int8), np.take_along_axis(log_scales, order, axis=1)


def block_ranges(means: Float32, level: int) -> Ranges:
    """Return the ranges of positions, (B, 3): every BLOCK splats have their own."""
    starts = np.arange(0, len(means), BLOCK)
    if not len(starts):
        return Ranges(np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), level)
    return make_ranges(np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts), level)
