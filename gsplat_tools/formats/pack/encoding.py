"""The ranges between which Spark's fields are quantized, and the tightest ones for a scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats.pack.json_fields import finite

FLAT_LN_SCALE = -30.0
"""Scales below e^-30 are stored as exactly flat."""

MAX_BAND = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatEncoding:
    """Ranges of the quantized fields; the defaults are Spark's, and the only ones that gsplat-unity knows.

    Parameters
    ----------
    rgb_min, rgb_max
        Color of codes 0 and 255, where color = sh0 * SH_C0 + 0.5.
    ln_scale_min, ln_scale_max
        Natural log of the scales of codes 1 and 255.
    sh1_max, sh2_max, sh3_max, sh4_max
        Largest SH coefficient of each band.

    Raises
    ------
    ValueError
        A range is empty or not finite.
    """

    rgb_min: float = 0.0
    rgb_max: float = 1.0
    ln_scale_min: float = -12.0
    ln_scale_max: float = 9.0
    sh1_max: float = 1.0
    sh2_max: float = 1.0
    sh3_max: float = 1.0
    sh4_max: float = 1.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("rgb", self.rgb_min, self.rgb_max),
            ("ln_scale", self.ln_scale_min, self.ln_scale_max),
            *((f"sh{band}", 0.0, self.sh_max(band)) for band in range(1, MAX_BAND + 1)),
        ):
            if not 1e-12 < high - low < 1e12:
                raise ValueError(f"the range of {name} must have an extent between 1e-12 and 1e12, got {low} to {high}")

    def sh_max(self, band: int) -> float:
        """Return the largest coefficient of band 1 to 4."""
        return float(getattr(self, f"sh{band}_max"))

    @property
    def ln_scale_step(self) -> float:
        """Natural log of the ratio between neighboring scale codes."""
        return (self.ln_scale_max - self.ln_scale_min) / 254

    def to_json(self) -> dict[str, float]:
        """Return the ranges under the names of Spark's `splatEncoding`, and `sh4Max`."""
        return {_spark_name(field.name): getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> SplatEncoding:
        """Return the ranges of a `splatEncoding`; names that are missing keep their defaults.

        Raises
        ------
        CorruptDataError
            A value is no finite number, or a range is empty.
        """
        names = {_spark_name(field.name): field.name for field in fields(cls)}
        values = {names[key]: finite(value, f"splat_encoding.{key}") for key, value in entry.items() if key in names}
        try:
            return cls(**values)
        except ValueError as error:
            raise CorruptDataError(str(error), field="splat_encoding") from error


def _spark_name(name: str) -> str:
    """Return rgbMin for rgb_min."""
    first, *rest = name.split("_")
    return first + "".join(word.capitalize() for word in rest)


def fit_encoding(chunks: Iterable[GaussianCloud]) -> SplatEncoding:
    """Return the tightest ranges that clamp nothing.

    Parameters
    ----------
    chunks
        The parts of a scene, or a list of one cloud. Values that are not finite, and scales below e^-30, which are
        stored as flat, do not count.

    Returns
    -------
    SplatEncoding
        Each range widened to float32 numbers, which renderers keep it in; where nothing is to be stored, the default.
    """
    low = {"rgb": np.inf, "ln": np.inf}
    high = {"rgb": -np.inf, "ln": -np.inf} | {f"sh{band}": 0.0 for band in range(1, MAX_BAND + 1)}
    for cloud in chunks:
        log_scales = cloud.log_scales.astype(np.float64)
        is_finite = np.isfinite(cloud.sh0)
        if is_finite.any():
            low["rgb"] = min(low["rgb"], float(cloud.sh0.min(where=is_finite, initial=np.inf)))
            high["rgb"] = max(high["rgb"], float(cloud.sh0.max(where=is_finite, initial=-np.inf)))
        counts = np.isfinite(log_scales) & (log_scales >= FLAT_LN_SCALE)
        low["ln"] = min(low["ln"], float(log_scales.min(where=counts, initial=np.inf)))
        high["ln"] = max(high["ln"], float(log_scales.max(where=counts, initial=-np.inf)))
        for band in range(1, cloud.sh_degree + 1):
            values = cloud.shN[:, band * band - 1 : (band + 1) ** 2 - 1]
            largest = np.abs(values).max(where=np.isfinite(values), initial=0.0)
            high[f"sh{band}"] = max(high[f"sh{band}"], float(largest))
    changes: dict[str, float] = {}
    if low["rgb"] <= high["rgb"]:
        colors = _widened(low["rgb"] * SH_C0 + 0.5, high["rgb"] * SH_C0 + 0.5, 1e-3)
        changes |= dict(zip(("rgb_min", "rgb_max"), colors, strict=True))
    if low["ln"] <= high["ln"]:
        changes |= dict(zip(("ln_scale_min", "ln_scale_max"), _widened(low["ln"], high["ln"], 1e-3), strict=True))
    for band in range(1, MAX_BAND + 1):
        if high[f"sh{band}"] > 0:
            changes[f"sh{band}_max"] = _widened(0.0, high[f"sh{band}"], 1e-6)[1]
    return SplatEncoding(**changes)


def _widened(low: float, high: float, extent: float) -> tuple[float, float]:
    """Return float32 numbers round low..high that are at least `extent` apart."""
    high = max(high, low + extent)
    narrow_low, narrow_high = np.float32(low), np.float32(high)
    if narrow_low > low:
        narrow_low = np.nextafter(narrow_low, np.float32(-np.inf))
    if narrow_high < high:
        narrow_high = np.nextafter(narrow_high, np.float32(np.inf))
    return float(narrow_low), float(narrow_high)
