"""GaussianCloud: the one data model in the middle; every format meets every other only here."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.coordinate_systems import UNKNOWN, is_known
from gsplat_tools.constants import MAX_SH_DEGREE, TEMPORAL_CUTOFF
from gsplat_tools.errors import CloudError

Float32 = NDArray[np.float32]
SplatModel = Literal["default", "antialiased", "2dgs"]
TimeModel = Literal["window", "gaussian"]

REST_COEFFICIENTS = tuple((degree + 1) ** 2 - 1 for degree in range(MAX_SH_DEGREE + 1))
"""Coefficients above the constant term, per SH degree: 0, 3, 8, 15, 24."""

_WIDTHS = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": None, "sh0": 3}
_MOTION_WIDTHS = {"velocities": 3, "times": None, "durations": None}
_FORMAT_ID = re.compile("[a-z0-9][a-z0-9-]{0,31}")


@dataclass(frozen=True, slots=True, eq=False)
class GaussianCloud:
    """N Gaussians as arrays, in the space that a 3DGS PLY stores.

    Arrays are made C-contiguous float32 on construction and must not be changed afterwards.

    Parameters
    ----------
    means
        (N, 3) centers, world units, relative to `origin`.
    log_scales
        (N, 3) natural logarithm of the standard deviations in world units; -inf is a flat axis.
    quats
        (N, 4) wxyz, local to world, as stored (not normalized).
    opacity_logits
        (N,) opacity before the sigmoid; +-inf are legal.
    sh0
        (N, 3) SH coefficient of the constant term, RGB.
    shN
        (N, K - 1, 3) higher SH coefficients, basis-major, K = (degree + 1)^2.
    velocities
        (N, 3) displacement per 1.0 of normalized time, or None.
    times
        (N,) window start, or center of the temporal Gaussian, normalized time, or None.
    durations
        (N,) window length, or standard deviation, normalized time, or None.
    time_model
        How `times` and `durations` are read: "window" or "gaussian".
    temporal_cutoff
        Weight below which a splat of the gaussian time model is hidden, in (0, 1).
    coordinate_system
        Axis letters such as "RUB" (right, up, back), or "unknown".
    origin
        (3,) float64; world position = origin + means.
    splat_model
        "default", "antialiased" (Mip-Splatting) or "2dgs" (flat splats).
    source_format
        Id of the lossy format that the values come from, as far as that is known; else empty.
    extra
        Other per-splat properties by name, each (N,) or (N, ...), kept as they were found.

    Raises
    ------
    CloudError
        An array has another shape than the table says, or the lengths differ.
    """

    means: Float32
    log_scales: Float32
    quats: Float32
    opacity_logits: Float32
    sh0: Float32
    shN: Float32
    velocities: Float32 | None = None
    times: Float32 | None = None
    durations: Float32 | None = None
    time_model: TimeModel = "window"
    temporal_cutoff: float = TEMPORAL_CUTOFF
    coordinate_system: str = "unknown"
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    splat_model: SplatModel = "default"
    source_format: str = ""
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(np.asarray(self.means)))
        for name, width in _WIDTHS.items():
            self._set_array(name, (count,) if width is None else (count, width))
        motion = [name for name in _MOTION_WIDTHS if getattr(self, name) is not None]
        if motion and len(motion) != len(_MOTION_WIDTHS):
            missing = sorted(set(_MOTION_WIDTHS) - set(motion))
            raise CloudError(f"motion needs velocities, times and durations together, {', '.join(missing)} missing")
        for name in motion:
            width = _MOTION_WIDTHS[name]
            self._set_array(name, (count,) if width is None else (count, width))
        rest = np.asarray(self.shN)
        if rest.ndim != 3 or rest.shape[0] != count or rest.shape[1] not in REST_COEFFICIENTS or rest.shape[2] != 3:
            raise CloudError(
                f"expected shape ({count}, K - 1, 3) with K - 1 one of {REST_COEFFICIENTS}, found {rest.shape}", field="shN"
            )
        self._set_array("shN", rest.shape)
        if self.time_model not in get_args(TimeModel):
            raise CloudError(f"expected one of {get_args(TimeModel)}, found {self.time_model!r}", field="time_model")
        if not 0 < self.temporal_cutoff < 1:
            raise CloudError(f"expected a number between 0 and 1, found {self.temporal_cutoff!r}", field="temporal_cutoff")
        if self.coordinate_system != UNKNOWN and not is_known(self.coordinate_system):
            raise CloudError(
                f"expected axis letters such as RUB, or {UNKNOWN!r}, found {self.coordinate_system!r}",
                field="coordinate_system",
            )
        if self.splat_model not in get_args(SplatModel):
            raise CloudError(f"expected one of {get_args(SplatModel)}, found {self.splat_model!r}", field="splat_model")
        if source_format_of(self.source_format) != self.source_format:
            raise CloudError(f"expected the id of a format, found {self.source_format!r}", field="source_format")
        origin = np.array(self.origin, np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise CloudError(f"expected three finite numbers, found {self.origin!r}", field="origin")
        object.__setattr__(self, "origin", origin)
        extra = {name: np.asarray(values) for name, values in self.extra.items()}
        for name, values in extra.items():
            if values.ndim == 0 or len(values) != count:
                raise CloudError(f"expected {count} rows, found shape {values.shape}", field=f"extra[{name!r}]")
        object.__setattr__(self, "extra", MappingProxyType(extra))

    def _set_array(self, name: str, shape: tuple[int, ...]) -> None:
        """Replace an array by its C-contiguous float32 form after checking its shape."""
        values = np.ascontiguousarray(getattr(self, name), np.float32)
        if values.shape != shape:
            raise CloudError(f"expected shape {shape}, found {values.shape}", field=name)
        object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest SH band, 0 to 4."""
        return REST_COEFFICIENTS.index(self.shN.shape[1])

    @property
    def has_motion(self) -> bool:
        """Whether the cloud holds velocities, times and durations."""
        return self.velocities is not None

    def arrays(self) -> dict[str, Float32]:
        """Return the attribute arrays that are present, by name, without `extra`."""
        names = [*_WIDTHS, "shN", *(_MOTION_WIDTHS if self.has_motion else [])]
        return {name: getattr(self, name) for name in names}

    def replace(self, **changes: Any) -> GaussianCloud:
        """Return a copy with some fields replaced; unchanged arrays are shared."""
        return replace(self, **changes)

    def take(self, selection: NDArray[np.integer[Any]] | NDArray[np.bool_] | slice) -> GaussianCloud:
        """Return the splats that `selection` (indices, a mask or a slice) names, in its order."""
        changes: dict[str, Any] = {name: values[selection] for name, values in self.arrays().items()}
        changes["extra"] = {name: values[selection] for name, values in self.extra.items()}
        return replace(self, **changes)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return (min, max) of the means in world units as (3,) float64, or None for an empty cloud."""
        if len(self) == 0:
            return None
        return self.origin + self.means.min(axis=0), self.origin + self.means.max(axis=0)


def source_format_of(value: object) -> str:
    """Return what a file says that its values come from; empty where that is no id of a format."""
    return value if isinstance(value, str) and _FORMAT_ID.fullmatch(value) else ""


def concatenate(clouds: Sequence[GaussianCloud]) -> GaussianCloud:
    """Join clouds that share degree, origin, motion and extras into one, in order.

    Raises
    ------
    CloudError
        The list is empty, or the clouds differ in what they hold.
    """
    if not clouds:
        raise CloudError("cannot join an empty list of clouds")
    first = clouds[0]
    for index, cloud in enumerate(clouds):
        for name in ("sh_degree", "has_motion", "time_model", "temporal_cutoff", "coordinate_system", "splat_model"):
            if getattr(cloud, name) != getattr(first, name):
                raise CloudError(f"cloud {index} has {getattr(cloud, name)}, the first {getattr(first, name)}", field=name)
        if not np.array_equal(cloud.origin, first.origin):
            raise CloudError(f"cloud {index} has {cloud.origin}, the first {first.origin}", field="origin")
        if set(cloud.extra) != set(first.extra):
            raise CloudError(f"cloud {index} has {sorted(cloud.extra)}, the first {sorted(first.extra)}", field="extra")
    if len(clouds) == 1:
        return first
    changes: dict[str, Any] = {name: np.concatenate([c.arrays()[name] for c in clouds]) for name in first.arrays()}
    changes["extra"] = {name: np.concatenate([c.extra[name] for c in clouds]) for name in first.extra}
    return first.replace(**changes)


def empty_cloud(count: int, sh_degree: int, *, has_motion: bool = False) -> GaussianCloud:
    """Return a cloud of `count` splats with arrays that are allocated but not filled."""
    arrays: dict[str, Any] = {
        name: np.empty((count,) if width is None else (count, width), np.float32)
        for name, width in (_WIDTHS | (_MOTION_WIDTHS if has_motion else {})).items()
    }
    return GaussianCloud(**arrays, shN=np.empty((count, REST_COEFFICIENTS[sh_degree], 3), np.float32))
