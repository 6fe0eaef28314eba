"""Options that search for an encoding, and what was decided in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from gsplat_tools.cli import _options as options
from gsplat_tools.cli import _output as output
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.tuning.search import Budget


def tuning_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add what searches the knobs, and --show-knobs."""
    for add in reversed((
        click.option(
            "--target-psnr",
            type=options.FiniteType(),
            metavar="DB",
            help="Search the options that are not given for the fewest bytes at which the worst view, of 8 of 640x360 or "
            "--views, has this PSNR against the source.",
        ),
        click.option("--max-bytes", type=click.IntRange(min=1), help="Search for the highest PSNR within so many bytes."),
        click.option(
            "--max-bytes-per-splat",
            type=options.FiniteType(0),
            metavar="BYTES",
            help="The same for each splat of a frame; leaves no splat out.",
        ),
        click.option(
            "--auto/--no-auto",
            default=False,
            help="Spend only what the scene requires: fewer bytes than the preset's at pictures as good, or at 48 dB.",
        ),
        click.option(
            "--show-knobs",
            is_flag=True,
            expose_value=False,
            is_eager=True,
            callback=_show_knobs,
            help="Show presets and knobs of every format and exit.",
        ),
    )):  # fmt: skip
        command = add(command)
    return command


def budget_of(given: Mapping[str, Any]) -> Budget | None:
    """Return the budget that options ask for.

    Raises
    ------
    click.UsageError
        It is to be held without being checked.
    """
    values = [given["target_psnr"], given["max_bytes"], given["max_bytes_per_splat"]]
    if values == [None, None, None]:
        return None
    if not given["validate"] or given["views"] == 0:
        raise click.UsageError("--target-psnr, --max-bytes and --max-bytes-per-splat need --validate and at least one view")
    return Budget(min_psnr=values[0], max_bytes=values[1], max_bytes_per_splat=values[2])


def without_search(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an estimate, which searches nothing.

    Raises
    ------
    click.UsageError
        A search was asked for.
    """
    if arguments["budget"] is not None or arguments["auto"]:
        raise click.UsageError("--dry-run estimates the options that are given; leave out what searches for others")
    return {name: value for name, value in arguments.items() if name not in {"budget", "auto"}}


def knob_table() -> str:
    """Return presets and knobs of every format that is written, as Markdown."""
    lines = ["| format | option | values, from coarsest to finest | of |", "|---|---|---|---|"]
    for record in FORMATS.values():
        if record.write is None:
            continue
        for name, changes in record.presets.items():
            words = ", ".join(f"{option}={value}" for option, value in changes.items()) or "the defaults"
            lines.append(f"| {record.id} | preset {name} | {words} | |")
        for name, knob in record.knobs.items():
            first, *rest = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in knob.values]
            values = ", ".join([first, *rest]) if len(rest) < 12 else f"{first} to {rest[-1]} in {len(rest)} steps"
            lines.append(f"| {record.id} | {name} | {values} | {knob.stream} |")
    return "\n".join(lines)


def _show_knobs(ctx: click.Context, _param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        click.echo(knob_table())
        ctx.exit()


def summary(report: Mapping[str, Any]) -> list[str]:
    """Return what was decided in short lines, and what a little more would cost."""
    lines = []
    rows: list[tuple[str, ...]] = [
        (f"  {each['option']}", str(each["value"]), _saved(each["bytes_saved"]), output.number(each["db_lost"], 3))
        for each in report["decisions"]
    ]
    if rows:
        table = output.table(rows, ("  decided", "value", "bytes saved", "dB lost")).splitlines()
        lines += [line if line.startswith("  ") else f"  {line}" for line in table]
        lines += [f"  {each['option']}: {each['why']}" for each in report["decisions"] if each["bytes_saved"] is None]
    found = report["search"]
    if found is not None:
        level = "identical pictures" if found["psnr_min"] is None else f"{found['psnr_min']:.2f} dB in the worst view"
        lines.append(
            f"  searched {found['seconds']:.1f} s, {found['trials']} encodings of the whole scene: "
            f"{output.count(found['bytes'])} bytes, {level}"
        )
        prices = []
        if found["next_db_bytes"] is not None:
            prices.append(f"one more dB about {output.count(found['next_db_bytes'])} bytes")
        if found["next_megabyte_db"] is not None:
            prices.append(f"one more megabyte about {found['next_megabyte_db']:.1f} dB")
        if prices:
            lines.append(f"  next: {', '.join(prices)}")
    return lines


def _saved(number: int | None) -> str:
    return "-" if number is None else output.count(number)
