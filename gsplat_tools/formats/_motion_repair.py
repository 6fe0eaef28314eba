"""Times and durations of 4D splats: the ranges of their time model, enforced and counted."""

from __future__ import annotations

import warnings

import numpy as np

from gsplat_tools.attributes.motion import MIN_SIGMA
from gsplat_tools.cloud import Float32, GaussianCloud, TimeModel
from gsplat_tools.errors import LossyConversionWarning


class MotionRepair:
    """Clamps times and durations over any number of chunks and counts what it changed.

    Window model: both are clamped to [0, 1]; NaN stays, which makes the splat invalid. Gaussian model: times that are not
    finite become 0, durations that are not finite 1, and durations are at least MIN_SIGMA.

    Source: gsplat-unity fork, 4D fields of a PLY.
    """

    def __init__(self, time_model: TimeModel, num_splats: int) -> None:
        self._model = time_model
        self._num_splats = num_splats
        self._counts = {"times": 0, "durations": 0}
        self._ranges = {"times": (np.inf, -np.inf), "durations": (np.inf, -np.inf)}

    def apply(self, cloud: GaussianCloud) -> dict[str, Float32]:
        """Return the times and durations of a cloud with motion as its model allows them."""
        assert cloud.times is not None
        assert cloud.durations is not None
        if self._model == "window":
            repaired = {"times": np.clip(cloud.times, 0, 1), "durations": np.clip(cloud.durations, 0, 1)}
        else:
            sigmas = np.where(np.isfinite(cloud.durations), cloud.durations, np.float32(1))
            repaired = {
                "times": np.where(np.isfinite(cloud.times), cloud.times, np.float32(0)),
                "durations": np.maximum(sigmas, np.float32(MIN_SIGMA)),
            }
        for name, values in repaired.items():
            before = getattr(cloud, name)
            changed = before[(values != before) & ~(np.isnan(values) & np.isnan(before))]
            self._counts[name] += len(changed)
            finite = changed[np.isfinite(changed)]
            if len(finite):
                low, high = self._ranges[name]
                self._ranges[name] = (min(low, float(finite.min())), max(high, float(finite.max())))
        return repaired

    def warn(self) -> None:
        """Warn once about all that was changed, with counts and the range of the finite values that were out of range."""
        if not any(self._counts.values()):
            return
        parts = []
        for name, count in self._counts.items():
            low, high = self._ranges[name]
            span = f" (found {low:.6g} to {high:.6g})" if low <= high else " (not finite)"
            parts.append(f"{count} {name}{span if count else ''}")
        allowed = "[0, 1]" if self._model == "window" else f"finite times and durations of at least {MIN_SIGMA:g}"
        warnings.warn(
            LossyConversionWarning(
                f"the {self._model} time model needs {allowed}: changed {' and '.join(parts)} of {self._num_splats} splats",
                code="clamped-times",
            ),
            stacklevel=3,
        )
