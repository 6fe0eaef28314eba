"""JSON or words; progress on stderr."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from gsplat_tools.formats._json import finite
from gsplat_tools.progress import Stage, report_to


def print_json(value: Any) -> None:
    """Print one JSON object on stdout; numbers that are not finite become null."""
    text = json.dumps(finite(value), indent=2, ensure_ascii=False, allow_nan=False)
    # Half of a surrogate pair, which a name in a file may hold, has no UTF-8.
    click.echo(text if text.isascii() or _has_utf8(text) else json.dumps(finite(value), indent=2, allow_nan=False))


def _has_utf8(text: str) -> bool:
    """Whether a text can be encoded."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


@contextmanager
def showing_progress(show: bool) -> Iterator[None]:
    """Show stages that last over a second on stderr, and say when kernels are compiled for the first time."""
    from gsplat_tools.kernels._jit import announce_compilation

    if not show:
        yield
        return
    announce_compilation(
        lambda: click.echo("compiling kernels for first use, which takes some seconds; later runs load them", err=True)
    )
    with report_to(_bar):
        yield


def _bar(label: str, total: int, unit: str) -> Stage:
    """Return a progress bar that appears after a second."""
    from tqdm import tqdm

    interval = 0.1 if sys.stderr.isatty() else 10.0

    class Bar:
        def __init__(self) -> None:
            self._bar = tqdm(
                desc=label,
                total=total or None,
                unit=f" {unit}",
                unit_scale=total > 10_000,
                delay=1.0,
                mininterval=interval,
                leave=False,
                file=sys.stderr,
                dynamic_ncols=True,
            )

            # A stage may be silent for long between two steps: the clock keeps the line alive.
            self._done = threading.Event()
            self._clock = threading.Thread(target=self._tick, daemon=True)
            self._clock.start()

        def _tick(self) -> None:
            while not self._done.wait(max(1.0, interval)):
                self._bar.refresh()

        def advance(self, amount: int) -> None:
            self._bar.update(amount)

        def close(self) -> None:
            self._done.set()
            self._clock.join()
            self._bar.close()

    return Bar()


def count(number: int) -> str:
    """Return a number with thousands separated."""
    return f"{number:,}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number for people; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}g}"


def table(rows: list[tuple[str, ...]], header: tuple[str, ...]) -> str:
    """Return rows as aligned columns; the first is left, the others right aligned."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(row: tuple[str, ...]) -> str:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        return "  ".join(cells).rstrip()

    return "\n".join([line(header), line(tuple("-" * width for width in widths)), *map(line, rows)])
