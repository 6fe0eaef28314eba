"""GsplatError to one line on stderr and an exit status."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import click

from gsplat_tools.errors import GsplatError

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

EXIT_DATA = 1
EXIT_INTERRUPTED = 130


def one_line(text: object) -> str:
    """Return a text without line breaks."""
    return " ".join(str(text).split())


def reports_errors(command: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Turn errors about data into one line on stderr and exit status 1."""

    @functools.wraps(command)
    def wrapped(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        try:
            return command(*args, **kwargs)
        except GsplatError as error:
            click.echo(f"error: {one_line(error)}", err=True)
        except MemoryError:
            click.echo("error: not enough memory for this scene; convert it to a target that streams (.gspk, .ply)", err=True)
        except BrokenPipeError:
            sys.stderr.close()
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            click.echo(f"error: {place}{one_line(error.strerror or error)}", err=True)
        except KeyboardInterrupt:
            click.echo("interrupted; the target is as it was", err=True)
            sys.exit(EXIT_INTERRUPTED)
        sys.exit(EXIT_DATA)

    return wrapped
