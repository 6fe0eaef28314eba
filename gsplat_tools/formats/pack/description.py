"""What the JSON of a .gspk says about the cloud, checked; and which streams follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.coordinate_systems import UNKNOWN, is_known
from gsplat_tools.attributes.motion import reach
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, SplatModel, TimeModel, source_format_of
from gsplat_tools.constants import MAX_SH_DEGREE, TEMPORAL_CUTOFF
from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats._json import shown
from gsplat_tools.formats.pack.container import LAYOUTS, StreamLayout
from gsplat_tools.formats.pack.encoding import SplatEncoding
from gsplat_tools.formats.pack.json_fields import numbers, whole

SH_WORDS = {1: 2, 2: 4, 3: 4, 4: 4}
"""Words a splat that Spark's bands take."""

MOTION_LAYOUTS = (
    StreamLayout("velocities", "f32", (3,)),
    StreamLayout("times", "f32", ()),
    StreamLayout("durations", "f32", ()),
)

Box = tuple[list[float], list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """The facts of a .gspk that are not about bytes.

    Parameters
    ----------
    layout, count, degree
        "spark" or "uncompressed"; splats; highest SH band.
    bounds, motion_bounds
        Smallest box round the stored positions, and the same grown by what motion may add, or None.
    origin, coordinate_system, splat_model, source_format, time_model, temporal_cutoff
        As `GaussianCloud` has them; time_model None without motion.
    encoding, rotation
        Ranges and choice of rotation frames of layout "spark".
    """

    layout: str
    count: int
    degree: int
    bounds: Box | None = None
    motion_bounds: Box | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    coordinate_system: str = UNKNOWN
    splat_model: SplatModel = "default"
    source_format: str = ""
    time_model: TimeModel | None = None
    temporal_cutoff: float = TEMPORAL_CUTOFF
    encoding: SplatEncoding | None = None
    rotation: str | None = None

    def stream_layouts(self) -> list[StreamLayout]:
        """Return the streams of such a file, in order."""
        if self.layout == "spark":
            layouts = [StreamLayout("packed", "u32", (4,))]
            layouts += [StreamLayout(f"sh{band}", "u32", (SH_WORDS[band],)) for band in range(1, self.degree + 1)]
        else:
            columns = {"positions": 3, "colors": 4, "scales": 3, "rotations": 4}
            layouts = [StreamLayout(name, "f32", (width,)) for name, width in columns.items()]
            layouts += [StreamLayout("shs", "f32", (REST_COEFFICIENTS[self.degree], 3))] if self.degree else []
        return layouts + (list(MOTION_LAYOUTS) if self.time_model is not None else [])

    def to_json(self) -> dict[str, Any]:
        """Return the description without what is about bytes."""
        entry: dict[str, Any] = {
            "layout": self.layout,
            "count": self.count,
            "degree": self.degree,
            "bounds": _box_to_json(self.bounds),
            "origin": list(self.origin),
            "coordinate_system": self.coordinate_system,
            "splat_model": self.splat_model,
        }
        if self.source_format:
            entry["source_format"] = self.source_format
        if self.encoding is not None:
            entry["splat_encoding"] = self.encoding.to_json()
        if self.rotation is not None:
            entry["rotation"] = self.rotation
        if self.time_model is not None:
            entry |= {"time_model": self.time_model, "motion_bounds": _box_to_json(self.motion_bounds)}
            if self.temporal_cutoff != TEMPORAL_CUTOFF:
                entry["temporal_cutoff"] = self.temporal_cutoff
        return entry

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Description:
        """Return the facts of a description.

        Raises
        ------
        CorruptDataError
            One is missing, of another type, or outside its range.
        """
        layout = _choice(entry, "layout", LAYOUTS)
        time_model = entry.get("time_model")
        x, y, z = numbers(entry, "origin", 3)
        system = entry.get("coordinate_system")
        if not isinstance(system, str) or not (system == UNKNOWN or is_known(system)):
            raise CorruptDataError(
                f"expected axis letters such as RUB, or {UNKNOWN}, found {shown(system)}", field="coordinate_system"
            )
        ranges = entry.get("splat_encoding", {})
        if not isinstance(ranges, dict):
            raise CorruptDataError("expected an object", field="splat_encoding")
        rotation = entry.get("rotation")
        return cls(
            layout=layout,
            count=whole(entry, "count"),
            degree=whole(entry, "degree", high=MAX_SH_DEGREE),
            bounds=_box_from_json(entry, "bounds"),
            motion_bounds=_box_from_json(entry, "motion_bounds"),
            origin=(x, y, z),
            coordinate_system=system,
            splat_model=_choice(entry, "splat_model", get_args(SplatModel)),
            source_format=source_format_of(entry.get("source_format")),
            time_model=None if time_model is None else _choice(entry, "time_model", get_args(TimeModel)),
            temporal_cutoff=_cutoff(entry),
            encoding=SplatEncoding.from_json(ranges) if layout == "spark" else None,
            rotation=rotation if isinstance(rotation, str) else None,
        )

    def metadata(self) -> dict[str, Any]:
        """Return the fields of a `GaussianCloud` that describe it as a whole."""
        return {
            "origin": np.array(self.origin),
            "coordinate_system": self.coordinate_system,
            "splat_model": self.splat_model,
            "source_format": self.source_format,
            "time_model": self.time_model or "window",
            "temporal_cutoff": self.temporal_cutoff,
        }

    def world_box(self, box: Box | None) -> Box | None:
        """Return a box moved by the origin."""
        if box is None:
            return None
        low, high = ([value + shift for value, shift in zip(corner, self.origin, strict=True)] for corner in box)
        return low, high


def _cutoff(entry: Mapping[str, Any]) -> float:
    """Return the cutoff of the gaussian time model, or its default."""
    value = entry.get("temporal_cutoff", TEMPORAL_CUTOFF)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1:
        raise CorruptDataError(f"expected a number between 0 and 1, found {shown(value)}", field="temporal_cutoff")
    return float(value)


def _choice(entry: Mapping[str, Any], key: str, choices: tuple[str, ...]) -> Any:
    """Return a word of a description that is one of `choices`."""
    value = entry.get(key)
    if value not in choices:
        raise CorruptDataError(f"expected one of {', '.join(choices)}, found {shown(value)}", field=key)
    return value


def _box_to_json(box: Box | None) -> dict[str, list[float]] | None:
    """Return a box as the description holds it."""
    return None if box is None else {"min": box[0], "max": box[1]}


def _box_from_json(entry: Mapping[str, Any], key: str) -> Box | None:
    """Return the box of a description."""
    box = entry.get(key)
    if box is None:
        return None
    if not isinstance(box, dict):
        raise CorruptDataError("expected an object with min and max, or null", field=key)
    return numbers(box, "min", 3, where=f"{key}."), numbers(box, "max", 3, where=f"{key}.")


class BoxTally:
    """The smallest box round positions, and how far motion may leave it, gathered over chunks."""

    def __init__(self) -> None:
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)
        self._speed = 0.0
        self._time = 0.0

    def add(self, positions: NDArray[np.floating[Any]], cloud: GaussianCloud) -> None:
        """Take stored positions (N, 3), and the motion of the cloud that they come from, into account."""
        if len(positions) == 0:
            return
        # Column by column: numpy reduces short rows slowly.
        self._low = np.minimum(self._low, [column.min() for column in positions.T])
        self._high = np.maximum(self._high, [column.max() for column in positions.T])
        if cloud.velocities is not None and cloud.durations is not None:
            self._speed = max(self._speed, float(np.linalg.norm(cloud.velocities.astype(np.float64), axis=1).max()))
            self._time = max(self._time, float(cloud.durations.max()))

    def box(self) -> Box | None:
        """Return the box, or None without positions."""
        return (self._low.tolist(), self._high.tolist()) if np.isfinite(self._low).all() else None

    def motion_box(self, time_model: TimeModel | None, cutoff: float = TEMPORAL_CUTOFF) -> Box | None:
        """Return the box grown by the largest speed times the longest time, or None without motion."""
        if time_model is None or not np.isfinite(self._low).all():
            return None
        margin = reach(self._speed, self._time, time_model, cutoff)
        return ((self._low - margin).tolist(), (self._high + margin).tolist()) if np.isfinite(margin) else None
