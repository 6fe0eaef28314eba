"""gsplat-inspect numerics: derived bounds beside measured errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gsplat_tools.cli import _options as options
from gsplat_tools.cli import _output as output
from gsplat_tools.cli._errors import EXIT_DATA, reports_errors
from gsplat_tools.errors import CapabilityError, TargetExistsError

if TYPE_CHECKING:
    from gsplat_tools.numerics import Row


@click.command()
@click.argument("file", type=options.EXISTING_FILE, required=False)
@click.option("--synthetic", is_flag=True, help="Measure synthetic sweeps to the extremes instead of a scene.")
@click.option("--format", "formats", multiple=True, metavar="ID", help="Measure this format only; may be given again.")
@click.option("--all", "show_all", is_flag=True, help="Print every row, not only the tightest of each sweep.")
@click.option(
    "-o",
    "--plot",
    "--output",
    "target",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="HTML|SVG",
    help="Draw bounds and errors over magnitude; HTML has the table too.",
)
@click.option("--overwrite", is_flag=True, help="Replace a picture that is there.")
@options.jobs_option
@options.max_memory_option
@options.json_option
@options.progress_option
@reports_errors
def numerics(
    file: Path | None,
    *,
    synthetic: bool,
    formats: tuple[str, ...],
    show_all: bool,
    target: Path | None,
    overwrite: bool,
    jobs: int | None,
    as_json: bool,
    progress: bool,
) -> None:
    """Hold every attribute's error against its derived bound, in every format; exit status 1 where one is exceeded.

    Give a FILE, or --synthetic for sweeps of position, scale, aspect, rotation, opacity, SH, time and speed.
    """
    from gsplat_tools.numerics import exceeded_rows, scene_rows, synthetic_rows
    from gsplat_tools.parallel import use_jobs

    if (file is None) != synthetic:
        raise click.UsageError("give a FILE or --synthetic, one of them")
    _check_target(target, overwrite=overwrite)
    names = formats or None
    with use_jobs(jobs), output.showing_progress(progress):
        rows = synthetic_rows(names) if file is None else scene_rows(file, names)
    if target is not None:
        _draw(rows, target, "synthetic sweeps" if file is None else file.name, overwrite=overwrite)
    exceeded = exceeded_rows(rows)
    if as_json:
        output.print_json({"rows": [row.to_json() for row in rows]})
    else:
        _print(rows, show_all=show_all)
    if exceeded:
        click.echo(f"{len(exceeded)} of {len(rows)} rows leave their bound", err=True)
        raise SystemExit(EXIT_DATA)


def _check_target(target: Path | None, *, overwrite: bool) -> None:
    """Refuse a target before the measuring, not after it."""
    if target is None:
        return
    if target.suffix.lower() not in (".html", ".svg"):
        raise CapabilityError("plots are written as .html or .svg", path=target)
    if target.exists() and not overwrite:
        raise TargetExistsError("the target is there; use --overwrite to replace it", path=target)


def _draw(rows: Sequence[Row], target: Path, name: str, *, overwrite: bool) -> None:
    """Write the plots."""
    from gsplat_tools.formats._atomic import replacing
    from gsplat_tools.numerics import plot_page, plot_svg

    title = f"Derived bounds and measured errors: {name}"
    text = plot_svg(rows) if target.suffix.lower() == ".svg" else plot_page(rows, title=title)
    with replacing(target, overwrite=overwrite) as stream:
        stream.write(text.encode())
    click.echo(f"{target}: {len(rows)} rows drawn", err=True)


def _print(rows: Sequence[Row], *, show_all: bool) -> None:
    """Print a table: every row, or the tightest of each format, attribute and sweep."""
    from gsplat_tools.numerics import summarize

    shown = [(row, 1, 0) for row in rows] if show_all else list(summarize(rows))
    lines = []
    for row, count, refused in shown:
        state = {True: "yes", False: "NO", None: "refused" if row.note.startswith("refused") else "no bound"}[row.within]
        more = f"{refused} of {count} refused" if refused and count > refused else ""
        lines.append(
            (
                row.format,
                row.attribute,
                row.condition,
                *(output.number(value, 3) for value in (row.bound, row.measured_max, row.measured_rms)),
                state,
                more,
            )
        )
    click.echo(output.table(lines, ("format", "attribute", "condition", "bound", "max", "rms", "within", "")))
