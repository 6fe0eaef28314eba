"""JSON from outside, held against limits so that few bytes become no crowd of objects; and values made fit for JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from gsplat_tools.formats._limits import max_memory

ALWAYS_READ = 40 << 20
"""Memory that a description may take whatever holds it: its bytes, its text and its values, all at once. With what else a
reader needs that stays within 64 MiB; a sequence of 16,000 frames and a tree of 5,000 leaves in 5 levels take less."""

_MEMORY_A_BYTE = 2  # of a file whose frames are many: each takes several entries, far larger than what describes it

MAX_DEPTH = 256
"""Containers inside containers; trees of levels of detail have some dozens."""

# Bytes that CPython takes for a value: a number and its place in a list that grew, an object of up to five fields, an empty
# list, half a string (one quote) besides its characters, and a field in an object that grew and among the names known so far.
_VALUE, _OBJECT, _LIST, _QUOTE, _FIELD = 40, 192, 72, 28, 64


def allowed_memory(available: int) -> int:
    """Return the memory that the description of a file of `available` bytes may take, its bytes and text included."""
    return max(ALWAYS_READ, _MEMORY_A_BYTE * available if max_memory() is None else max_memory() or 0)


def longest(available: int) -> int:
    """Return the longest description that is worth reading: its text takes as much again."""
    return allowed_memory(available) // 2


def memory_of(data: bytes) -> int:
    """Return an upper estimate of the memory that a JSON text takes while it is parsed: bytes, text and values.

    Structure is counted by its signs; strings may hold some too, which only makes the estimate larger.
    """
    highest = 0 if data.isascii() else int(np.frombuffer(data, np.uint8).max())
    # One character of another alphabet makes CPython take two bytes for each, one beyond the first 65,536 takes four.
    width = 1 if highest < 0xC4 else 2 if highest < 0xF0 else 4
    characters = width
    if b"\\" in data:
        # Escapes hide such characters, and a string with escapes grows by a quarter at a time, until it has to be widened.
        characters = max(width, (4 if b"\\ud" in data or b"\\uD" in data else 2) if b"\\u" in data else 1)
        characters = (5 * (1 + characters) + 3) // 4
    objects, lists = data.count(b"{"), data.count(b"[")
    structure = (
        _VALUE * (data.count(b",") + objects + lists)
        + _OBJECT * objects
        + _LIST * lists
        + _QUOTE * data.count(b'"')
        + _FIELD * data.count(b":")
    )
    return len(data) * (1 + width + characters) + structure


def parse(data: bytes, *, available: int = 0, parse_constant: Callable[[str], Any] | None = None) -> Any:
    """Return the value of a JSON text.

    Parameters
    ----------
    data
        UTF-8, with or without a byte order mark.
    available
        Bytes of the file that the text describes and is a part of: a large file may have a large description.
    parse_constant
        Called for NaN and infinities; by default they are taken.

    Raises
    ------
    ValueError
        The bytes are not JSON, or would take more memory than `allowed_memory`.
    """
    estimate = memory_of(data)
    if estimate > allowed_memory(available):
        raise ValueError(
            f"{len(data)} bytes that take up to {estimate} in memory are too many; if you trust the file, allow them with "
            "--max-memory (library: use_max_memory)"
        )
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_constant=parse_constant)
    except RecursionError:
        raise ValueError(f"more than {MAX_DEPTH} lists and objects inside each other") from None
    if data.count(b"[") + data.count(b"{") > MAX_DEPTH and _depth(value) > MAX_DEPTH:
        raise ValueError(f"more than {MAX_DEPTH} lists and objects inside each other")
    return value


def _depth(value: Any) -> int:
    """Return how many containers lie inside each other at most; stops a little above MAX_DEPTH."""
    depth, level = 0, [value]
    while level and depth <= MAX_DEPTH:
        level = [
            item
            for node in level
            if isinstance(node, list | dict)
            for item in (node.values() if isinstance(node, dict) else node)
            if isinstance(item, list | dict)
        ]
        depth += 1
    return depth


def shown(value: Any) -> str:
    """Return a value for a message: short, and never deeper than a line."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def finite(value: Any) -> Any:
    """Return JSON values with None for every number that JSON cannot hold."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value
