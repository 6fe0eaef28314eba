"""Scatter plots as inline SVG: no network, no scripts, one element to put into a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a63a8",
    "#8c8c00", "#7f7f7f", "#b2182b", "#8c564b", "#00b3b3", "#e377ff", "#66a61e",
)  # fmt: skip
"""Seen on white and on black; color-blind readers tell the first six apart. Source: Okabe and Ito 2008, extended."""

_LEFT, _TOP, _RIGHT, _BOTTOM = 56, 14, 14, 44
_DECADES_WITH_HALVES = 2.5
"""Logarithmic axes that span less get marks at 2 and 5 too."""


@dataclass(frozen=True, slots=True)
class Series:
    """Points of one color.

    Parameters
    ----------
    name
        In the legend.
    points
        (x, y, text shown on hovering, whether the mark is filled).
    line
        Whether the points are joined in the order given.
    """

    name: str
    points: Sequence[tuple[float, float, str, bool]]
    line: bool = False


def scatter(
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    log_x: bool = True,
    log_y: bool = False,
    size: tuple[int, int] = (560, 380),
) -> str:
    """Return an SVG element that shows every finite point.

    Parameters
    ----------
    series
        Colors go round where there are more than there are colors.
    x_label, y_label
        With units.
    log_x, log_y
        Logarithmic axes; points that are not positive are left out of those.
    size
        Width and height, px.
    """
    width, height = size
    shown = [
        (index, x, y, text, filled)
        for index, each in enumerate(series)
        for x, y, text, filled in each.points
        if math.isfinite(x) and math.isfinite(y) and (x > 0 or not log_x) and (y > 0 or not log_y)
    ]
    if not shown:
        return f'<svg viewBox="0 0 {width} {height}" role="img"><text x="20" y="30">nothing to plot</text></svg>'
    x_axis = _Axis([x for _, x, *_ in shown], log_x, _LEFT, width - _RIGHT)
    y_axis = _Axis([y for _, _, y, *_ in shown], log_y, height - _BOTTOM, _TOP)
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(y_label)} against {escape(x_label)}">']
    parts += [
        f'<line class="grid" x1="{x_axis(value):.1f}" x2="{x_axis(value):.1f}" y1="{_TOP}" y2="{height - _BOTTOM}"/>'
        f'<text class="tick" x="{x_axis(value):.1f}" y="{height - _BOTTOM + 16}" text-anchor="middle">{_short(value)}</text>'
        for value in x_axis.marks
    ]
    parts += [
        f'<line class="grid" x1="{_LEFT}" x2="{width - _RIGHT}" y1="{y_axis(value):.1f}" y2="{y_axis(value):.1f}"/>'
        f'<text class="tick" x="{_LEFT - 6}" y="{y_axis(value) + 4:.1f}" text-anchor="end">{_short(value)}</text>'
        for value in y_axis.marks
    ]
    parts.append(f'<text x="{(_LEFT + width - _RIGHT) / 2}" y="{height - 8}" text-anchor="middle">{escape(x_label)}</text>')
    middle = (_TOP + height - _BOTTOM) / 2
    parts.append(f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">{escape(y_label)}</text>')
    for index, each in enumerate(series):
        if each.line:
            path = " ".join(f"{x_axis(x):.1f},{y_axis(y):.1f}" for i, x, y, *_ in shown if i == index)
            parts.append(f'<polyline points="{path}" fill="none" stroke="{color(index)}" stroke-width="1.5"/>')
    for index, x, y, text, filled in shown:
        fill = color(index) if filled else "none"
        parts.append(
            f'<circle cx="{x_axis(x):.1f}" cy="{y_axis(y):.1f}" r="4.5" fill="{fill}" fill-opacity="0.85" '
            f'stroke="{color(index)}" stroke-width="1.5"><title>{escape(text)}</title></circle>'
        )
    return "".join([*parts, "</svg>"])


def color(index: int) -> str:
    """Return the color of a series."""
    return COLORS[index % len(COLORS)]


def _short(value: float) -> str:
    """Return a number for an axis."""
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= limit:
            return f"{value / (1e3 if unit == 'k' else limit):g} {unit}"
    return f"{value:g}"


class _Axis:
    """Maps values to pixels, and chooses round marks."""

    def __init__(self, values: Sequence[float], is_log: bool, start: float, stop: float) -> None:
        self._is_log, self._start, self._stop = is_log, start, stop
        low, high = min(values), max(values)
        if is_log:
            low, high = low / 1.15, high * 1.15
        else:
            margin = 0.05 * (high - low) or max(abs(high), 1.0) * 0.05
            low, high = low - margin, high + margin
        self._low, self._high = self._place(low), self._place(high)
        self.marks = [value for value in self._round_values(low, high) if low <= value <= high]

    def __call__(self, value: float) -> float:
        share = (self._place(value) - self._low) / (self._high - self._low)
        return self._start + share * (self._stop - self._start)

    def _place(self, value: float) -> float:
        return math.log10(value) if self._is_log else value

    def _round_values(self, low: float, high: float) -> list[float]:
        if self._is_log:
            decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
            every = max(1, len(decades) // 8)
            factors = (1, 2, 5) if math.log10(high / low) < _DECADES_WITH_HALVES else (1,)
            return [factor * 10.0**decade for decade in decades[::every] for factor in factors]
        rough = (high - low) / 6
        scale = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * scale for factor in (1.0, 2.0, 5.0, 10.0) if factor * scale >= rough)
        first = math.ceil(low / step)
        return [round(k * step, 12) for k in range(first, math.floor(high / step) + 1)]
