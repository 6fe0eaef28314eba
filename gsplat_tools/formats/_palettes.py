"""SH palettes of files: the values that they can be fitted to, and entries as they are stored."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import CapabilityError, LossyConversionWarning

Float32 = NDArray[np.float32]

MAX_SH = 2.0**40
"""Searches compare sums of squares in float32, over all splats of a cell: those of larger values leave it."""

MAX_HALF = 65504.0


def check_range(shN: Float32, frame: int | None = None) -> None:
    """Refuse finite SH that no palette can be fitted to.

    Parameters
    ----------
    shN
        (N, C, 3).
    frame
        What errors name.

    Raises
    ------
    CapabilityError
        A value is beyond MAX_SH.
    """
    if shN.size == 0 or max(float(shN.max()), -float(shN.min())) <= MAX_SH:
        return
    count = int((np.abs(shN) > MAX_SH).any(axis=(1, 2)).sum())
    raise CapabilityError(
        f"{count} of {len(shN)} splats have SH coefficients beyond {MAX_SH:.3g} (up to {float(np.abs(shN).max()):.3g}), too "
        "large for a palette; leave the bands out with --sh-degree 0, or write a format without palettes (.ply)",
        field="shN",
        frame=frame,
    )


def stored_entries(centroids: Float32, kind: str, name: str) -> NDArray[np.floating]:
    """Return entries in their stored type.

    Parameters
    ----------
    centroids
        (K, D).
    kind
        "f16" or "f32".
    name
        What a warning calls the palette.

    Warns
    -----
    LossyConversionWarning
        Entries lie beyond half precision and were clamped.
    """
    if kind == "f32":
        return centroids.astype("<f4")
    count = int((np.abs(centroids) > MAX_HALF).any(axis=1).sum())
    if count:
        message = (
            f"{count} of {len(centroids)} entries of the palette {name} lie beyond {MAX_HALF:.0f}, the end of half precision, "
            "and were clamped; use --centroids f32"
        )
        warnings.warn(LossyConversionWarning(message, code="clamped-sh"), stacklevel=3)
    return np.clip(centroids, -MAX_HALF, MAX_HALF).astype("<f2")
