"""Pure functions of arrays that keep their results while something is tried many times."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

MAX_BYTES = 512 << 20
"""Results that are kept at most; the oldest go first."""


class _Memory:
    """Results by what they follow from."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._results: OrderedDict[bytes, tuple[Any, int]] = OrderedDict()
        self._bytes = 0

    def find(self, key: bytes) -> Any:
        with self._lock:
            found = self._results.get(key)
            if found is None:
                return None
            self._results.move_to_end(key)
            return found[0]

    def keep(self, key: bytes, result: Any) -> None:
        parts = result if isinstance(result, tuple) else (result,)
        size = sum(part.nbytes if isinstance(part, np.ndarray) else len(part) for part in parts)
        for part in parts:
            if isinstance(part, np.ndarray):
                part.flags.writeable = False  # it is handed out again
        with self._lock:
            if key in self._results or size > MAX_BYTES:
                return
            self._results[key] = result, size
            self._bytes += size
            while self._bytes > MAX_BYTES:
                self._bytes -= self._results.popitem(last=False)[1][1]


_memory: _Memory | None = None


@contextmanager
def remembering() -> Iterator[None]:
    """Keep the results of remembered functions until the block ends; threads share them."""
    global _memory  # noqa: PLW0603 - worker threads must see it, and a context variable would not reach them
    before = _memory
    _memory = before or _Memory()
    try:
        yield
    finally:
        _memory = before


def remembered(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function of arrays, numbers and text, whose result is arrays or bytes, look for what it returned before.

    Outside `remembering` it is called as it is. Arrays are told apart by all their bytes.
    """
    name = f"{function.__module__}.{function.__qualname__}".encode()

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        memory = _memory
        if memory is None:
            return function(*args, **kwargs)
        digest = hashlib.blake2b(name, digest_size=16)
        for value in (*args, *(item for pair in sorted(kwargs.items()) for item in pair)):
            if isinstance(value, np.ndarray):
                digest.update(f"|{value.dtype.str}{value.shape}".encode())
                digest.update(np.ascontiguousarray(value).view(np.uint8).reshape(-1).data)
            else:
                digest.update(f"|{value!r}".encode())
        key = digest.digest()
        found = memory.find(key)
        if found is None:
            found = function(*args, **kwargs)
            memory.keep(key, found)
        return found  # type: ignore[no-any-return]

    return call
