"""The largest errors that .spz allows, derived from the header and from the buckets that the SH bytes show."""

from __future__ import annotations

from typing import BinaryIO
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.spz.attributes import COLOR_SCALE, LOG_SCALE_MAX, LOG_SCALE_MIN, LOG_SCALE_STEP, rotation_grid
from gsplat_tools.formats.spz.header import Header
from gsplat_tools.formats.spz.payload import Bytes

Float64 = NDArray[np.float64]

_ROUNDING = 2.0**-22
"""Decoded values are rounded to float32 and were computed from float32: relative to the value."""

_LOOKED_AT = 1 << 16
"""SH rows from which the buckets are told: fewer rows can only make a bucket look larger, and the bound looser."""

_buckets: WeakKeyDictionary[BinaryIO, tuple[Header, tuple[int, int]]] = WeakKeyDictionary()


def spz_bounds(source: GaussianCloud, header: Header, buckets: tuple[int, int]) -> Bounds:
    """Return the largest errors for the splats of `source`.

    Parameters
    ----------
    source
        What was written.
    header
        Of the file.
    buckets
        Steps between neighboring SH codes of band 1, and above.
    """
    log_scales = source.log_scales.astype(np.float64)
    clamped = np.clip(log_scales, LOG_SCALE_MIN, LOG_SCALE_MAX)
    half = LOG_SCALE_STEP / 2
    low, high = np.maximum(clamped - half, LOG_SCALE_MIN), np.minimum(clamped + half, LOG_SCALE_MAX)
    angle = rotation_grid(header.version).max_angle + 2.0**-20
    sorted_scales = np.sort(log_scales, axis=1)
    limits: Bounds = {
        "means": _position_errors(source, header),
        "scales": half + _outside(sorted_scales, LOG_SCALE_MIN, LOG_SCALE_MAX) + 8 * _ROUNDING,
        "covariances": covariance_bound_of_ranges(log_scales, low, high, angle) * (1 + _ROUNDING) + _ROUNDING,
        "opacities": np.array([0.5 / 255 + _ROUNDING]),
        "sh0": (0.5 / 255 + _outside(source.sh0.astype(np.float64) * COLOR_SCALE + 0.5, 0.0, 1.0)) / COLOR_SCALE
        + _ROUNDING * (2 + np.abs(source.sh0)),
    }
    if source.sh_degree:
        rest = source.shN.astype(np.float64)
        errors = _outside(rest, -1.0, 127 / 128) + _ROUNDING * (1 + np.abs(rest))
        errors[:, :3] += buckets[0] / 256
        errors[:, 3:] += buckets[1] / 256
        limits["shN"] = errors
    return limits


def _position_errors(source: GaussianCloud, header: Header) -> Float64:
    """Return half a step, everywhere the same but in version 1."""
    if header.version > 1:
        return np.full((1, 3), 0.5 ** (header.fractional_bits + 1))
    _, exponents = np.frexp(source.means.astype(np.float64))
    return np.asarray(np.ldexp(1.0, np.maximum(exponents, -13) - 12))


def _outside(values: Float64, low: float, high: float) -> Float64:
    """Return how far values lie outside low..high."""
    return np.maximum(np.maximum(low - values, values - high), 0.0)


def told_buckets(codes: Bytes) -> tuple[int, int]:
    """Return the largest power of two that divides all SH codes of band 1, and those above; 255 is the clamped end."""
    first, rest = codes[:, :9], codes[:, 9:]
    return _bucket(first), _bucket(rest)


def _bucket(codes: Bytes) -> int:
    """Return the largest power of two that divides the codes."""
    union = int(np.bitwise_or.reduce(codes.reshape(-1), where=codes.reshape(-1) != 255, initial=0)) if codes.size else 0
    return union & -union if union else 128


def known(stream: BinaryIO) -> tuple[Header, tuple[int, int]] | None:
    """Return what `remember` was told about this stream."""
    return _buckets.get(stream)


def remember(stream: BinaryIO, header: Header, codes: Bytes | None) -> tuple[Header, tuple[int, int]]:
    """Keep header and buckets while the stream is open: bounds are asked for chunk by chunk."""
    found = header, told_buckets(codes[:_LOOKED_AT]) if codes is not None else (1, 1)
    _buckets[stream] = found
    return found
