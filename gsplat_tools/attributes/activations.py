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
