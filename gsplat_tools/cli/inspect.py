"""gsplat-inspect: parse, call one library function, print. `info` loads no compiler."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from gsplat_tools.cli import _options as options
from gsplat_tools.cli import _output as output
from gsplat_tools.cli._errors import EXIT_DATA, names_stdout, one_line, reports_errors
from gsplat_tools.cli._numerics import numerics
from gsplat_tools.cli._tradeoff import tradeoff
from gsplat_tools.cli._view import view

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class InfoByDefault(click.Group):
    """A group whose command may be left out when only a file is given."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run, with a line where stdout fails."""
        with names_stdout():
            return super().main(*args, **kwargs)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """Take `gsplat-inspect FILE` as `gsplat-inspect info FILE`."""
        is_command = not args or args[0] in self.commands or args[0].startswith("-")
        if not is_command and (Path(args[0]).exists() or any(mark in args[0] for mark in "./")):
            args = ["info", *args]
        return super().resolve_command(ctx, args)


@click.group(cls=InfoByDefault, context_settings=CONTEXT)
@options.version_option
def main() -> None:
    """Look at Gaussian splat files: what they hold, how far apart two are, what a target would show.

    \b
    gsplat-inspect scene.ply
    gsplat-inspect compare scene.ply scene.gspk --images out/
    gsplat-inspect render scene.gspk -o scene.png --model spark
    """  # noqa: D301 - \b keeps click from joining the lines


@main.command()
@click.argument("file", type=options.EXISTING_FILE)
@options.max_memory_option
@options.json_option
@reports_errors
def info(file: Path, *, as_json: bool) -> None:
    """Show header facts without decoding, where the format allows."""
    from gsplat_tools.inspection import info as read_info

    facts = read_info(file)
    if as_json:
        output.print_json(facts)
        return
    for name, value in facts.items():
        click.echo(f"{name:18}{one_line(_plain(value))}")


def _plain(value: Any) -> str:
    """Return a value of a report for people."""
    if isinstance(value, dict):
        if len(value) > 12:
            return f"{len(value)} entries (see --json)"
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items()) or "-"
    if isinstance(value, list | tuple):
        if not value:
            return "-"
        if all(isinstance(item, float) for item in value):
            return f"({', '.join(map(repr, value))})"
        return f"({', '.join(map(_plain, value))})" if len(value) <= 12 else f"{len(value)} values (see --json)"
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, int):
        return output.count(value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@main.command()
@click.argument("file", type=options.EXISTING_FILE)
@click.option("--frame", type=click.IntRange(min=0), default=0, show_default=True, help="Frame of a sequence.")
@options.max_memory_option
@options.json_option
@reports_errors
def stats(file: Path, *, frame: int, as_json: bool) -> None:
    """Show statistics of every attribute as stored, and hints about what looks odd."""
    from gsplat_tools.inspection import statistics

    report = statistics(file, frame=frame)
    if as_json:
        output.print_json(report)
        return
    click.echo(f"{file}: {output.count(report['splats'])} splats, SH degree {report['sh_degree']}")
    rows = [
        (
            name,
            *(output.number(values[key]) for key in ("min", "max", "mean", "std")),
            *(output.number(values["percentiles"].get(p)) for p in ("1", "50", "99")),
            str(values["nan"]),
            str(values["inf"]),
        )
        for name, values in report["attributes"].items()
    ]
    click.echo(output.table(rows, ("attribute", "min", "max", "mean", "std", "1 %", "50 %", "99 %", "nan", "inf")))
    for hint in report["hints"]:
        click.echo(f"hint ({hint['code']}): {hint['message']}")


@main.command()
@click.argument("reference", type=click.Path(exists=True, path_type=Path))
@click.argument("candidate", type=click.Path(exists=True, path_type=Path))
@click.option("--views", type=click.IntRange(min=1), default=8, show_default=True, help="Automatic views.")
@click.option("--size", type=options.SizeType(), default="640x360", show_default=True, help="Size of the pictures.")
@click.option("--camera", type=options.EXISTING_FILE, help="JSON list of cameras instead of automatic views.")
@click.option("--model", type=click.Choice(options.MODELS), help="Rendering model; by default the candidate's.")
@click.option("--t", type=float, help="Normalized time at which sequences and motion are evaluated.")
@click.option(
    "--images",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Write source, candidate and amplified difference of every view.",
)
@options.jobs_option
@options.max_memory_option
@options.json_option
@options.progress_option
@reports_errors
def compare(
    reference: Path,
    candidate: Path,
    *,
    views: int,
    size: tuple[int, int],
    camera: Path | None,
    model: str | None,
    t: float | None,
    images: Path | None,
    jobs: int | None,
    as_json: bool,
    progress: bool,
) -> None:
    """Compare two files, or folders of frames, by their attributes and by what a target would show.

    Sequences of the same length are compared frame by frame, or at one time with --t.
    """
    from gsplat_tools.inspection import compare_files
    from gsplat_tools.parallel import use_jobs

    with use_jobs(jobs), output.showing_progress(progress):
        report = compare_files(
            reference, candidate, views=views, size=size, camera_file=camera, model=model, t=t, images=images
        )
    if as_json:
        output.print_json(report)
        return
    rows: list[tuple[str, ...]] = [
        (name, *(output.number(errors[key]) for key in ("max", "mean", "rms"))) for name, errors in report["attributes"].items()
    ]
    if rows:
        click.echo(output.table(rows, ("error of", "max", "mean", "rms")))
    else:
        click.echo("attributes: not compared, because counts or positions of the splats do not match")
    rows = [
        (
            view["name"],
            "identical" if view["psnr"] is None else f"{view['psnr']:.2f}",
            output.number(view["ssim"], 5),
            f"{view['max_abs']:.4f}",
            f"{100 * view['share_above_1']:.2f}",
            f"{100 * view['share_above_8']:.2f}",
        )
        for view in report["views"]
    ]
    click.echo(output.table(rows, ("view", "PSNR dB", "SSIM", "max error", "% > 1/255", "% > 8/255")))
    if report["frames"]:
        worst = min(report["frames"], key=lambda level: math.inf if level["psnr_min"] is None else level["psnr_min"])
        rows = [(str(f["frame"]), output.number(f["psnr_min"]), output.number(f["psnr_mean"])) for f in report["frames"]]
        click.echo(output.table(rows, ("frame", "PSNR min", "PSNR mean")))
        click.echo(f"worst frame: {worst['frame']}")
    if report["identical"]:
        click.echo(f"{report['model']}: the pictures are identical")
    else:
        click.echo(
            f"{report['model']}: PSNR min {report['psnr_min']:.2f} dB ({report['worst_view']}), "
            f"mean {report['psnr_mean']:.2f} dB, SSIM {output.number(report['ssim_mean'], 5)}"
        )


@main.command()
@click.argument("file", type=options.EXISTING_FILE)
@click.option("-o", "--output", "target", type=click.Path(dir_okay=False, path_type=Path), help="PNG to write.")
@click.option("--camera", default="auto", show_default=True, metavar="JSON|auto", help="File with a list of cameras.")
@click.option(
    "--views",
    type=click.IntRange(min=1),
    help="Automatic views; several make a contact sheet. By default 8, or 1 with --times or --animate.",
)
@click.option("--model", type=click.Choice(options.MODELS), help="Rendering model; by default the format's.")
@click.option("--variant", help='Variant of the model: unity "1.0", "1.2.1", "fork-4d"; spark "packed", "ext", "none".')
@click.option("--size", type=options.SizeType(), default="640x360", show_default=True, help="Size of one view.")
@click.option("--t", type=float, help="Normalized time at which sequences and motion are evaluated.")
@click.option("--times", type=options.FrameTimesType(), help="Several times: a row of the picture a view, a column a time.")
@click.option(
    "--animate",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="WEBP",
    help="Write an animated WebP of --times, by default 31 from 0 to 1.",
)
@click.option("--fps", type=click.FloatRange(1, 100), default=15, show_default=True, help="Pictures a second of --animate.")
@click.option(
    "--framebuffer",
    type=click.Choice(["float", "unorm8"]),
    default="float",
    show_default=True,
    help="unorm8 rounds after every blend, as a GPU target does.",
)
@click.option("--overwrite", is_flag=True, help="Replace a picture that is there.")
@options.jobs_option
@options.max_memory_option
@options.json_option
@options.progress_option
@reports_errors
def render(file: Path, *, target: Path | None, jobs: int | None, as_json: bool, progress: bool, **given: Any) -> None:
    """Draw a scene as its target would show it, at one time or over time."""
    from gsplat_tools.inspection import render_file
    from gsplat_tools.parallel import use_jobs

    if target is None and given["animate"] is None:
        raise click.UsageError("give -o, --animate or both")
    if given["t"] is not None and given["times"]:
        raise click.UsageError("give --t or --times, not both")
    with use_jobs(jobs), output.showing_progress(progress):
        report = render_file(file, target, **given)
    if as_json:
        output.print_json(report)
    else:
        drawn = [view["drawn"] for view in report["views"]]
        model = report["model"] + (f" {report['variant']}" if report["variant"] else "")
        files = ", ".join(name for name in (report["picture"], report["animation"]) if name)
        splats = output.count(min(drawn)) + ("" if min(drawn) == max(drawn) else f" to {output.count(max(drawn))}")
        click.echo(f"{files}: {len(drawn)} views, model {model}, splats drawn {splats}", err=True)


@main.command()
@click.argument("file", type=options.EXISTING_FILE)
@click.option(
    "--max-issues", type=click.IntRange(min=1), default=100, show_default=True, help="Most codes to list, errors first."
)
@options.max_memory_option
@options.json_option
@options.progress_option
@reports_errors
def validate(file: Path, *, max_issues: int, as_json: bool, progress: bool) -> None:
    """Hold every rule of the format against the whole file; exit status 1 on errors."""
    from gsplat_tools.validation import validate as validate_file

    with output.showing_progress(progress):
        report = validate_file(file, max_issues=max_issues)
    if as_json:
        output.print_json(report)
    else:
        click.echo(f"{report['file']} ({report['format']}): {'valid' if report['valid'] else 'not valid'}")
        for issue in report["issues"]:
            click.echo(f"{issue['severity']:8}{issue['code']} ({issue['count']}): {one_line(issue['message'])}")
            for offender in issue["first"]:
                place = ", ".join(f"{name} {value}" for name, value in offender.items() if value is not None)
                if place:
                    click.echo(f"        {one_line(place)}")
        if report["omitted"]:
            click.echo(f"{report['omitted']} more codes; raise --max-issues to see them")
    if not report["valid"]:
        raise SystemExit(EXIT_DATA)


@main.command()
@click.argument("file", type=options.EXISTING_FILE)
@click.option("-o", "--output", "target", type=click.Path(dir_okay=False, path_type=Path), help="File to write instead.")
@click.option("--overwrite", is_flag=True, help="Replace the output if it is there.")
@options.max_memory_option
@reports_errors
def normalize(file: Path, *, target: Path | None, overwrite: bool) -> None:
    """Repair the meta.json of old .sog4d bundles, in place or into a new file."""
    from gsplat_tools.validation import normalize as normalize_file

    changes = normalize_file(file, target, overwrite=overwrite)
    for change in changes or ["nothing to repair"]:
        click.echo(change, err=True)


main.add_command(numerics)
main.add_command(tradeoff)
main.add_command(view)


if __name__ == "__main__":
    main()
