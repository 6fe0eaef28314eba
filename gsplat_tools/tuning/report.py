"""A trade-off as one page: plots, table, and pictures of the worst views; it loads nothing from anywhere."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import TargetExistsError
from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats.loading import load
from gsplat_tools.plots import Series, color, scatter
from gsplat_tools.reference.pictures import difference_picture, to_uint8
from gsplat_tools.tuning.machine import describe_machine
from gsplat_tools.tuning.tradeoff import Tradeoff, measure_tradeoff

DIFFERENCE_GAIN = 10.0
INDISTINGUISHABLE = 80.0
"""dB; beyond it no picture of 8 bits differs in a visible way, and plots would have no room for the rest."""

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8882; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1400px; padding: 0 1rem; }
h1 { font-size: 1.5rem; overflow-wrap: anywhere; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.plots { display: flex; flex-wrap: wrap; gap: 1rem; } .plots svg { flex: 1 1 480px; max-width: 100%; }
svg text { font: 12px system-ui, sans-serif; fill: currentColor; } svg .tick { opacity: .7; } svg .grid { stroke: var(--line); }
.legend span { display: inline-block; margin-right: 1.1rem; } .legend i { display: inline-block; width: .8em; height: .8em;
 border-radius: 50%; margin-right: .35em; }
.scroll { overflow-x: auto; } table { font-size: 13px; border-collapse: collapse; width: 100%;
 font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .5rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th button { all: unset; cursor: pointer; } th button:focus-visible { outline: 2px solid; }
@media (max-width: 700px) { body { margin: 1rem auto; padding: 0 .7rem; } }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
tr.pareto { background: var(--soft); font-weight: 600; } .note { opacity: .8; max-width: 60rem; }
figure { margin: 1.2rem 0; } figure div { display: grid; grid-template-columns: repeat(3, 1fr); gap: 4px; }
figure img { width: 100%; display: block; } figcaption { margin-bottom: .3rem; }
"""

# Sorts by the clicked column; numbers by value (kept in data-v), words by letters.
_SCRIPT = """
const heads = document.querySelectorAll('th');
heads.forEach((head, column) => head.firstChild.addEventListener('click', () => {
  const body = head.closest('table').tBodies[0], down = head.dataset.down = head.dataset.down === '1' ? '0' : '1';
  heads.forEach(each => each.removeAttribute('aria-sort'));
  head.setAttribute('aria-sort', down === '1' ? 'ascending' : 'descending');
  const key = row => { const v = row.cells[column].dataset.v; return v === undefined ? row.cells[column].textContent : +v; };
  [...body.rows].sort((a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0) * (down === '1' ? 1 : -1))
    .forEach(row => body.append(row));
}));
"""

_EXPLANATION = (
    "Every point was written, read back and drawn from the same cameras as the source, by the rendering model that stands for "
    "the format. PSNR min is that of the worst view. Filled marks and shaded rows: nothing smaller looks as good. Pictures "
    f"that are identical, or above {INDISTINGUISHABLE:g} dB, are in the table only."
)

_COLUMNS = (
    ("format", "", None), ("settings", "", None), ("bytes", "{:,}", "bytes"), ("bytes a splat", "{:.2f}", "bytes_per_splat"),
    ("PSNR min dB", "{:.2f}", "psnr_min"), ("PSNR mean dB", "{:.2f}", "psnr_mean"), ("SSIM", "{:.5f}", "ssim_mean"),
    ("largest error", "{:.4f}", "max_abs"), ("encode s", "{:.3f}", "encode_seconds"), ("decode s", "{:.3f}", "decode_seconds"),
    ("peak MB", "{:.1f}", "peak_memory"),
)  # fmt: skip


def tradeoff_files(
    path: str | Path, target: Path | None, csv_target: Path | None, *, overwrite: bool = False, **choices: Any
) -> dict[str, Any]:
    """Measure a scene in many encodings, write report and table, and return what `gsplat-inspect tradeoff --json` prints.

    Parameters
    ----------
    path
        Scene to encode.
    target, csv_target
        HTML report and CSV table to write, or None.
    overwrite
        Replace files that are there.
    **choices
        As `measure_tradeoff` takes them.

    Raises
    ------
    TargetExistsError
        A file to write is there already; nothing is measured.
    """
    path = Path(path)
    for wanted in (target, csv_target):
        if wanted is not None and wanted.exists() and not overwrite:
            raise TargetExistsError("the target is there already; use --overwrite to replace it", path=wanted)
    found = measure_tradeoff(load(path), **choices)
    for wanted, is_page in ((target, True), (csv_target, False)):
        if wanted is not None:
            text = html_report(found, path.name, describe_machine()) if is_page else found.to_csv()
            with replacing(wanted, overwrite=overwrite) as stream:
                stream.write(text.encode("utf-8"))
    return {"file": str(path), **found.to_json()}


def html_report(tradeoff: Tradeoff, title: str, machine: str) -> str:
    """Return a page that needs nothing else.

    Parameters
    ----------
    tradeoff
        What was measured.
    title
        Name of the scene.
    machine
        What it was measured on, in words.
    """
    rows = tradeoff.to_json()["points"]
    formats = list(dict.fromkeys(row["format"] for row in rows))
    facts = f"{tradeoff.splats:,} splats, SH degree {tradeoff.sh_degree}"
    if tradeoff.frames > 1:
        facts += f", {tradeoff.frames} frames"
    if tradeoff.cropped_from is not None:
        facts += (
            f", around the middle of a scene of {tradeoff.cropped_from:,}: an estimate, not the whole scene "
            f"({100 * tradeoff.splats / tradeoff.cropped_from:.1f} % of it)"
        )
    legend = "".join(f'<span><i style="background:{color(i)}"></i>{escape(name)}</span>' for i, name in enumerate(formats))
    plots = _plot(rows, formats, "bytes", "bytes") + _plot(rows, formats, "encode_seconds", "seconds to encode")
    body = [
        f"<h1>{escape(title)}: bytes, seconds and what is seen</h1><p>{facts}. Measured on {escape(machine)}.</p>",
        f'<p class="note">{_EXPLANATION}</p>',
        f'<p class="legend">{legend}</p><div class="plots">{plots}</div>',
        "<h2>All points</h2><p class='note'>A click on a heading sorts.</p>",
        _table(rows),
        "<h2>Errors of attributes</h2><p class='note'>Root mean square and largest, in the units of the attribute.</p>",
        _attributes(rows),
    ]
    if tradeoff.skipped:
        reasons = "".join(f"<li>{escape(s.label)}: {escape(reason)}</li>" for s, reason in tradeoff.skipped)
        body.append(f"<h2>Not possible</h2><ul>{reasons}</ul>")
    body.append(_pictures(tradeoff))
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style><body>{''.join(body)}<script>{_SCRIPT}</script></body></html>\n"
    )


def _plot(rows: list[dict[str, Any]], formats: list[str], name: str, label: str) -> str:
    """Return PSNR against one cost."""
    series = [
        Series(
            each,
            [
                (
                    row[name],
                    row["psnr_min"],
                    f"{each} {_words(row)}: {row['bytes']:,} bytes, {row['psnr_min']:.2f} dB",
                    row["pareto"],
                )
                for row in rows
                if row["format"] == each and row["psnr_min"] is not None and row["psnr_min"] < INDISTINGUISHABLE
            ],
        )
        for each in formats
    ]
    return scatter(series, x_label=label, y_label="PSNR of the worst view, dB")


def _words(row: dict[str, Any]) -> str:
    """Return the settings of a row in a few words."""
    own = {name: value for name, value in row["settings"].items() if name != "preset"}
    return " ".join([row["settings"]["preset"], *(f"{name} {value}" for name, value in own.items())])


def _table(rows: list[dict[str, Any]]) -> str:
    """Return every point as a row."""
    head = "".join(f'<th scope="col"><button>{name}</button></th>' for name, _, _ in _COLUMNS)
    lines = []
    for row in rows:
        cells = [f"<td>{escape(row['format'])}</td><td>{escape(_words(row))}</td>"]
        for _, form, name in _COLUMNS[2:]:
            assert name is not None
            value = row[name] if name != "peak_memory" or row[name] is None else row[name] / 1e6
            if value is None:
                is_best = name.startswith("psnr") and row["identical"]
                cells.append(f'<td data-v="{1e9 if is_best else -1}">{"identical" if is_best else "-"}</td>')
            else:
                cells.append(f'<td data-v="{value}">{form.format(value)}</td>')
        lines.append(f"<tr{' class=pareto' if row['pareto'] else ''}>{''.join(cells)}</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _attributes(rows: list[dict[str, Any]]) -> str:
    """Return the errors of every attribute of every point."""
    names = list(dict.fromkeys(name for row in rows for name in row["attributes"]))
    head = "".join(f'<th scope="col"><button>{name}</button></th>' for name in ("format", "settings", *names))
    lines = []
    for row in rows:
        cells = [f"<td>{escape(row['format'])}</td><td>{escape(_words(row))}</td>"]
        for name in names:
            errors = row["attributes"].get(name)
            if errors is None or errors["rms"] is None or errors["max"] is None:
                cells.append('<td data-v="-1">-</td>')
            else:
                cells.append(f'<td data-v="{errors["rms"]}">{errors["rms"]:.2g} / {errors["max"]:.2g}</td>')
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _pictures(tradeoff: Tradeoff) -> str:
    """Return source, candidate and difference in the worst view of every point on the front."""
    figures = ["<h2>Worst views of the points that are worth having</h2>"]
    figures.append(f"<p class='note'>Source, candidate, and their difference times {DIFFERENCE_GAIN:g}.</p>")
    for point, mark, pair in zip(tradeoff.points, tradeoff.pareto, tradeoff.worst, strict=True):
        if not mark or pair is None or point.likeness is None or point.likeness.psnr_min is None:
            continue
        images = (to_uint8(pair[0]), to_uint8(pair[1]), difference_picture(*pair, gain=DIFFERENCE_GAIN))
        names = ("source", "candidate", "difference")
        shown = "".join(f'<img src="{_embedded(image)}" alt="{name}">' for name, image in zip(names, images, strict=True))
        caption = f"{point.setting.label}: {point.bytes:,} bytes, {point.likeness.psnr_min:.2f} dB"
        figures.append(f"<figure><figcaption>{escape(caption)}</figcaption><div>{shown}</div></figure>")
    return "".join(figures)


def _embedded(image: NDArray[np.uint8]) -> str:
    """Return a picture as a data address, without loss."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "WEBP", lossless=True, method=4)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
