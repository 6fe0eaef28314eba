"""JSON from outside, held against limits so that few bytes become no crowd of objects; and values made fit for JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

MAX_BYTES = 64 << 20
"""A description that is longer is refused; that of 100,000 frames has about 30 MB."""

MAX_DEPTH = 256
"""Containers inside containers; trees of levels of detail have some dozens."""

_BYTES_A_VALUE = 40
_ALWAYS_READ = 32 << 20


def parse(data: bytes, *, parse_constant: Callable[[str], Any] | None = None) -> Any:
    """Return the value of a JSON text.

    Parameters
    ----------
    data
        UTF-8, with or without a byte order mark.
    parse_constant
        Called for NaN and infinities; by default they are taken.

    Raises
    ------
    ValueError
        The bytes are not JSON, or its objects would take far more memory than its text.
    """
    # Commas and brackets count the values; strings may hold some too, which only makes the estimate larger.
    containers = data.count(b"[") + data.count(b"{")
    estimate = _BYTES_A_VALUE * (data.count(b",") + containers)
    if len(data) > MAX_BYTES or estimate > _ALWAYS_READ + 3 * len(data):
        raise ValueError(f"{len(data)} bytes that hold about {estimate // _BYTES_A_VALUE} values are too many")
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_constant=parse_constant)
    except RecursionError:
        raise ValueError(f"more than {MAX_DEPTH} lists and objects inside each other") from None
    if containers > MAX_DEPTH and _depth(value) > MAX_DEPTH:
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
