"""Raise or lower the SH degree, and say what a lower one would lose."""

from __future__ import annotations

import numpy as np

from gsplat_tools.attributes.spherical_harmonics import band_slice, num_bases
from gsplat_tools.cloud import GaussianCloud


def with_sh_degree(cloud: GaussianCloud, degree: int) -> GaussianCloud:
    """Return the cloud with another SH degree.

    Parameters
    ----------
    cloud
        N Gaussians.
    degree
        Highest band of the result, 0 to 4. Bands above it are dropped (`count_dropped` says what that loses),
        missing bands are zero.

    Returns
    -------
    GaussianCloud
        The same cloud where the degree does not change.

    Raises
    ------
    ValueError
        The degree is not in 0..4.
    """
    rest = num_bases(degree) - 1
    if degree == cloud.sh_degree:
        return cloud
    kept = min(rest, cloud.shN.shape[1])
    shN = np.zeros((len(cloud), rest, 3), np.float32)
    shN[:, :kept] = cloud.shN[:, :kept]
    return cloud.replace(shN=shN)


def effective_sh_degree(cloud: GaussianCloud) -> int:
    """Return the highest band in which any splat has a coefficient that is not zero; NaN counts as not zero."""
    for band in range(cloud.sh_degree, 0, -1):
        if cloud.shN[:, band_slice(band)].any():
            return band
    return 0


def count_dropped(cloud: GaussianCloud, degree: int) -> dict[int, int]:
    """Return what lowering the SH degree would lose.

    Parameters
    ----------
    cloud
        N Gaussians.
    degree
        Highest band that stays, 0 to 4.

    Returns
    -------
    dict
        Number of splats with a coefficient that is not zero, for each band above `degree` where there are any.
    """
    counts = {
        band: int(np.count_nonzero(cloud.shN[:, band_slice(band)].any(axis=(1, 2))))
        for band in range(degree + 1, cloud.sh_degree + 1)
    }
    return {band: count for band, count in counts.items() if count}
