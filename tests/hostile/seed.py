"""A valid file to start from, and which of its bytes say something about the others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import Literal


@dataclass(frozen=True)
class Span:
    """Header or meta bytes: numbers in binary, or text."""

    start: int
    stop: int
    kind: Literal["binary", "text"] = "binary"


def unsealed(data: bytes) -> bytes:
    """For files without checksums over their meta bytes."""
    return data


@dataclass(frozen=True)
class Seed:
    """A file that a reader takes.

    name        what reports call it
    filename    what it is called on disk
    data        its bytes, before `seal`
    spans       header and meta bytes
    seal        makes checksums right again, or compresses, so that a change reaches the code behind them
    rebuild     each assembles a hostile relative of the file, field by field
    beside      files that lie in the same folder
    relatives   hostile files that follow from the fields of its description, sealed
    named       hostile files, and a few sound ones, that are there for one rule each, sealed
    target      the file that is read, where it is not this one but refers to it
    """

    name: str
    filename: str
    data: bytes
    spans: tuple[Span, ...] = ()
    seal: Callable[[bytes], bytes] = unsealed
    rebuild: tuple[Callable[[Random], bytes], ...] = ()
    beside: Mapping[str, bytes] = field(default_factory=dict)
    target: str | None = None
    relatives: Callable[[], Iterable[tuple[str, bytes]]] = tuple
    named: Callable[[], Iterable[tuple[str, bytes]]] = tuple
