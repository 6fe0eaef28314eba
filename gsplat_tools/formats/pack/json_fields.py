"""Values of a JSON object from outside, each checked for its type."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats._json import shown


def whole(entry: Mapping[str, Any], key: str, *, low: int = 0, high: int = 1 << 62, where: str = "") -> int:
    """Return a whole number of a description.

    Raises
    ------
    CorruptDataError
        It is missing, no whole number, or outside low..high.
    """
    value = entry.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise CorruptDataError(f"expected a whole number from {low} to {high}, found {shown(value)}", field=f"{where}{key}")
    return value


def numbers(entry: Mapping[str, Any], key: str, count: int, *, where: str = "") -> list[float]:
    """Return `count` finite numbers of a description.

    Raises
    ------
    CorruptDataError
        They are missing, not numbers, not finite, or another count.
    """
    values = entry.get(key)
    if not isinstance(values, list) or len(values) != count:
        raise CorruptDataError(f"expected {count} numbers, found {shown(values)}", field=f"{where}{key}")
    return [finite(value, f"{where}{key}") for value in values]


def finite(value: Any, field: str) -> float:
    """Return a finite number of a description.

    Raises
    ------
    CorruptDataError
        It is not one.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise CorruptDataError(f"expected a finite number, found {shown(value)}", field=field)
    return float(value)
