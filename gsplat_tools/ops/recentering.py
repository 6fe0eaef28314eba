"""Move the origin of a cloud, so that narrow position types spend their bits on the scene and not on its distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError

# Fraction bits, smallest normal exponent, and largest finite value.
_FLOAT_TYPES = {"f16": (10, -14, 65504.0), "f32": (23, -126, float(np.finfo(np.float32).max))}

# The grid of `choose_origin` is the extent's power of two over this: the center is off by 1/8 of the extent at most.
_GRID_DIVISOR = 4


def recenter(cloud: GaussianCloud, origin: ArrayLike) -> GaussianCloud:
    """Return the cloud with its means relative to another origin.

    Parameters
    ----------
    cloud
        N Gaussians.
    origin
        (3,) world units.

    Returns
    -------
    GaussianCloud
        World positions, origin + means, stay; the means are computed in float64 and rounded once to float32.

    Raises
    ------
    CloudError
        The origin is not three finite numbers.
    """
    new_origin = np.asarray(origin, np.float64)
    if np.array_equal(new_origin, cloud.origin):
        return cloud
    # The cloud checks the origin; until then its shape must not stop the subtraction with another error.
    if new_origin.shape != (3,):
        raise CloudError(f"expected three finite numbers, found {origin!r}", field="origin")
    means = cloud.means + (cloud.origin - new_origin)
    return cloud.replace(means=means.astype(np.float32), origin=new_origin)


def without_origin(cloud: GaussianCloud) -> GaussianCloud:
    """Return the cloud with its means in world coordinates, added in float64 and rounded once to float32."""
    return recenter(cloud, np.zeros(3))


def choose_origin(low: ArrayLike, high: ArrayLike) -> NDArray[np.float64]:
    """Return a round origin near the center of a box.

    Parameters
    ----------
    low, high
        (3,) world units, the box of the means.

    Returns
    -------
    NDArray
        (3,) float64. Per axis a multiple of the largest power of two that is at most a quarter of the extent, hence
        within 1/8 of the extent from the center, and 0 for a box about the origin. Subtracting it from float32 values
        inside the box errs by at most 2^-24 of the extent, and rounds nothing where the box lies further from zero
        than it is wide. A box without extent is subtracted whole.

    Raises
    ------
    CloudError
        The box is not finite, or upside down.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if low.shape != (3,) or high.shape != (3,) or not np.isfinite([low, high]).all() or (low > high).any():
        raise CloudError(f"expected a finite box of (3,) low and high, found {low} to {high}", field="origin")
    center = low + (high - low) / 2
    extent = high - low
    is_flat = extent == 0
    exponents = np.floor(np.log2(np.where(is_flat, 1.0, extent)))
    grid = np.exp2(exponents) / _GRID_DIVISOR
    origin: NDArray[np.float64] = np.where(is_flat, center, np.round(center / grid) * grid) + 0.0
    return origin


def position_step(max_abs: float, position_type: str) -> float:
    """Return the distance between neighboring positions that a type can hold.

    Parameters
    ----------
    max_abs
        Largest absolute coordinate, in stored units.
    position_type
        "f16" or "f32".

    Returns
    -------
    float
        World units, 2^(floor(log2 max_abs) - fraction bits), not below the subnormal step; inf where the type overflows.
        Rounding errs by half of it.

    Raises
    ------
    ValueError
        There is no such type.
    """
    if position_type not in _FLOAT_TYPES:
        raise ValueError(f"position_type must be one of {tuple(_FLOAT_TYPES)}, got {position_type!r}")
    fraction_bits, min_exponent, largest = _FLOAT_TYPES[position_type]
    if not max_abs <= largest:
        return float("inf")
    exponent = min_exponent if max_abs == 0 else max(int(np.frexp(max_abs)[1]) - 1, min_exponent)
    return float(np.ldexp(1.0, exponent - fraction_bits))
