"""Logit and sigmoid, logarithm and exponential, between what files store and what renderers use.

float32 comes out as float32 and is computed in float64 in between, so that each result is the correctly rounded one
but for rare ties; float64 stays float64. The ends are values, not accidents: logit -inf is opacity 0, log scale -inf is
a flat axis.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floating = TypeVar("Floating", np.float32, np.float64)


def sigmoid(logits: NDArray[Floating]) -> NDArray[Floating]:
    """Return the opacities of logits.

    Parameters
    ----------
    logits
        Any shape, float32 or float64; +-inf are legal, NaN stays NaN.

    Returns
    -------
    NDArray
        Same shape and dtype, in [0, 1].
    """
    wide = logits.astype(np.float64)
    # exp of a negative number cannot overflow, and small opacities keep their relative precision.
    decay = np.exp(-np.abs(wide))
    return (np.where(wide >= 0, 1.0, decay) / (1.0 + decay)).astype(logits.dtype)


def logit(opacities: NDArray[Floating]) -> NDArray[Floating]:
    """Return the logits of opacities.

    Parameters
    ----------
    opacities
        Any shape, float32 or float64, in [0, 1]; the ends give -inf and +inf, anything outside gives NaN.

    Returns
    -------
    NDArray
        Same shape and dtype.
    """
    wide = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (np.log(wide) - np.log1p(-wide)).astype(opacities.dtype)


def mixed_logits(first: NDArray[Floating], second: NDArray[Floating], fraction: float) -> NDArray[Floating]:
    """Return the logits of opacities between two: (1 - fraction) sigmoid(first) + fraction sigmoid(second).

    Parameters
    ----------
    first, second
        Logits of one shape and dtype; +-inf are legal.
    fraction
        Of the second, 0 to 1.

    Returns
    -------
    NDArray
        Same shape and dtype.

    Notes
    -----
    What an opacity lacks to 1 is mixed like the opacity itself: 1 - o would be exactly 0 from logits of 37 on.
    """
    a, b = first.astype(np.float64), second.astype(np.float64)
    opacities, rests = ((1 - fraction) * sigmoid(sign * a) + fraction * sigmoid(sign * b) for sign in (1.0, -1.0))
    with np.errstate(divide="ignore"):
        return (np.log(opacities) - np.log(rests)).astype(first.dtype)


def weighted_logits(logits: NDArray[Floating], weights: NDArray[np.floating]) -> NDArray[Floating]:
    """Return the logits of opacities times weights.

    Parameters
    ----------
    logits
        (N,) +-inf are legal.
    weights
        (N,) in [0, 1]; where they are exactly 1 the logits stay as they are.

    Returns
    -------
    NDArray
        Same shape and dtype as `logits`; -inf where the weight is 0.
    """
    wide, factors = logits.astype(np.float64), weights.astype(np.float64)
    opacities = sigmoid(wide)
    with np.errstate(divide="ignore"):
        faded = np.log(opacities * factors) - np.log(sigmoid(-wide) + opacities * (1 - factors))
    return np.where(factors == 1, wide, faded).astype(logits.dtype)


def exp_scales(log_scales: NDArray[Floating]) -> NDArray[Floating]:
    """Return the scales of log scales.

    Parameters
    ----------
    log_scales
        Any shape, float32 or float64, natural logarithm of world units; -inf is a flat axis.

    Returns
    -------
    NDArray
        Same shape and dtype, world units; inf where it overflows (float32: from 88.72).
    """
    with np.errstate(over="ignore"):
        return np.exp(log_scales.astype(np.float64)).astype(log_scales.dtype)


def log_scales(scales: NDArray[Floating]) -> NDArray[Floating]:
    """Return the natural logarithm of scales.

    Parameters
    ----------
    scales
        Any shape, float32 or float64, world units; 0 gives -inf, a negative scale gives NaN.

    Returns
    -------
    NDArray
        Same shape and dtype.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(scales.astype(np.float64)).astype(scales.dtype)
