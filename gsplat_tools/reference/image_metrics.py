"""How far two pictures are apart: PSNR, SSIM, errors, and shares of pixels that differ visibly."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Constants of the paper: an 11-tap Gaussian window of sigma 1.5 and K1 = 0.01, K2 = 0.03 (Wang et al. 2004, section III-C).
_SSIM_SIGMA = 1.5
_SSIM_RADIUS = 5
_SSIM_C1 = 0.01**2
_SSIM_C2 = 0.03**2


@dataclass(frozen=True, slots=True)
class ImageMetrics:
    """Differences between a reference picture and a candidate, both clamped to [0, 1].

    Parameters
    ----------
    psnr
        Peak signal-to-noise ratio, dB, peak 1; None where the pictures are identical.
    identical
        Whether every value is equal after clamping.
    ssim
        Mean structural similarity over pixels and channels; None for pictures smaller than 11x11.
    max_abs, mean_abs
        Largest and mean absolute difference of a channel value.
    share_above_1, share_above_8
        Share of pixels of which some channel differs by more than 1/255, or 8/255.
    """

    psnr: float | None
    identical: bool
    ssim: float | None
    max_abs: float
    mean_abs: float
    share_above_1: float
    share_above_8: float

    def to_json(self) -> dict[str, Any]:
        """Return the values by name."""
        return asdict(self)


def compare_images(reference: NDArray[Any], candidate: NDArray[Any]) -> ImageMetrics:
    """Measure how far two pictures are apart.

    Parameters
    ----------
    reference, candidate
        (H, W, 3) colors; clamped to [0, 1] before anything else. A value that is NaN counts as 0.

    Raises
    ------
    ValueError
        The shapes differ, or are not (H, W, 3).
    """
    a, b = _clamped(reference, candidate)
    difference = np.abs(a - b)
    worst = difference.max(axis=2)
    identical = not difference.any()
    return ImageMetrics(
        psnr=None if identical else _psnr(difference),
        identical=identical,
        ssim=1.0 if identical and min(a.shape[:2]) > 2 * _SSIM_RADIUS else _ssim(a, b),
        max_abs=float(worst.max()),
        mean_abs=float(difference.mean()),
        share_above_1=float(np.mean(worst > 1 / 255)),
        share_above_8=float(np.mean(worst > 8 / 255)),
    )


def psnr(reference: NDArray[Any], candidate: NDArray[Any]) -> float | None:
    """Return the peak signal-to-noise ratio in dB, 10 log10(1 / mean squared error); None for identical pictures.

    Raises
    ------
    ValueError
        The shapes differ, or are not (H, W, 3).
    """
    a, b = _clamped(reference, candidate)
    difference = a - b
    return _psnr(difference) if difference.any() else None


def ssim(reference: NDArray[Any], candidate: NDArray[Any]) -> float | None:
    """Return the mean structural similarity; None for pictures smaller than 11x11.

    Raises
    ------
    ValueError
        The shapes differ, or are not (H, W, 3).

    Source
    ------
    Wang et al. 2004, Image Quality Assessment: From Error Visibility to Structural Similarity, eq. 13; borders that the
    window does not cover are left out, as scikit-image does.
    """
    return _ssim(*_clamped(reference, candidate))


def _clamped(reference: NDArray[Any], candidate: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both pictures as float64 in [0, 1]."""
    if reference.shape != candidate.shape or reference.ndim != 3 or reference.shape[2] != 3 or reference.size == 0:
        raise ValueError(f"expected two pictures of one shape (H, W, 3), got {reference.shape} and {candidate.shape}")
    a, b = (np.clip(np.nan_to_num(image.astype(np.float64), nan=0.0), 0.0, 1.0) for image in (reference, candidate))
    return a, b


def _psnr(difference: NDArray[np.float64]) -> float:
    """Return the PSNR of a difference that is not zero everywhere."""
    return -10.0 * math.log10(float(np.mean(np.square(difference))))


def _ssim(a: NDArray[np.float64], b: NDArray[np.float64]) -> float | None:
    """Return the mean over channels and over the pixels that the window fits around."""
    if min(a.shape[:2]) <= 2 * _SSIM_RADIUS:
        return None
    return float(np.mean([_ssim_plane(a[:, :, channel], b[:, :, channel]) for channel in range(3)]))


def _ssim_plane(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the mean structural similarity of one channel."""
    mean_a, mean_b = _smooth(a), _smooth(b)
    product, square_a, square_b = mean_a * mean_b, mean_a * mean_a, mean_b * mean_b
    variances = _smooth(a * a + b * b) - square_a - square_b
    covariance = _smooth(a * b) - product
    numerator = (2 * product + _SSIM_C1) * (2 * covariance + _SSIM_C2)
    return float(np.mean(numerator / ((square_a + square_b + _SSIM_C1) * (variances + _SSIM_C2))))


def _smooth(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convolve with the Gaussian window where it fits, which shortens each side by ten pixels."""
    offsets = np.arange(-_SSIM_RADIUS, _SSIM_RADIUS + 1)
    weights = np.exp(-0.5 * np.square(offsets / _SSIM_SIGMA))
    weights /= weights.sum()
    for axis in (0, 1):
        source = np.moveaxis(plane, axis, 0)
        count = len(source) - 2 * _SSIM_RADIUS
        # The window is symmetric: one product for each pair of taps.
        smoothed = source[_SSIM_RADIUS : _SSIM_RADIUS + count] * weights[_SSIM_RADIUS]
        for tap in range(_SSIM_RADIUS):
            last = 2 * _SSIM_RADIUS - tap
            smoothed += (source[tap : tap + count] + source[last : last + count]) * weights[tap]
        plane = np.moveaxis(smoothed, 0, axis)
    return plane
