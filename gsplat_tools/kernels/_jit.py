"""The only file that sets numba options.

Threads come from `gsplat_tools.parallel`: kernels are serial loops over a block and release the interpreter lock.
That keeps compilation short (no parallel transform) and results the same for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import njit
from numba.core import event

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _compiled(**options: Any) -> Decorator:
    """Return the decorator; where no folder can be written for its cache, it compiles anew in every process."""
    # fastmath stays off: the reference must give the same bits on every machine.
    fixed = {"nogil": True, "fastmath": False, "error_model": "numpy", **options}

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return cast("Callable[..., Any]", njit(cache=True, **fixed)(function))
        except RuntimeError:
            return cast("Callable[..., Any]", njit(cache=False, **fixed)(function))

    return decorate


def kernel() -> Decorator:
    """Compile a loop over arrays; the result is cached on disk."""
    return _compiled()


def device() -> Decorator:
    """Compile a scalar function that kernels call; LLVM decides where it is inlined."""
    return _compiled(inline="never")


class _FirstCompilation(event.Listener):
    """Calls back once, when a kernel has to be compiled because no cached code was found."""

    def __init__(self, announce: Callable[[], None]) -> None:
        self._announce: Callable[[], None] | None = announce

    def on_start(self, _event: Any) -> None:
        if self._announce is not None:
            announce, self._announce = self._announce, None
            announce()

    def on_end(self, _event: Any) -> None:
        pass


def announce_compilation(announce: Callable[[], None]) -> None:
    """Call `announce` the first time that this process compiles a kernel instead of loading it from the cache."""
    event.register("numba:compile", _FirstCompilation(announce))
