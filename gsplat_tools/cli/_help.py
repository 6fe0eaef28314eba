"""Options of a long command under headings."""

from __future__ import annotations

from typing import Any

import click

from gsplat_tools.cli._errors import names_stdout

SECTIONS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Target", ("formats", "preset", "overwrite", "dry_run")),
    ("Budget", ("target_psnr", "max_bytes", "max_bytes_per_splat", "auto", "own_visual_tolerance", "show_knobs")),
    ("Splats", (
        "sh_degree", "prune_opacity", "prune_faint", "outliers", "order", "source_coordinates", "target_coordinates",
        "recenter", "strict",
    )),
    ("Sequences and motion", (
        "frame_times", "time_at", "frame", "interpolation", "frames", "tolerance", "fit_motion", "fit_report",
    )),
    ("Sources of other tools", ("lod", "shn_order")),
    ("Check", ("validate", "min_psnr", "views", "model")),
    ("Single formats", ("own_",)),
)  # fmt: skip
"""Headings and the parameters below them, a name or the start of names; the rest stands under "Running"."""


class SectionedCommand(click.Command):
    """A command whose help puts options under headings."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run, with a line where stdout fails."""
        with names_stdout():
            return super().main(*args, **kwargs)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, section by section."""
        options = [parameter for parameter in self.get_params(ctx) if isinstance(parameter, click.Option)]
        records = {option.name or "": option.get_help_record(ctx) for option in options}
        left = {name: record for name, record in records.items() if record is not None}
        for title, members in SECTIONS:
            chosen = [
                name for name in left if any(name == each or (each.endswith("_") and name.startswith(each)) for each in members)
            ]
            if chosen:
                with formatter.section(title):
                    formatter.write_dl([left.pop(name) for name in chosen])
        if left:
            with formatter.section("Running"):
                formatter.write_dl(list(left.values()))
