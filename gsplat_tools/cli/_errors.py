"""GsplatError to one line on stderr and an exit status."""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ParamSpec, TypeVar

import click

from gsplat_tools.errors import GsplatError, GsplatWarning, quoted

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

EXIT_DATA = 1
EXIT_INTERRUPTED = 130

_AGAIN_SECONDS = 0.05


def one_line(text: object) -> str:
    """Return a text without line breaks and control characters."""
    return quoted(" ".join(str(text).split()))


class _EndedError(SystemExit):
    """A signal ends the command."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number


def _end_cleanly_on_signals() -> None:
    """Let SIGTERM and SIGHUP unwind the stack, so that temporary files are removed."""
    said = set[int]()

    def end(number: int, _frame: object) -> None:
        if number not in said:
            click.echo(f"ended by {signal.Signals(number).name}; the target is as it was", err=True)
        said.add(number)
        raise _EndedError(number)

    _listen(end)


@contextmanager
def _ending_after_finalizers() -> Iterator[None]:
    """Send a signal again that came while a finalizer ran: what it raises there is forgotten, and in a hook as well."""
    report = sys.unraisablehook

    def end_again(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, _EndedError):
            again = threading.Timer(_AGAIN_SECONDS, os.kill, (os.getpid(), unraisable.exc_value.number))
            again.daemon = True
            again.start()
        else:
            report(unraisable)

    sys.unraisablehook = end_again
    try:
        yield
    finally:
        sys.unraisablehook = report


def _listen(handler: Any) -> None:
    """Set what happens on SIGTERM and SIGHUP."""
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), handler)


@contextmanager
def _showing_warnings() -> Iterator[None]:
    """Show each of our warnings once, as a line on stderr; leave everyone else's alone."""
    shown: set[str] = set()
    show_other = warnings.showwarning

    def show(message: Warning | str, *details: Any, **more: Any) -> None:
        if not isinstance(message, GsplatWarning):
            show_other(message, *details, **more)
        elif str(message) not in shown:
            shown.add(str(message))
            click.echo(f"warning: {one_line(message)}", err=True)

    with warnings.catch_warnings():
        warnings.simplefilter("always", GsplatWarning)
        warnings.showwarning = show
        yield


def _comes_from_printing(error: OSError) -> bool:
    """Whether click met the error; it opens no files for us."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and str(trace.tb_frame.f_globals.get("__name__")).startswith("click.")


@contextmanager
def names_stdout() -> Iterator[None]:
    """End with one line and exit status 1 where stdout cannot be written, in help texts as well."""
    try:
        yield
    except OSError as error:
        if isinstance(error, BrokenPipeError) or not _comes_from_printing(error):
            raise
        click.echo(f"error: standard output: cannot write: {one_line(error.strerror or error)}", err=True)
        # What is left in its buffer would fail again, in words of Python, when the process ends.
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
        sys.exit(EXIT_DATA)


def reports_errors(command: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Turn errors about data into one line on stderr and exit status 1."""

    @functools.wraps(command)
    def wrapped(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        _end_cleanly_on_signals()
        try:
            with _showing_warnings(), _ending_after_finalizers():
                return command(*args, **kwargs)
        except GsplatError as error:
            click.echo(f"error: {one_line(error)}", err=True)
        except MemoryError:
            advice = "convert it to a target that streams (.gspk, .ply), or to .sog4d with --block-splats 262144"
            click.echo(f"error: not enough memory for this scene; {advice}", err=True)
        except BrokenPipeError:
            sys.stderr.close()
        except OSError as error:
            if _comes_from_printing(error):
                raise  # see `names_stdout`
            place = f"{one_line(error.filename)}: " if error.filename else ""
            click.echo(f"error: {place}{one_line(error.strerror or error)}", err=True)
        except _EndedError:
            _listen(signal.SIG_IGN)  # a second one would show as a traceback of what libraries do at the very end
            raise
        except KeyboardInterrupt:
            click.echo("interrupted; the target is as it was", err=True)
            sys.exit(EXIT_INTERRUPTED)
        sys.exit(EXIT_DATA)

    return wrapped
