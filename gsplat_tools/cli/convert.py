"""gsplat-convert: parse, call `convert`, print."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from gsplat_tools.cli import _cluster as cluster
from gsplat_tools.cli import _options as options
from gsplat_tools.cli import _output as output
from gsplat_tools.cli import _tuning as tuning
from gsplat_tools.cli._errors import one_line, reports_errors
from gsplat_tools.cli._help import SectionedCommand
from gsplat_tools.errors import counts_in_words
from gsplat_tools.formats._stores import local_path
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.preparing import SaveChoices
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.saving import find_target

# Options of single formats: flag, field of the write options, click arguments. A format takes those that its
# write options name; naming one for a format that does not have it is a usage error.
FORMAT_OPTIONS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("--rotation", "rotation", {
        "type": click.Choice(["reference", "best", "small"]),
        "help": "Rotation codes: as the target's own encoder, with the smallest error, or as compresses best.",
    }),
    ("--spark-encoding", "spark_encoding", {
        "type": click.Choice(["default", "fit"]), "help": "Ranges of the Spark pack: Spark's own, or fitted to the scene.",
    }),
    ("--codec", "codec", {"type": click.Choice(["zstd", "none"]), "help": "Streams of .gspk; none can be memory-mapped."}),
    ("--sog4d-version", "version", {"type": click.IntRange(1, 2), "help": "SH palette: one (1) or one a band (2)."}),
    ("--spz-version", "version", {"type": click.IntRange(2, 4), "help": "Version of SPZ."}),
    ("--splat4d-version", "version", {"type": click.IntRange(1, 2), "help": "Records alone (1), or with SH (2)."}),
    ("--labels", "labels", {"type": click.Choice(["full", "delta-v1"]), "help": "SH labels over time."}),
    ("--delta-segment-length", "delta_segment_length", {"type": click.IntRange(min=1), "help": "Frames a delta segment."}),
    ("--time-mapping", "time_mapping", {"type": click.Choice(["uniform", "explicit"]), "help": "Times of .sog4d frames."}),
    ("--scale-codebook-size", "scale_codebook_size", {"type": click.IntRange(1, 65535), "help": "Scale triples of .sog4d."}),
    ("--sh-palette-size", "sh_palette_size", {"type": click.IntRange(1, 65536), "help": "Entries of the SH palette."}),
    ("--centroids", "centroids", {"type": click.Choice(["f16", "f32"]), "help": "Type of the SH palette."}),
    ("--sh0-codebook", "sh0_codebook", {"type": click.Choice(["base-rgb", "fit"]), "help": "Fixed or fitted base colors."}),
    ("--layout-width", "width", {"type": click.IntRange(min=1), "help": "Width of the images, px."}),
    ("--layout-height", "height", {"type": click.IntRange(min=1), "help": "Height of the images, px."}),
    ("--webp-effort", "webp_effort", {"type": click.IntRange(0, 9), "help": "Effort of the lossless WebP images."}),
    ("--zip", "zip", {"type": click.Choice(["auto", "stored", "deflated"]), "help": "auto: images stored, the rest deflated."}),
    ("--sh1-bits", "sh1_bits", {"type": click.IntRange(1, 8), "help": "Bits of SH values of band 1."}),
    ("--sh-rest-bits", "sh_rest_bits", {"type": click.IntRange(1, 8), "help": "Bits of SH values above band 1."}),
    ("--fractional-bits", "fractional_bits", {
        "type": options.FractionalBitsType(), "help": "Bits of positions behind the point; auto looks at the scene.",
    }),
    ("--sh-layout", "sh_layout", {
        "type": click.Choice(["interleaved", "channel-major"]), "help": "SH of .vis: as Visionary reads it, or its other one.",
    }),
    ("--raw-color", "raw_color", {"is_flag": True, "default": None, "help": "Store RGB in .vis; needs --sh-degree 0."}),
    ("--clip", "clip", {
        "type": options.ClipType(),
        "help": "Share of values beyond the int8 ranges; auto: least error, rendered: best pictures.",
    }),
    ("--position-bits", "position_bits", {
        "type": options.PositionBitsType(), "help": "Bits of a coordinate in blocks of 256 splats.",
    }),
    ("--kernel-size", "kernel_size", {"type": options.FiniteType(0), "help": "Low-pass filter in the sidecar, px^2."}),
    ("--gaussian-scaling", "gaussian_scaling", {"type": options.FiniteType(0), "help": "Factor of scales in the sidecar."}),
    ("--opacity-scale", "opacity_scale", {"type": options.FiniteType(0), "help": "Factor of opacities in the sidecar."}),
    ("--cutoff-scale", "cutoff_scale", {"type": options.FiniteType(0.1), "help": "Factor of projected axes in the sidecar."}),
    ("--base-offset", "base_offset", {
        "type": click.IntRange(0, 2**32 - 1), "help": "Splats of the models before this one, in the sidecar.",
    }),
    ("--level", "level", {"type": click.IntRange(1, 22), "help": "Level of zstd or zlib."}),
    ("--visual-tolerance", "visual_tolerance", {
        "type": options.FiniteType(0, 10), "metavar": "PX",
        "help": "Move codes to cheap neighbors, and drop faint splats, where no bit saved shows more than an opaque splat "
        "shifted by so many px, in a picture that the scene spans with 1,000 px; try 0.02 to 0.1. 0 changes nothing.",
    }),
    ("--seed", "seed", {"type": int, "help": "Seed of everything random."}),
)  # fmt: skip


def _format_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of single formats."""
    for flag, name, arguments in reversed(FORMAT_OPTIONS):
        parameter = f"own_{flag.strip('-').replace('-', '_')}"
        known = [record.id for record in FORMATS.values() if _takes(record, flag, name)]
        if known:
            text = f"{arguments['help']} [{', '.join(known)}]"
            command = click.option(flag, parameter, **{**arguments, "help": text})(command)
    return command


def _takes(record: Format, flag: str, name: str) -> bool:
    """Whether a flag sets an option of a format; each format's version has a flag of its own."""
    own_fields = {option.name for option in fields(record.write_options)} if record.write is not None else set()
    return name in own_fields and (name != "version" or flag == f"--{record.id}-version")


@click.command(cls=SectionedCommand, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@click.argument("target", type=click.Path(path_type=Path), required=False, metavar="TARGET")
@click.option(
    "--to",
    "formats",
    multiple=True,
    type=click.Choice(options.format_ids("write")),
    help="Format of the target; repeat it to write several, then TARGET is a folder. By default from the extension.",
)
@click.option(
    "--preset",
    type=click.Choice(["fast", "balanced", "best", "exact"]),
    default="balanced",
    show_default=True,
    help="Speed, size and accuracy; exact keeps all that the format can hold. Every option below overrides it.",
)
@tuning.tuning_options
@click.option(
    "--sh-degree", type=options.DegreeType(), help="Highest SH band to keep; auto drops bands that are zero everywhere."
)
@click.option("--prune-opacity", type=options.FiniteType(0, 1), help="Drop splats of lower opacity; 0 prunes nothing.")
@click.option(
    "--prune-faint",
    type=options.FiniteType(0),
    metavar="PX",
    help="Drop splats that can light fewer pixels (opacity squared times area), in a picture that the scene spans with 1,000 "
    "px; 0 prunes nothing. By default what a visual tolerance is worth.",
)
@click.option(
    "--outliers",
    type=click.Choice(["auto", "keep", "drop"]),
    help="Far splats that hardly show and stretch the box; auto drops them with a visual tolerance.",
)
@click.option("--order", type=click.Choice(["morton", "hilbert2d", "none"]), help="Order of splats; none keeps the source's.")
@click.option(
    "--source-coordinates",
    type=options.AxesType(),
    help="Axes of the source, such as RUB, RDF, RUF or LUF (right, up, back ...); by default what it says.",
)
@click.option("--target-coordinates", type=options.AxesType(), help="Axes to convert to; by default nothing is converted.")
@click.option(
    "--recenter",
    type=click.Choice(["auto", "on", "off"]),
    help="Subtract an origin; auto where the target stores it and it gains precision.",
)
@click.option("--strict", is_flag=True, help="Refuse invalid splats and losses instead of dropping and counting them.")
@_format_options
@click.option("--frame-times", type=options.FrameTimesType(), help="Times of the source frames: a file or a list, in [0, 1].")
@click.option(
    "--time", "time_at", type=options.FiniteType(), help="Take the moment at this normalized time of a sequence or 4D asset."
)
@click.option("--frame", type=click.IntRange(min=0), help="Take this stored frame of a sequence.")
@click.option(
    "--interpolation",
    type=click.Choice(["linear", "nearest"]),
    default="linear",
    show_default=True,
    help="Between frames, with --time.",
)
@click.option("--frames", type=options.FramesType(), help="Bake the motion of a 4D asset to so many keyframes; auto chooses.")
@click.option(
    "--tolerance",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.01,
    show_default=True,
    help="Largest error of opacity between the keyframes of --frames auto, as a share of what shows.",
)
@click.option(
    "--fit-motion",
    type=click.Choice(["auto", "window", "gaussian"]),
    help="Fit a sequence to one 4D asset with this time model; .splat4d does so by itself.",
)
@click.option(
    "--fit-report",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Write the residual of every splat of the fit, and a picture of them.",
)
@click.option(
    "--lod",
    type=click.IntRange(min=0),
    help="Level of detail of a streamed SOG scene (lod-meta.json); 0, the default, is the finest.",
)
@click.option(
    "--shn-order", type=click.Choice(["interleaved", "channel-major"]), help="SH order in .sog4d sources of other tools."
)
@click.option(
    "--validate/--no-validate", default=True, help="Read the target back, hold it against its bounds, render and compare."
)
@click.option(
    "--min-psnr",
    type=options.FiniteType(),
    metavar="DB",
    help="Fail, and leave the target as it was, if the worst view is below this.",
)
@click.option("--views", type=click.IntRange(min=0), default=2, show_default=True, help="Views to render when validating.")
@click.option("--model", type=click.Choice(options.MODELS), help="Rendering model to validate with; by default the target's.")
@options.jobs_option
@options.max_memory_option
@options.store_timeout_option
@click.option("--dry-run", is_flag=True, help="Estimate bytes, seconds and PSNR from a part of the scene; write nothing.")
@click.option("--overwrite", is_flag=True, help="Replace a target that is there.")
@options.json_option
@click.option("--quiet", is_flag=True, help="Print errors only.")
@options.progress_option
@cluster.cluster_options
@options.version_option
@click.pass_context
@reports_errors
def main(
    context: click.Context,
    /,
    sources: tuple[str, ...],
    target: Path | None,
    formats: tuple[str, ...],
    *,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    progress: bool,
    jobs: int | None,
    **given: Any,
) -> None:
    """Convert SOURCE to TARGET, and prove that the target is right.

    SOURCE is a file, or the frames of a sequence: several files, a folder or a quoted glob. The formats follow from
    content and extension. In a folder, targets are named after the source; .gspk and others that share an extension
    get the id of their format before it.

    \b
    gsplat-convert scene.ply scene.gspk
    gsplat-convert scene.ply scene.sog4d --preset best --min-psnr 40
    gsplat-convert scene.ply out/ --to spark --to sog4d --json
    gsplat-convert 'frames/*.ply' scene.sog4d
    gsplat-convert scene.sog4d frames/ --to ply
    """  # noqa: D301 - \b keeps click from joining the lines
    from gsplat_tools.convert import convert
    from gsplat_tools.estimation import estimate
    from gsplat_tools.parallel import use_jobs

    where = cluster.where_of(given)
    cluster.check_arguments(context, where)
    if where.batch is not None:
        with use_jobs(jobs), output.showing_progress(progress and not quiet):
            cluster.run_manifest(context, where, jobs, _arguments, as_json=as_json, quiet=quiet)
        return
    assert target is not None
    target = Path(local_path(target))
    for source in sources:
        if cluster.is_missing(source):
            raise click.UsageError(f"source {source!r} does not exist")
    targets = _targets(sources, target, formats)
    arguments = _arguments(given, [find_target(path, to) for path, to in targets])
    if len(formats) == 1 and target.is_dir() and given["time_at"] is None and given["frame"] is None:
        targets, arguments = _every_frame(sources, targets[0], arguments[0])
    reports: list[dict[str, Any]] = []

    def tell(report: dict[str, Any]) -> None:
        reports.append(report)
        if not quiet:
            for warning in report["warnings"]:
                click.echo(f"warning: {one_line(warning['message'])}", err=True)
            if not as_json:
                click.echo(_summary(report), err=True)

    showing = output.showing_progress(progress and not quiet)
    with use_jobs(jobs), showing, cluster.opened(where, jobs, quiet=quiet) as engine:
        for (path, to), own in zip(targets, arguments, strict=True):
            if dry_run:
                reports.append(estimate(sources, path, to=to, **tuning.without_search(own)))
                if not as_json:
                    click.echo(_estimated(reports[-1]))
            elif engine is None:
                tell(convert(sources, path, to=to, overwrite=overwrite, **own).to_json())
            else:
                tell(cluster.convert_elsewhere(sources, path, to, engine, where, {**own, "overwrite": overwrite}))
    if as_json:
        output.print_json(reports[0] if len(reports) == 1 else {"conversions": reports})


def _targets(sources: tuple[str, ...], target: Path, formats: tuple[str, ...]) -> list[tuple[Path, str | None]]:
    """Return (path, format id) of every target; several formats go into a folder, named after the source."""
    if len(formats) <= 1 and not target.is_dir():
        return [(target, formats[0] if formats else None)]
    if not formats:
        raise click.UsageError(f"{target} is a folder; name a file in it or give --to")
    if target.exists() and not target.is_dir():
        raise click.UsageError(f"several formats need a folder, and {target} is a file")
    target.mkdir(parents=True, exist_ok=True)
    name = Path(sources[0]).name
    stem = name[: -len(Path(name).suffix)] if Path(name).suffix else name
    return [(target / f"{stem}{_ending(FORMATS[to])}", to) for to in formats]


def _ending(record: Format) -> str:
    """Return the end of a file's name; formats that share an extension put their id before it."""
    extension = record.extensions[0]
    is_shared = sum(extension in other.extensions for other in FORMATS.values()) > 1
    return f".{record.id}{extension}" if is_shared else extension


def _every_frame(
    sources: tuple[str, ...], target: tuple[Path, str | None], arguments: dict[str, Any]
) -> tuple[list[tuple[Path, str | None]], list[dict[str, Any]]]:
    """Return one target a frame, where the source is a sequence and the target's format holds single frames."""
    from gsplat_tools.formats.loading import inspect_file

    path, to = target
    record = find_target(path, to)
    is_bundle = len(sources) == 1 and Path(sources[0]).is_file()
    frames = inspect_file(sources[0])[1].frames if is_bundle else 1
    if frames == 1 or record.holds_sequences:
        return [target], [arguments]
    stem = path.name.removesuffix(_ending(record))
    names = [path.with_name(f"{stem}_{frame:05d}{_ending(record)}") for frame in range(frames)]
    return [(name, to) for name in names], [{**arguments, "frame": frame} for frame in range(frames)]


def _arguments(given: dict[str, Any], records: list[Format]) -> list[dict[str, Any]]:
    """Return the arguments of `convert` for every target from the options that were given."""
    from gsplat_tools.retiming import Motion
    from gsplat_tools.verification import Validation

    own: list[tuple[str, str, Any]] = []
    for flag, name, _ in FORMAT_OPTIONS:
        value = given.get(f"own_{flag.strip('-').replace('-', '_')}")
        if value is None:
            continue
        if not any(_takes(record, flag, name) for record in records):
            raise click.UsageError(f"{flag} does not apply to {' or '.join(record.id for record in records)}")
        own.append((flag, name, value))
    validation = (
        Validation(views=given["views"], model=given["model"], min_psnr=given["min_psnr"]) if given["validate"] else None
    )
    if given["min_psnr"] is not None and (validation is None or given["views"] == 0):
        raise click.UsageError("--min-psnr needs --validate and at least one view")
    if given["auto"] and given["views"] == 0:
        raise click.UsageError("--auto looks at pictures and needs at least one view; leave out --views 0")
    general = {
        option.name: given[option.name]
        for option in fields(SaveChoices)
        if given[option.name] is not None and given[option.name] is not False
    }
    shared = {
        "preset": given["preset"],
        "budget": tuning.budget_of(given),
        "auto": given["auto"],
        "validation": validation,
        "time_at": given["time_at"],
        "frame": given["frame"],
        "interpolation": given["interpolation"],
        "motion": Motion(
            frames=given["frames"], tolerance=given["tolerance"], fit=given["fit_motion"], fit_report=given["fit_report"]
        ),
        "read_options": {name: given[name] for name in ("lod", "shn_order") if given[name] is not None},
        **general,
        **({"frame_times": given["frame_times"]} if given["frame_times"] else {}),
    }
    return [{**shared, **{name: value for flag, name, value in own if _takes(record, flag, name)}} for record in records]


def _estimated(report: dict[str, Any]) -> str:
    """Return an estimate in words."""
    level = (
        "identical pictures"
        if report["psnr_min"] is None
        else f"PSNR min {report['psnr_min']:.1f} dB of {report['views']} views"
    )
    if report["exact"]:
        basis = "measured on the whole scene"
    else:
        basis = f"from {output.count(report['sampled_splats'])} of {output.count(report['splats'])} splats"
        if report["frames"] > 1:
            basis += f" in {report['sampled_frames']} of {report['frames']} frames"
    return (
        f"{one_line(report['source'])} -> {one_line(report['target']['path'])} ({report['target']['format']}), not written: "
        f"{'' if report['exact'] else 'about '}{output.count(report['bytes'])} bytes, "
        f"{report['encode_seconds']:.2f} s to encode, {level}; {basis}"
    )


def _summary(report: dict[str, Any]) -> str:
    """Return what was done in a few lines."""
    target, seconds = report["target"], report["seconds"]
    splats = report["splats"]
    lines = [
        f"{one_line(report['source'])} -> {one_line(target['path'])} ({target['format']})",
        f"  {output.count(splats)} splats, SH degree {report['sh_degree']}"
        + (f", {report['frames']} frames" if report["frames"] > 1 else "")
        + f", {output.count(target['bytes'])} bytes"
        + (f" ({target['bytes'] / splats / report['frames']:.2f} a splat)" if splats else "")
        + f", {sum(seconds.values()):.2f} s ("
        + ", ".join(f"{name} {value:.2f}" for name, value in seconds.items())
        + ")",
    ]
    lines += tuning.summary(report)
    if report["dropped"]:
        lines.append(f"  dropped: {counts_in_words(report['dropped'])}")
    validation = report["validation"]
    if validation is None:
        return "\n".join([*lines, "  not validated"])
    rows: list[tuple[str, ...]] = [
        (name, output.number(e["max"]), output.number(e["rms"]), output.number(e["bound"]))
        for name, e in validation["attributes"].items()
    ]
    if rows:
        errors = output.table(rows, ("  error of", "max", "rms", "bound"))
        lines += [line if line.startswith("  ") else f"  {line}" for line in errors.splitlines()]
    if validation["psnr_min"] is not None:
        lines.append(
            f"  rendered ({validation['model']}, {validation['views']} views): PSNR min {validation['psnr_min']:.2f} dB, "
            f"mean {validation['psnr_mean']:.2f} dB, SSIM {output.number(validation['ssim_mean'], 5)}, "
            f"largest difference {validation['max_abs']:.4f}"
        )
    elif validation.get("identical"):
        lines.append(f"  rendered ({validation['model']}): identical")
    lines.append("  validation passed")
    return "\n".join(lines)
