"""The only file that sets numba options.

Threads come from `gsplat_tools.parallel`: kernels are serial loops over a block and release the interpreter lock.
That keeps compilation short (no parallel transform) and results the same for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

from numba import njit
from numba.core import event

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# fastmath stays off: the reference must give the same bits on every machine.
kernel = cast("Callable[[], Decorator]", partial(njit, cache=True, nogil=True, fastmath=False, error_model="numpy"))
"""Compiles a loop over arrays; the result is cached on disk."""

device = cast(
    "Callable[[], Decorator]",
    partial(njit, cache=True, nogil=True, fastmath=False, error_model="numpy", inline="never"),
)
"""Compiles a scalar function that kernels call; LLVM decides where it is inlined."""


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
