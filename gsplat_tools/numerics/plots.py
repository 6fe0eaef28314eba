"""Bound beside measurement over magnitude, as inline SVG: a figure a sweep and attribute, a panel a format."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from html import escape

from gsplat_tools.numerics.measuring import Row

_PANEL_WIDTH, _PANEL_HEIGHT = 190, 150
_LEFT, _TOP, _BOTTOM, _GAP = 46, 34, 30, 14
_COLUMNS = 5
_MAX_DECADES = 24
_BOUND, _MAX, _RMS, _REFUSED = "#d55e00", "#0072b2", "#009e73", "#b2182b"
"""Colors that color-blind readers tell apart. Source: Okabe and Ito 2008."""

_CROSS = "&#215;"

_LEGEND = (
    (_BOUND, "6 3", "derived bound"),
    (_MAX, "", "largest error"),
    (_RMS, "2 2", "rms error"),
)
_STYLE = "font:11px system-ui,sans-serif;background:#fff;color:#222"

Place = Callable[[float], float]


def plot_svg(rows: Iterable[Row]) -> str:
    """Return one SVG file with every figure, one below the other."""
    figures = [_figure(*entry) for entry in _figures(rows)]
    width = max((w for w, _, _ in figures), default=300)
    parts, y = [], 0
    for _, height, content in figures:
        parts.append(f'<g transform="translate(0 {y})">{content}</g>')
        y += height + 12
    height = max(y, 40)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'style="{_STYLE}"><rect width="{width}" height="{height}" fill="#fff"/>{"".join(parts)}</svg>'
    )


def plot_page(rows: Sequence[Row], *, title: str) -> str:
    """Return one HTML file without scripts or links: the figures, then a table of every row."""
    figures = []
    for entry in _figures(rows):
        width, height, content = _figure(*entry)
        figures.append(f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img">{content}</svg>')
    head = "".join(f"<th>{name}" for name in ("format", "attribute", "condition", "bound", "max", "rms", "of bound", "note"))
    body = "".join(
        f"<tr{' class=bad' if row.within is False else ''}><td>{escape(row.format)}<td>{escape(row.attribute)}"
        f"<td>{escape(row.condition)}{''.join(f'<td class=n>{_number(v)}' for v in _numbers(row))}<td>{escape(row.note)}"
        for row in rows
    )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>body{{{_STYLE};margin:20px}}"
        "h1{font-size:18px}svg{display:block;margin:0 0 18px;max-width:100%;height:auto}"
        "table{border-collapse:collapse}td,th{padding:1px 8px;text-align:left;border-bottom:1px solid #ddd}"
        ".n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}.bad{background:#fdd}</style>"
        f"<h1>{escape(title)}</h1>{''.join(figures)}<table><thead><tr>{head}<tbody>{body}</table></html>\n"
    )


def _numbers(row: Row) -> tuple[float | None, ...]:
    return row.bound, row.measured_max, row.measured_rms, row.tightness


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _figures(rows: Iterable[Row]) -> list[tuple[str, str, dict[str, list[Row]]]]:
    """Return (sweep, attribute, rows by format) of everything that has a magnitude to plot over."""
    figures: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in rows:
        if row.x is not None:
            figures.setdefault((row.sweep, row.attribute), {}).setdefault(row.format, []).append(row)
    return [
        (sweep, attribute, {name: sorted(own, key=lambda row: row.x or 0.0) for name, own in panels.items()})
        for (sweep, attribute), panels in figures.items()
        if max(map(len, panels.values())) > 1
    ]


def _figure(sweep: str, attribute: str, panels: dict[str, list[Row]]) -> tuple[int, int, str]:
    """Return width, height and content of one figure."""
    everything = [row for own in panels.values() for row in own]
    x_place, x_marks = _x_axis([row.x for row in everything if row.x is not None])
    values = [v for row in everything for v in (row.bound, row.measured_max, row.measured_rms) if v is not None]
    y_place, y_marks = _y_axis([v for v in values if 0 < v < math.inf])
    columns = min(_COLUMNS, len(panels))
    width = _LEFT + columns * (_PANEL_WIDTH + _GAP)
    height = _TOP + -(-len(panels) // columns) * (_PANEL_HEIGHT + _BOTTOM + 14)
    parts = [f'<text x="4" y="14" font-size="13" font-weight="600">{escape(attribute)} against {escape(sweep)}</text>']
    for index, (stroke, dash, name) in enumerate(_LEGEND):
        x = 330 + 120 * index
        parts.append(
            f'<line x1="{x}" x2="{x + 22}" y1="10" y2="10" stroke="{stroke}" stroke-dasharray="{dash}" stroke-width="2"/>'
            f'<text x="{x + 27}" y="14">{name}</text>'
        )
    parts.append(f'<text x="{330 + 120 * len(_LEGEND)}" y="14" fill="{_REFUSED}">{_CROSS} refused</text>')
    for index, (name, own) in enumerate(panels.items()):
        left = _LEFT + index % columns * (_PANEL_WIDTH + _GAP)
        top = _TOP + index // columns * (_PANEL_HEIGHT + _BOTTOM + 14)
        parts.append(f'<g transform="translate({left} {top})">')
        parts.append(_panel(name, own, (x_place, x_marks), (y_place, y_marks), has_labels=index % columns == 0))
        parts.append("</g>")
    return width, height, "".join(parts)


def _panel(
    name: str, rows: list[Row], x_axis: tuple[Place, list[float]], y_axis: tuple[Place, list[float]], *, has_labels: bool
) -> str:
    """Return the lines of one format, in a box that starts at the origin."""
    (x_place, x_marks), (y_place, y_marks) = x_axis, y_axis
    parts = [
        f'<rect width="{_PANEL_WIDTH}" height="{_PANEL_HEIGHT}" fill="none" stroke="#bbb"/>',
        f'<text x="2" y="-4" font-weight="600">{escape(name)}</text>',
    ]
    for value in x_marks:
        x = x_place(value)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y2="{_PANEL_HEIGHT}" stroke="#eee"/>')
        parts.append(f'<text x="{x:.1f}" y="{_PANEL_HEIGHT + 13}" text-anchor="middle" fill="#555">{_short(value)}</text>')
    for value in y_marks:
        y = y_place(value)
        parts.append(f'<line x2="{_PANEL_WIDTH}" y1="{y:.1f}" y2="{y:.1f}" stroke="#eee"/>')
        if has_labels:
            parts.append(f'<text x="-5" y="{y + 4:.1f}" text-anchor="end" fill="#555">{_short(value)}</text>')
    if has_labels:
        parts.append(f'<text x="-5" y="{_PANEL_HEIGHT}" text-anchor="end" fill="#555">0</text>')
    picks: tuple[Callable[[Row], float | None], ...] = (
        lambda row: row.bound,
        lambda row: row.measured_max,
        lambda row: row.measured_rms,
    )
    # The bound last: its dashes show on top of the errors that reach it.
    for (stroke, dash, _), pick in reversed(list(zip(_LEGEND, picks, strict=True))):
        parts += _lines(rows, pick, x_place, y_place, f'stroke="{stroke}" stroke-dasharray="{dash}"')
    for row in rows:
        assert row.x is not None
        if row.note.startswith("refused"):
            parts.append(
                f'<text x="{x_place(row.x):.1f}" y="{_PANEL_HEIGHT - 4}" text-anchor="middle" fill="{_REFUSED}">{_CROSS}'
                f"<title>{escape(row.note)}</title></text>"
            )
        elif row.measured_max is not None and math.isfinite(row.measured_max):
            fill = _REFUSED if row.within is False else _MAX if row.within else "#fff"
            text = f"{row.condition}: largest error {_number(row.measured_max)}, bound {_number(row.bound)} {row.note}"
            parts.append(
                f'<circle cx="{x_place(row.x):.1f}" cy="{y_place(row.measured_max):.1f}" r="2.5" fill="{fill}" '
                f'stroke="{_MAX}"><title>{escape(text)}</title></circle>'
            )
    return "".join(parts)


def _lines(rows: list[Row], pick: Callable[[Row], float | None], x_place: Place, y_place: Place, style: str) -> list[str]:
    """Return a line through the finite values, broken where there is none."""
    runs: list[list[str]] = [[]]
    for row in rows:
        value = pick(row)
        if value is None or not math.isfinite(value) or row.x is None:
            runs.append([])
        else:
            runs[-1].append(f"{x_place(row.x):.1f},{y_place(value):.1f}")
    return [f'<polyline points="{" ".join(run)}" fill="none" stroke-width="1.6" {style}/>' for run in runs if len(run) > 1]


def _x_axis(values: list[float]) -> tuple[Place, list[float]]:
    """Return places and marks across a panel, logarithmic where every value is positive."""
    if min(values) > 0:
        low, high = math.log10(min(values)), math.log10(max(values))
        span = high - low or 1.0
        return (
            lambda value: _PANEL_WIDTH * (0.04 + 0.92 * (math.log10(value) - low) / span),
            _decades(low, high, 5),
        )
    low, high = min(values), max(values)
    span = high - low or 1.0
    step = 10.0 ** math.floor(math.log10(span / 2))
    step *= 5 if span / step > 10 else 2 if span / step > 5 else 1
    marks = [step * k for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return lambda value: _PANEL_WIDTH * (0.04 + 0.92 * (value - low) / span), marks


def _y_axis(values: list[float]) -> tuple[Place, list[float]]:
    """Return places and marks up a panel, logarithmic, of the decades that hold most values.

    0 and what is below them lie on the lower edge, what is above on the upper.
    """
    exponents = sorted(math.log10(value) for value in values) or [-3.0, 0.0]
    within = [bisect_right(exponents, exponent + _MAX_DECADES) for exponent in exponents]
    # Of windows that hold as many the highest: the largest errors matter most.
    start = max(range(len(exponents)), key=lambda i: (within[i] - i, i))
    low, high = exponents[start], exponents[within[start] - 1]
    if high - low < 1:
        low, high = low - 0.5, high + 0.5
    span = high - low

    def place(value: float) -> float:
        if value <= 0:
            return float(_PANEL_HEIGHT)
        share = (math.log10(value) - low) / span
        return min(_PANEL_HEIGHT * (0.92 - 0.87 * min(share, 1.05)), float(_PANEL_HEIGHT))

    return place, _decades(low, high, 6)


def _decades(low: float, high: float, count: int) -> list[float]:
    """Return about `count` powers of ten between two exponents."""
    exponents = range(math.ceil(low - 1e-9), math.floor(high + 1e-9) + 1)
    return [10.0**exponent for exponent in exponents[:: max(1, math.ceil(len(exponents) / count))]]


def _short(value: float) -> str:
    """Return a number for an axis."""
    return f"{value:g}" if 1e-2 <= abs(value) < 1e4 or value == 0 else f"{value:.0e}".replace("e+0", "e").replace("e-0", "e-")
