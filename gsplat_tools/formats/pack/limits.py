"""The largest errors that the two layouts allow, derived from their ranges and bit depths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges
from gsplat_tools.constants import SH_C0
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.pack.encoding import FLAT_LN_SCALE, SplatEncoding
from gsplat_tools.formats.pack.words import SH_BITS

Float64 = NDArray[np.float64]

# An octahedral coordinate is off by at most 1/255, which moves the point (x, y, 1 - |x| - |y|) by at most sqrt(6)/255 on a
# surface that stays at least 1/sqrt(3) away from the centre.
_AXIS_ANGLE = np.sqrt(18.0) / 255.0
_HALF_ANGLE = np.pi / 1020.0  # half a step of the angle is pi/510, and the quaternion holds half of the angle

SPARK_ANGLE = float(2 * np.arccos(np.cos(_HALF_ANGLE) - (1 - np.cos(_AXIS_ANGLE))))
"""Largest rotation error of Spark's code for any rotation, radians (1.94 degrees).

For half angles h, h' and axes at angle g the product of the quaternions is cos(h - h') - sin(h) sin(h') (1 - cos g).
"""

_FLOAT32_ANGLE = 2.0**-21
"""Largest rotation error of a unit quaternion whose components are rounded to float32: 2 asin(2^-24), and slack."""

_LARGEST_LN_SCALE = float(np.log(float(np.finfo(np.float32).max)))
_FLAT_LN_FLOAT32, _SMALLEST_LN_FLOAT32 = (float(exponent * np.log(2.0)) for exponent in (-150, -149))

_ROUNDING = 2.0**-22
"""Decoded values are rounded to float32 and were computed from float32: relative to the value."""


def spark_bounds(source: GaussianCloud, encoding: SplatEncoding) -> Bounds:
    """Return the largest errors of Spark's layout for the splats of `source`."""
    colors = source.sh0.astype(np.float64) * SH_C0 + 0.5
    color_step = (encoding.rgb_max - encoding.rgb_min) / 255
    log_scales = source.log_scales.astype(np.float64)
    stored, reach = _stored_scales(log_scales, encoding)
    covariances = covariance_bound_of_ranges(log_scales, stored - reach, stored + reach, SPARK_ANGLE)
    sorted_scales = np.sort(log_scales, axis=1)
    limits: Bounds = {
        "means": half_step(source.means),
        "scales": _scale_errors(sorted_scales, encoding),
        "covariances": covariances * (1 + _ROUNDING) + _ROUNDING,
        "opacities": np.array([0.5 / 255 + _ROUNDING]),
        "sh0": (0.5 * color_step + _outside(colors, encoding.rgb_min, encoding.rgb_max)) / SH_C0
        + _ROUNDING * (2 + np.abs(source.sh0)),
    }
    if source.sh_degree:
        rest = np.empty(source.shN.shape)
        for band in range(1, source.sh_degree + 1):
            part = slice(band * band - 1, (band + 1) ** 2 - 1)
            largest = encoding.sh_max(band)
            step = largest / ((1 << (SH_BITS[band] - 1)) - 1)
            values = source.shN[:, part].astype(np.float64)
            rest[:, part] = 0.5 * step + _outside(values, -largest, largest) + _ROUNDING * (largest + np.abs(values))
        limits["shN"] = rest
    return limits | _exact_motion(source)


def _stored_scales(log_scales: Float64, encoding: SplatEncoding) -> tuple[Float64, float]:
    """Return log scales clamped to their range, flat ones -inf, and how far rounding moves those."""
    slack = _ROUNDING * max(1.0, abs(encoding.ln_scale_min), abs(encoding.ln_scale_max))
    clamped = np.clip(log_scales, encoding.ln_scale_min, encoding.ln_scale_max)
    return np.where(log_scales < FLAT_LN_SCALE, -np.inf, clamped), 0.5 * encoding.ln_scale_step + slack


def _scale_errors(log_scales: Float64, encoding: SplatEncoding) -> Float64:
    """Return how far log scales may move; inf where a finite one becomes flat."""
    stored, reach = _stored_scales(log_scales, encoding)
    with np.errstate(invalid="ignore"):
        return np.where(np.isneginf(log_scales), 0.0, np.abs(log_scales - stored) + reach)


def _outside(values: Float64, low: float, high: float) -> Float64:
    """Return how far values lie outside low..high."""
    return np.maximum(np.maximum(low - values, values - high), 0.0)


def half_step(values: NDArray[np.float32]) -> Float64:
    """Return half of the step of half precision at each value: 2^-11 of its binade, and 2^-25 below 2^-14."""
    _, exponents = np.frexp(values.astype(np.float64))  # |value| in [2^(exponent - 1), 2^exponent)
    return np.asarray(np.ldexp(1.0, np.maximum(exponents, -13) - 12))


def uncompressed_bounds(source: GaussianCloud) -> Bounds:
    """Return the largest errors of the uncompressed layout for the splats of `source`."""
    log_scales = source.log_scales.astype(np.float64)
    sorted_scales = np.sort(log_scales, axis=1)
    low, high = _float32_scales(sorted_scales)
    is_flat = np.isneginf(sorted_scales)
    with np.errstate(invalid="ignore"):
        moves = np.maximum(high - sorted_scales, sorted_scales - low)
    limits: Bounds = {
        "means": np.zeros((1, 3)),
        "scales": np.where(is_flat, 0.0, moves),
        "covariances": covariance_bound_of_ranges(log_scales, *_float32_scales(log_scales), _FLOAT32_ANGLE) + _ROUNDING,
        "opacities": np.array([2.0**-24]),  # half a step below 1, and the slope of the logit's rounding, 0.23 steps
        "sh0": np.zeros((1, 3)),
    }
    return limits | ({"shN": np.zeros((1, 1, 3))} if source.sh_degree else {}) | _exact_motion(source)


def _float32_scales(log_scales: Float64) -> tuple[Float64, Float64]:
    """Return between what log scales come back when exp, clamped at the largest number, and then log are rounded to float32.

    Below half of the smallest number a scale is flat: -inf.
    """
    stored = np.minimum(log_scales, _LARGEST_LN_SCALE)
    with np.errstate(under="ignore", divide="ignore", invalid="ignore"):
        scales = np.exp(stored)
        # Half a step relative to the value; subnormals have fewer bits.
        half_step = np.minimum(0.5 * np.maximum(2.0**-149, scales * 2.0**-23) / scales, 1.0)
        slack = np.where(np.isfinite(stored), np.abs(stored), 0.0) * 2.0**-24 + 2.0**-40
        low, high = stored + np.log1p(-half_step) - slack, stored + np.log1p(half_step) + slack
    # What is not flat is at least the smallest number; within float64's rounding of half of it a scale may go either way.
    low = np.maximum(low, _SMALLEST_LN_FLOAT32 - slack)
    low = np.where(stored <= _FLAT_LN_FLOAT32 + 1e-9, -np.inf, low)
    high = np.where(stored < _FLAT_LN_FLOAT32 - 1e-9, -np.inf, high)
    return low, high


def _exact_motion(source: GaussianCloud) -> Bounds:
    """Return zeros for motion, which is stored in float32."""
    if not source.has_motion:
        return {}
    return {"velocities": np.zeros((1, 3)), "times": np.zeros(1), "durations": np.zeros(1)}
