"""Progress of long work: the library tells, whoever called it decides what to show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol


class Stage(Protocol):
    """One named piece of work."""

    def advance(self, amount: int) -> None:
        """Say that `amount` more units are done."""

    def close(self) -> None:
        """Say that the work has ended."""


class _Silent:
    """Shows nothing."""

    def advance(self, amount: int) -> None:
        pass

    def close(self) -> None:
        pass


Reporter = Callable[[str, int, str], Stage]
"""Label, total (0 where unknown) and unit, to a stage."""

_reporter: ContextVar[Reporter | None] = ContextVar("gsplat_tools_progress", default=None)


@contextmanager
def report_to(reporter: Reporter | None) -> Iterator[None]:
    """Report the stages of work done inside the block to `reporter`."""
    token = _reporter.set(reporter)
    try:
        yield
    finally:
        _reporter.reset(token)


@contextmanager
def stage(label: str, total: int = 0, unit: str = "splats") -> Iterator[Stage]:
    """Announce a piece of work of `total` units; nothing happens unless somebody listens."""
    reporter = _reporter.get()
    current = _Silent() if reporter is None else reporter(label, total, unit)
    try:
        yield current
    finally:
        current.close()
