"""What a task brings home besides its result: warnings and seconds; and how it is run alone in its process."""

from __future__ import annotations

import errno
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from gsplat_tools.errors import GsplatWarning, ReadError, WriteError
from gsplat_tools.formats._store_requests import store_timeout, use_store_timeout
from gsplat_tools.parallel import use_jobs

DEFAULT_RETRIES = 3
"""Times that a task is tried again after an error that may pass, or after its worker died."""

# Tasks use all the threads they are given by themselves, and the list of warnings is one for all threads of a process.
_alone = threading.Lock()


@dataclass(slots=True)
class Outcome:
    """What a task returned, or how it failed in a way that trying again does not change."""

    value: Any = None
    error: Exception | None = None
    warnings: list[GsplatWarning] = field(default_factory=list)
    seconds: float = 0.0
    full: tuple[str, str] | None = None
    """Where the disk of a worker was full: its address, and the key of the task that met it."""

    def result(self) -> Any:
        """Return the value, or raise the error."""
        if self.error is not None:
            raise self.error
        return self.value


def is_passing(error: BaseException) -> bool:
    """Whether an error may be gone when the task is tried again, perhaps elsewhere: disks, stores and memory."""
    return isinstance(error, ReadError | WriteError | ConnectionError | TimeoutError | MemoryError) or (
        isinstance(error, OSError) and not isinstance(error, FileNotFoundError | FileExistsError | PermissionError)
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """What a task takes over from the process that hands it in.

    Parameters
    ----------
    jobs
        Threads; None leaves it to the machine.
    store_timeout
        As `use_store_timeout` takes it.
    """

    jobs: int | None
    store_timeout: float = field(default_factory=store_timeout)


def is_full(error: BaseException | None) -> bool:
    """Whether an error came from a disk without space, which it stays for as long as the task's worker is the same."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__
    return False


def run_task(function: Callable[..., Any], settings: Settings, *arguments: Any) -> Outcome:
    """Run a task; errors that may pass are raised, so that the engine tries again, others are returned."""
    given = [each.result() if isinstance(each, Outcome) else each for each in arguments]
    start = time.perf_counter()
    within = use_store_timeout(settings.store_timeout)
    with _alone, use_jobs(settings.jobs), within, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        outcome = Outcome()
        try:
            outcome.value = function(*given)
        except Exception as error:
            if is_passing(error):
                raise
            outcome.error = error
    outcome.warnings = [each.message for each in caught if isinstance(each.message, GsplatWarning)]
    outcome.seconds = time.perf_counter() - start
    return outcome


def warn_again(outcomes: list[Outcome]) -> None:
    """Give the warnings of tasks to whoever listens here, each once."""
    seen: set[tuple[str, str]] = set()
    for outcome in outcomes:
        for warning in outcome.warnings:
            if (warning.code, str(warning)) not in seen:
                seen.add((warning.code, str(warning)))
                warnings.warn(warning, stacklevel=3)


def caught(function: Callable[[], Outcome]) -> Outcome | Exception:
    """Return what a function returns, or the exception that it raises."""
    try:
        return function()
    except Exception as error:
        return error
