"""Options and words for batches and clusters."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from gsplat_tools.cli import _output as output
from gsplat_tools.cli._errors import EXIT_DATA, EXIT_INTERRUPTED, one_line
from gsplat_tools.errors import TARGET_EXISTS, CapabilityError, FormatError, GsplatError, TargetExistsError
from gsplat_tools.formats._stores import is_url, local_path
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.saving import find_target

if TYPE_CHECKING:
    from gsplat_tools.cluster.batches import Item
    from gsplat_tools.cluster.engines import Engine
    from gsplat_tools.cluster.manifest import Row

LOCAL = "local"

_OF_THE_COMMAND = (
    "batch", "state", "resume", "scheduler", "retries", "parts", "jobs", "max_memory", "as_json", "quiet", "progress",
    "store_timeout", "dry_run", "version", "help", "show_knobs", "block_splats",
)  # fmt: skip
"""Parameters that a row of a manifest cannot have."""

Arguments = Callable[[dict[str, Any], list[Format]], list[dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class Where:
    """What the options say about batches and clusters."""

    scheduler: str
    batch: str | None
    state: Path | None
    resume: bool
    retries: int
    parts: str | None
    block_splats: int | None


def cluster_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of batches and clusters."""
    for option in reversed((
        click.option(
            "--scheduler", default=LOCAL, show_default=True, metavar="WHERE",
            help="local: this process; local:N: N processes; local-cluster:N: Dask on this machine; tcp://HOST:PORT: a Dask "
            "scheduler that is running. The bytes are the same.",
        ),
        click.option(
            "--batch", metavar="MANIFEST",
            help="Convert what a CSV file or JSON lines list (source, target, options); a scene that fails stops no other.",
        ),
        click.option(
            "--resume", is_flag=True,
            help="Go on with a batch: leave out what it has done, where source, options and target are as then.",
        ),
        click.option(
            "--state", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
            help="Where a batch notes what is done; by default MANIFEST.state.jsonl.",
        ),
        click.option(
            "--retries", type=click.IntRange(min=0), default=3, show_default=True,
            help="Times to try again after lost workers and errors of disks and stores.",
        ),
        click.option(
            "--parts", metavar="DIR",
            help="Folder or URL for finished segments of a sequence or blocks of a scene; by default beside the target.",
        ),
        click.option(
            "--block-splats", type=click.IntRange(min=1), metavar="N",
            help="Encode a still scene to .sog4d in blocks of so many splats, also in this process: memory follows the block. "
            "With another scheduler 1,048,576 by default. The bytes are the same.",
        ),
    )):  # fmt: skip
        command = option(command)
    return command


def where_of(given: dict[str, Any]) -> Where:
    """Take the options of this module out of those that were given."""
    return Where(**{name: given.pop(name) for name in Where.__dataclass_fields__})


def check_arguments(context: click.Context, where: Where) -> None:
    """Refuse what does not go together, or would do nothing."""
    given = context.params
    if given["dry_run"] and (where.batch is not None or where.scheduler != LOCAL or where.block_splats is not None):
        raise click.UsageError(
            "--dry-run estimates one conversion on this machine; leave out --batch, --scheduler and --block-splats"
        )
    if where.batch is not None:
        _check_batch(given, where)
        return
    if given["target"] is None or not given["sources"]:
        raise click.UsageError(f"Missing argument '{'TARGET' if given['sources'] else 'SOURCE...'}'.")
    if where.resume or where.state is not None:
        raise click.UsageError("--resume and --state belong to --batch; a sequence continues by itself")
    if where.scheduler == LOCAL and where.block_splats is None:
        if where.parts is not None:
            raise click.UsageError("--parts is for tasks, and there are none; give a --scheduler too, or --block-splats")
        if context.get_parameter_source("retries") is not ParameterSource.DEFAULT:
            raise click.UsageError("--retries is for tasks, and there are none; give a --scheduler too")


def _check_batch(given: dict[str, Any], where: Where) -> None:
    """Refuse what does not go with --batch."""
    if given["sources"] or given["target"] is not None:
        raise click.UsageError("--batch takes sources and targets from the manifest; leave out SOURCE and TARGET")
    if where.block_splats is not None:
        raise click.UsageError("--block-splats is for one scene; a batch converts each of its scenes as one task")
    if where.parts is not None:
        raise click.UsageError("--parts is for one sequence or scene; a batch converts each of its scenes as one task")
    if len(given["formats"]) > 1:
        raise click.UsageError("a row of a batch has one target; give --to once, and further formats as rows of their own")


def is_missing(source: str) -> bool:
    """Whether a source is neither there nor somewhere that only reading tells."""
    return not any(mark in source for mark in "*?[") and not is_url(source) and not Path(local_path(source)).exists()


@contextmanager
def opened(where: Where, jobs: int | None, *, quiet: bool) -> Iterator[Engine | None]:
    """Open the engine, and say where it can be watched; None for one conversion in this process."""
    if where.scheduler == LOCAL and where.batch is None and where.block_splats is None:
        yield None
        return
    from gsplat_tools.cluster.engines import open_engine

    engine = open_engine(where.scheduler, jobs, where.retries)
    try:
        if engine.dashboard and not quiet:
            workers = f"{engine.workers} worker{'s' if engine.workers != 1 else ''}"
            click.echo(f"{workers}, dashboard {engine.dashboard}", err=True)
        yield engine
    finally:
        engine.close()


def convert_elsewhere(
    sources: tuple[str, ...], target: Path, to: str | None, engine: Engine, where: Where, arguments: dict[str, Any]
) -> dict[str, Any]:
    """Convert a sequence or a scene in blocks as many tasks, and anything else as one; return its report."""
    from gsplat_tools.cluster.batches import Item
    from gsplat_tools.cluster.blocks import WholeSceneError
    from gsplat_tools.cluster.sequences import convert_sequence
    from gsplat_tools.formats.loading import is_single

    record = find_target(target, to)
    own = dict(arguments)
    is_still = len(sources) == 1 and is_single(Path(local_path(sources[0])))
    if record.id == "sog4d" and not is_still:
        if where.block_splats is not None:
            message = "blocks are for one still scene, and this is a sequence, whose tasks are frames; leave out --block-splats"
            raise CapabilityError(message, path=target)
        asked = _take_searches(own)
        if asked is not None:
            raise CapabilityError(f"{asked} cannot be asked for on a cluster; find options on one machine, then give them")
        own.pop("read_options", None)  # which `convert` passes over for frames too
        return convert_sequence(sources, target, engine, parts=where.parts, **own).to_json()
    if record.id == "sog4d":
        try:
            return _convert_blocks(sources[0], target, to, engine, where, dict(own))
        except WholeSceneError:
            if where.block_splats is not None:
                raise
    elif where.block_splats is not None:
        raise CapabilityError(f"blocks are for .sog4d targets, not {record.title}; leave out --block-splats", path=target)
    return _convert_whole(Item(line=0, sources=sources, target=str(target), arguments={**own, "to": to}), engine)


def _convert_whole(item: Item, engine: Engine) -> dict[str, Any]:
    """Convert as one task."""
    from gsplat_tools.cluster.batches import convert_once, standing_at
    from gsplat_tools.cluster.runs import check_alike
    from gsplat_tools.formats._limits import max_memory

    check_alike(engine)
    located = item.located()
    if not item.arguments["overwrite"] and standing_at(located) is not None:
        raise TargetExistsError(TARGET_EXISTS, path=item.target)
    outcome = next(engine.results([engine.submit(convert_once, located, max_memory())]))
    cluster = {"scheduler": engine.name, "workers": engine.workers, "dashboard": engine.dashboard}
    return {**item.named(outcome.result()), "cluster": cluster}


def _convert_blocks(
    source: str, target: Path, to: str | None, engine: Engine, where: Where, arguments: dict[str, Any]
) -> dict[str, Any]:
    """Convert a still scene in blocks, if nothing looks at the whole of it."""
    from gsplat_tools.cluster.blocks import DEFAULT_BLOCK_SPLATS, WholeSceneError, convert_blocks

    asked = _take_searches(arguments)
    if asked is not None:
        raise WholeSceneError(f"{asked} looks at the whole scene")
    if arguments.pop("read_options", None):
        raise WholeSceneError("sources with read options are read whole")
    size = where.block_splats or DEFAULT_BLOCK_SPLATS
    return convert_blocks(source, target, engine, to=to, parts=where.parts, block_splats=size, **arguments).to_json()


def _take_searches(arguments: dict[str, Any]) -> str | None:
    """Take what looks at more than stored frames out of the arguments; return the option of the first that was asked for."""
    arguments.pop("interpolation", None)
    budget, motion = arguments.pop("budget", None), arguments.pop("motion", None)
    asked = {
        "--time": arguments.pop("time_at", None) is not None,
        "--frame": arguments.pop("frame", None) is not None,
        "--target-psnr": budget is not None and budget.min_psnr is not None,
        "--max-bytes": budget is not None and budget.max_bytes is not None,
        "--max-bytes-per-splat": budget is not None and budget.max_bytes_per_splat is not None,
        "--auto": arguments.pop("auto", False),
        "--frames": motion is not None and motion.frames is not None,
        "--fit-motion": motion is not None and motion.fit is not None,
        "--fit-report": motion is not None and motion.fit_report is not None,
    }  # --tolerance alone does nothing
    return next((option for option, was_asked in asked.items() if was_asked), None)


def run_manifest(
    context: click.Context, where: Where, jobs: int | None, arguments: Arguments, *, as_json: bool, quiet: bool
) -> None:
    """Convert what a manifest lists, and end with a status that tells whether all of it is there."""
    from gsplat_tools.cluster.batches import run_batch
    from gsplat_tools.cluster.state import STATE_SUFFIX, State

    assert where.batch is not None
    items = [_item(context, row, arguments) for row in _rows(where.batch)]
    if where.state is None and is_url(where.batch):
        raise click.UsageError("a manifest in a store needs --state FILE")
    state = State(where.state or Path(f"{local_path(where.batch)}{STATE_SUFFIX}"))
    told: list[str] = []

    def tell(report: dict[str, Any]) -> None:
        told.append(report["status"])
        if quiet and report["status"] != "failed":
            return
        text = f"{one_line(report['source'])} -> {one_line(report['target'])}"
        if report["status"] == "failed":
            click.echo(f"failed: {text}: {one_line(report['error']['message'])}", err=True)
        elif not as_json:
            click.echo(f"{report['status']}: {text}", err=True)

    try:
        with opened(where, jobs, quiet=quiet) as engine:
            assert engine is not None
            report = run_batch(items, engine, state=state, resume=where.resume, tell=tell)
    except BaseException as error:
        done = len(told) - told.count("failed")
        how_far = f"{done} of {len(items)} scenes are done; the same command with --resume continues"
        if isinstance(error, KeyboardInterrupt):
            click.echo(f"interrupted; {how_far}", err=True)
            sys.exit(EXIT_INTERRUPTED)
        click.echo(how_far, err=True)
        raise
    if as_json:
        output.print_json(report)
    elif not quiet:
        click.echo(_summary(report["summary"]), err=True)
    if report["summary"]["failed"]:
        sys.exit(EXIT_DATA)


def _rows(batch: str) -> list[Row]:
    """Return the rows of a manifest; one that is wrong or missing is a wrong use of the command."""
    from gsplat_tools.cluster.manifest import read_manifest

    try:
        return read_manifest(batch)
    except FileNotFoundError as error:
        raise click.UsageError(f"there is no manifest {batch}") from error
    except (FormatError, CapabilityError, IsADirectoryError) as error:
        raise click.UsageError(f"wrong manifest: {one_line(error)}") from error


def _summary(summary: dict[str, Any]) -> str:
    """Return what a batch did in a line."""
    return (
        f"{summary['done']} done, {summary['kept']} kept, {summary['failed']} failed; "
        f"{output.count(summary['source_bytes'])} bytes read, {output.count(summary['target_bytes'])} written, "
        f"{summary['seconds']:.2f} s" + ("; the same command with --resume does the rest" if summary["failed"] else "")
    )


def _item(context: click.Context, row: Row, arguments: Arguments) -> Item:
    """Return the conversion of a row: its own options, those of the command where it has none."""
    from gsplat_tools.cluster.batches import Item

    try:
        words = [word for name, value in row.options.items() for word in _words(context.command, name, value)]
        own = context.command.make_context("gsplat-convert", [*words, "--", *row.sources, row.target])
        given = dict(own.params)
        for name in given:
            was_given = context.get_parameter_source(name) is not ParameterSource.DEFAULT
            if own.get_parameter_source(name) is ParameterSource.DEFAULT and was_given:
                given[name] = context.params[name]
        to = given["formats"][0] if given["formats"] else None
        record = find_target(Path(local_path(row.target)), to)
        found = arguments(given, [record])[0]
    except click.UsageError as error:
        raise click.UsageError(f"line {row.line} of the manifest: {error.message}") from error
    except GsplatError as error:
        raise click.UsageError(f"line {row.line} of the manifest: {error}") from error
    return Item(
        line=row.line,
        sources=row.sources,
        target=row.target,
        error=row.error,
        arguments={**found, "to": to, "overwrite": given["overwrite"]},
    )


def _words(command: click.Command, name: str, value: Any) -> list[str]:
    """Return an option of a manifest as words of a command line."""
    if value is None:
        return []  # null in JSON, as an empty cell
    flag = f"--{name.strip().lstrip('-').replace('_', '-')}"
    option = next((each for each in command.params if flag in (*each.opts, *each.secondary_opts)), None)
    if not isinstance(option, click.Option) or option.name in _OF_THE_COMMAND:
        raise click.UsageError(f"{name!r} is no option of a conversion")
    if option.is_flag:
        word = str(value).lower()
        if word not in ("true", "false", "1", "0", "yes", "no"):
            raise click.UsageError(f"{name} is true or false, not {value!r}")
        names = option.opts if word in ("true", "1", "yes") else option.secondary_opts
        return list(names[:1])
    if isinstance(value, list):
        return [flag, ",".join(map(str, value))]
    return [flag, str(value)]
