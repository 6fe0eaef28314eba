"""gsplat-inspect tradeoff: parse, measure, write the report, print the table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gsplat_tools.cli import _options as options
from gsplat_tools.cli import _output as output
from gsplat_tools.cli._errors import reports_errors


@click.command()
@click.argument("file", type=options.EXISTING_FILE)
@click.option("-o", "--output", "target", type=click.Path(dir_okay=False, path_type=Path), help="HTML report to write.")
@click.option("--csv", "csv_target", type=click.Path(dir_okay=False, path_type=Path), help="Table to write.")
@click.option(
    "--to", "formats", multiple=True, type=click.Choice(options.format_ids("write")), help="Formats to try; by default all."
)
@click.option("--knobs", is_flag=True, help="Also turn every knob of each format by itself.")
@click.option("--crop", type=click.IntRange(min=1), metavar="N", help="Measure N splats around the middle only: an estimate.")
@click.option("--repeats", type=click.IntRange(min=1), default=3, show_default=True, help="Runs to take the median time of.")
@click.option("--views", type=click.IntRange(min=1), default=4, show_default=True, help="Automatic views.")
@click.option("--size", type=options.SizeType(), default="480x270", show_default=True, help="Size of the pictures.")
@click.option("--model", type=click.Choice(options.MODELS), help="Rendering model; by default that of each format.")
@click.option("--overwrite", is_flag=True, help="Replace files that are there.")
@options.jobs_option
@options.max_memory_option
@options.json_option
@options.progress_option
@reports_errors
def tradeoff(
    file: Path,
    *,
    target: Path | None,
    csv_target: Path | None,
    crop: int | None,
    model: str | None,
    overwrite: bool,
    jobs: int | None,
    as_json: bool,
    progress: bool,
    **given: Any,
) -> None:
    """Encode a scene in many ways and show what each costs and keeps.

    Formats times settings (presets, fewer SH bands, and single knobs with --knobs): bytes, seconds, memory, and PSNR and
    SSIM against the source. Rows with a star are on the Pareto front: nothing smaller looks as good.

    \b
    gsplat-inspect tradeoff scene.ply -o report.html
    gsplat-inspect tradeoff scene.ply --to sog4d --to sog --knobs --crop 20000 --json
    """  # noqa: D301 - \b keeps click from joining the lines
    from gsplat_tools.parallel import use_jobs
    from gsplat_tools.tuning.report import tradeoff_files

    with use_jobs(jobs), output.showing_progress(progress):
        report = tradeoff_files(
            file, target, csv_target, crop_to=crop, model=None if model is None else (model, None), overwrite=overwrite, **given
        )
    if as_json:
        output.print_json(report)
        return
    if report["cropped_from"] is not None:
        click.echo(f"an estimate from {output.count(report['splats'])} of {output.count(report['cropped_from'])} splats")
    rows = [_row(point) for point in report["points"]]
    header = ("", "format", "settings", "bytes", "B/splat", "PSNR min", "mean", "SSIM", "encode s", "decode s", "peak MB")
    click.echo(output.table(rows, header))
    for skipped in report["skipped"]:
        click.echo(f"not possible: {skipped['format']} {_words(skipped['settings'])}: {skipped['reason']}", err=True)


def _words(settings: dict[str, Any]) -> str:
    """Return settings in a few words."""
    return " ".join(str(value) if name == "preset" else f"{name}={value}" for name, value in settings.items())


def _row(point: dict[str, Any]) -> tuple[str, ...]:
    """Return a point for people."""
    level = "identical" if point["identical"] else output.number(point["psnr_min"])
    return (
        "*" if point["pareto"] else "",
        point["format"],
        _words(point["settings"]),
        output.count(point["bytes"]),
        f"{point['bytes_per_splat']:.2f}",
        level,
        output.number(point["psnr_mean"]),
        output.number(point["ssim_mean"], 5),
        f"{point['encode_seconds']:.3f}",
        f"{point['decode_seconds']:.3f}",
        "-" if point["peak_memory"] is None else f"{point['peak_memory'] / 1e6:.0f}",
    )
