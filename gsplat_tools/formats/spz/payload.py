"""The attributes of a file as rows of bytes: in memory, or in a temporary file where they are many."""

from __future__ import annotations

from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats._files import reserve
from gsplat_tools.formats.spz.header import Header

Bytes = NDArray[np.uint8]
Payload = dict[str, Bytes]
"""(N, width) bytes of every attribute that has any, by name."""

_IN_MEMORY = 64 << 20


def allocate(header: Header, *, in_memory: bool) -> Payload:
    """Return room for the attributes; above 64 MiB it is a temporary file unless `in_memory`."""
    room = _Room(in_memory or header.raw_length() <= _IN_MEMORY)
    return {name: room.take(header.num_splats, width) for name, width in header.attributes().items() if width}


class _Room:
    """Makes arrays."""

    def __init__(self, in_memory: bool) -> None:
        self._in_memory = in_memory

    def take(self, rows: int, width: int) -> Bytes:
        """Return an array that holds anything."""
        if self._in_memory or rows * width == 0:
            return np.empty((rows, width), np.uint8)
        with TemporaryFile() as file:  # the mapping keeps it alive
            reserve(file, rows * width)
            mapped: Any = np.memmap(file, np.uint8, "r+", shape=(rows, width))
            return np.asarray(mapped)
