"""What a file may claim: decoded sizes, held against its own size or against a limit that the caller sets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from gsplat_tools.cloud import REST_COEFFICIENTS
from gsplat_tools.errors import LimitExceededError

MAX_EXPANSION = 1024
"""A file that claims more than this many times its size is refused before anything is allocated."""

ALWAYS_READ = 16 << 20
"""Decoded bytes that a file may claim whatever its size: splats that are all alike compress without limit."""

_max_memory: int | None = None
# Not a context variable: frames of a sequence are read in threads, which do not inherit those.


@contextmanager
def use_max_memory(size: int | None) -> Iterator[None]:
    """Let files claim up to `size` decoded bytes inside the block, in all threads, whatever their own size.

    Parameters
    ----------
    size
        Bytes; None goes back to MAX_EXPANSION times the size of the file.
    """
    if size is not None and size < 1:
        raise ValueError(f"size must be at least 1, got {size}")
    global _max_memory  # noqa: PLW0603
    before, _max_memory = _max_memory, size
    try:
        yield
    finally:
        _max_memory = before


def max_memory() -> int | None:
    """Return what `use_max_memory` set."""
    return _max_memory


def allowed_bytes(available: int) -> int:
    """Return the decoded bytes that `available` bytes of a file may claim."""
    return max(available * MAX_EXPANSION, ALWAYS_READ) if _max_memory is None else _max_memory


def too_much(claimed: int, available: int) -> str | None:
    """Return why a claim is refused and what can be done, or None where it is not."""
    if claimed <= allowed_bytes(available):
        return None
    rule = f"more than {MAX_EXPANSION} times" if _max_memory is None else f"more than the {_max_memory} allowed"
    source = "" if available == claimed else f" from {available} stored ones"
    return (
        f"{claimed} decoded bytes are claimed{source}, {rule}; if you trust the file, allow it with "
        "--max-memory (library: use_max_memory)"
    )


def check_claim(claimed: int, available: int, *, field: str, offset: int | None = None) -> None:
    """Refuse a decoded size that no honest file of `available` bytes would claim.

    Raises
    ------
    LimitExceededError
        `claimed` bytes are more than what `use_max_memory` set, or else more than MAX_EXPANSION times `available`.
    """
    message = too_much(claimed, available)
    if message is not None:
        raise LimitExceededError(message, field=field, offset=offset)


def check_splats(
    count: int, sh_degree: int, available: int | None, *, field: str, offset: int | None = None, has_motion: bool = False
) -> None:
    """Refuse a number of splats whose float32 arrays no honest file of `available` bytes would need.

    Parameters
    ----------
    count, sh_degree, has_motion
        What the file says that it holds.
    available
        Bytes of the file; None where records of a fixed size bound the count, so that only `use_max_memory` is left.
    field, offset
        What says so.

    Raises
    ------
    LimitExceededError
        As `check_claim`.
    """
    claimed = count * splat_bytes(sh_degree, has_motion=has_motion)
    check_claim(claimed, claimed if available is None else available, field=field, offset=offset)


def splat_bytes(sh_degree: int, *, has_motion: bool = False) -> int:
    """Return the bytes of one splat in memory: 14 float32 and its SH, 5 more where it moves."""
    return 4 * (14 + 3 * REST_COEFFICIENTS[sh_degree] + (5 if has_motion else 0))
