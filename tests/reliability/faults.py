"""Faults on demand: kill a process, or fail a call, at any operation on the file system that a writer makes."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from gsplat_tools.errors import GsplatError
from gsplat_tools.formats import _atomic, _files

OPERATIONS = ("open", "write", "fsync", "chmod", "link", "replace", "unlink")
"""What can be counted and hit; `write` is one system call on a target's temporary file, flushes of buffers included."""

TRACED = ("_atomic.py", "_companion.py", "_files.py", "_folder.py", "saving.py")
"""Modules whose every line is a place to be killed at."""

EXIT_REFUSED, EXIT_UNEXPECTED = 3, 4

Act = Callable[[Callable[[], Any], str, tuple[Any, ...]], Any]
"""What to do at an operation: given the operation itself, its name and its arguments."""


@dataclass
class Operations:
    """Counts operations, and does something else at some of them.

    Parameters
    ----------
    at
        Number of the operation to hit, from 0; None hits none.
    act
        What to do there.
    keeps_on
        Whether every later operation of the same name is hit too, as on a disk that stays full.
    buffer
        Bytes of the writer's buffer; few make a small scene take many writes.
    """

    at: int | None = None
    act: Act | None = None
    keeps_on: bool = False
    buffer: int = 256
    names: list[str] = field(default_factory=list)
    _hit: str | None = None

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Watch the operations inside the block."""
        places: list[tuple[Any, str, Any]] = [(_files, "_raw_write", _files._raw_write)]
        places += [(os, name, getattr(os, name)) for name in OPERATIONS if name != "write"]
        size = _atomic._BUFFER_BYTES
        _atomic._BUFFER_BYTES = self.buffer
        for holder, attribute, original in places:
            setattr(holder, attribute, self._watching(attribute.removeprefix("_raw_"), original))
        try:
            yield
        finally:
            _atomic._BUFFER_BYTES = size
            for holder, attribute, original in places:
                setattr(holder, attribute, original)

    def _watching(self, name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            number = len(self.names)
            self.names.append(name)
            is_hit = number == self.at or (self.keeps_on and name == self._hit)
            if is_hit and self.act is not None:
                self._hit = name
                return self.act(lambda *new: original(*(new or args), **options), name, args)
            return original(*args, **options)

        return call


def die_before(_call: Callable[..., Any], _name: str, _args: tuple[Any, ...]) -> None:
    """End the process at once, the operation not done."""
    os.kill(os.getpid(), signal.SIGKILL)


def die_after(call: Callable[..., Any], _name: str, _args: tuple[Any, ...]) -> None:
    """End the process at once, the operation done."""
    try:
        call()
    finally:
        os.kill(os.getpid(), signal.SIGKILL)


def die_halfway(call: Callable[..., Any], name: str, args: tuple[Any, ...]) -> None:
    """End the process at once, a write half done."""
    if name == "write":
        call(args[0], args[1][: len(args[1]) // 2])
    os._exit(1)


def lose(_call: Callable[..., Any], _name: str, args: tuple[Any, ...]) -> int:
    """Say that bytes are written, and move on without writing them."""
    file, data = args
    file.seek(len(data), io.SEEK_CUR)
    return len(data)


def spoil(call: Callable[..., Any], _name: str, args: tuple[Any, ...]) -> Any:
    """Write one bit differently."""
    changed = bytearray(args[1])
    changed[len(changed) // 2] ^= 0x10
    return call(args[0], changed)


def failing(number: int, *, halfway: bool = False) -> Act:
    """Return an act that fails with an error number, as the operating system does; a write may first do its half."""

    def act(call: Callable[..., Any], name: str, args: tuple[Any, ...]) -> Any:
        if halfway and name == "write":
            return call(args[0], args[1][: max(1, len(args[1]) // 2)])
        raise OSError(number, os.strerror(number))

    return act


def operations_of(work: Callable[[], object]) -> list[str]:
    """Return the names of the operations that some work does."""
    watched = Operations()
    with watched.installed():
        work()
    return watched.names


def in_child(work: Callable[[], object], *, kill_after: float | None = None) -> int:
    """Do some work in a forked child.

    Parameters
    ----------
    work
        What to do.
    kill_after
        Seconds until the child is killed, if it still runs.

    Returns
    -------
    int
        0, EXIT_REFUSED for a GsplatError, EXIT_UNEXPECTED for anything else, or minus the signal that ended the child.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the threads of the pool are idle
        child = os.fork()
    if child == 0:
        code = EXIT_UNEXPECTED
        try:
            work()
            code = 0
        except GsplatError:
            code = EXIT_REFUSED
        finally:
            os._exit(code)
    if kill_after is not None:
        end = time.perf_counter() + kill_after
        while (left := end - time.perf_counter()) > 0:
            time.sleep(min(left, 0.001) if left > 0.002 else 0)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at_line(work: Callable[[], object], line: int) -> int:
    """Do some work in a child that is killed when a line of TRACED is about to run, counted from 0; return its exit status."""

    def count_down(number: int, _place: str) -> None:
        if number == line:
            os.kill(os.getpid(), signal.SIGKILL)

    return in_child(lambda: _traced(work, count_down))


def interrupted_at_line(work: Callable[[], object], line: int) -> bool:
    """Do some work that a SystemExit, as from a signal, ends when a line of TRACED is about to run; return whether it did."""

    def count_down(number: int, _place: str) -> None:
        if number == line:
            raise SystemExit

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # a file that nobody got to see is closed with its object
        try:
            _traced(work, count_down)
        except SystemExit:
            is_ended = True
        else:
            is_ended = False
    return is_ended


def lines_of(work: Callable[[], object]) -> list[str]:
    """Return where every line of TRACED that some work runs stands, in the order in which they run."""
    places: list[str] = []
    _traced(work, lambda _number, place: places.append(place))
    return places


def _traced(work: Callable[[], object], at: Callable[[int, str], object]) -> None:
    """Do some work, calling a function with number and place before every line of TRACED."""
    count = 0

    def trace(frame: FrameType, event: str, _arg: object) -> Any:
        nonlocal count
        if event == "call" and not frame.f_code.co_filename.endswith(TRACED):
            return None
        if event == "line":
            number, count = count, count + 1
            at(number, f"{Path(frame.f_code.co_filename).name}:{frame.f_code.co_name}:{frame.f_lineno}")
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)


def leftovers(folder: Path) -> list[str]:
    """Return the names of temporary files in a folder."""
    return sorted(entry.name for entry in folder.iterdir() if ".gsplat-tmp" in entry.name)
