"""Visionary's storage buffers: Gaussians of ten scalars, SH at a fixed stride, raw colors, as 32-bit words.

| buffer | f32 | f16 |
|---|---|---|
| Gaussian: x y z opacity, covariance xx xy xz yy yz zz | 10 words, 40 bytes | 5 words, 20 bytes |
| SH: 48 scalars for any degree | 48 words | 24 words |
| raw color: r g b | 3 words | 2 words, the fourth half is 0 |

Two halves share a word, the first in the low bits. Opacity is linear. SH "interleaved": coefficient k at scalars 3k to
3k + 2; "channel-major": the constant term at 0 to 2, then m coefficients of red, of green and of blue, with
m = (degree + 1)^2 - 1.

Source: preprocess.wgsl and utils/half.ts of Visionary-Laboratory/visionary @ c5d7070; see docs/visionary.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.covariance import covariance_triangles

Precision = Literal["f32", "f16"]
ShLayout = Literal["interleaved", "channel-major"]
Words = NDArray[np.uint32]

MAX_SH_DEGREE = 3
"""Highest SH band that the buffers hold."""

GAUSSIAN_SCALARS = 10
SH_SCALARS = 48

_HALF_OVERFLOW = 65520.0
# Eigenvalues of float64 are this far off, relative to the largest: below, an axis counts as flat.
_EIGENVALUE_NOISE = 1e-14
_FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


@dataclass(frozen=True, slots=True)
class CovarianceLosses:
    """What half precision does to covariances, as counts of splats.

    Parameters
    ----------
    splats
        All of them.
    vanished
        The smallest axis is no longer there: the smallest eigenvalue is 0 or negative, but was above 0.
    halved
        The smallest axis is half as long as before or less, or twice as long or more; this includes the vanished.
    overflowed
        A variance is infinite.
    """

    splats: int
    vanished: int
    halved: int
    overflowed: int


def half_covariance_losses(covariances: NDArray[Any]) -> CovarianceLosses:
    """Count what rounding covariances to half precision loses; needles and small splats suffer most.

    Parameters
    ----------
    covariances
        (N, 6) upper triangles xx, xy, xz, yy, yz, zz, finite; in float64, so that the true smallest axis is known.
    """
    halves = to_halves(covariances).astype(np.float64)
    is_finite = np.isfinite(halves).all(axis=1)
    eigenvalues = np.linalg.eigvalsh(covariances[is_finite].astype(np.float64)[:, _FULL])
    least, largest = eigenvalues[:, 0], eigenvalues[:, 2]
    rounded = np.linalg.eigvalsh(halves[is_finite][:, _FULL])[:, 0]
    is_there = least > _EIGENVALUE_NOISE * largest
    return CovarianceLosses(
        splats=len(covariances),
        vanished=int(np.count_nonzero((rounded <= 0) & is_there)),
        halved=int(np.count_nonzero(is_there & ((rounded <= least / 4) | (rounded >= least * 4)))),
        overflowed=int(np.count_nonzero(~is_finite)),
    )


def count_lost_needles(quats: NDArray[Any], log_scales: NDArray[Any], covariances: NDArray[np.float32] | None = None) -> int:
    """Count the splats whose smallest axis half precision loses: needles and discs that come back flat.

    Parameters
    ----------
    quats, log_scales
        (N, 4) wxyz and (N, 3) natural logs, -inf is flat. Covariances are rounded to float32 and then to halves, as
        Visionary's loaders do.
    covariances
        (N, 6) of these splats where they are at hand already.

    Notes
    -----
    As `half_covariance_losses(...).vanished`, by the signs of the leading minors of the rounded matrix (Sylvester) in place
    of its eigenvalues: halves have 11 bits, so that float64 holds the products.
    """
    if covariances is None:
        covariances = np.asarray(covariance_triangles(quats, log_scales), np.float32)
    xx, xy, xz, yy, yz, zz = to_halves(covariances).astype(np.float64).T
    with np.errstate(invalid="ignore", over="ignore"):
        minor = xx * yy - xy * xy
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        is_flat = ~((xx > 0) & (minor > 0) & (determinant > 0)) & np.isfinite(xx + yy + zz)
        logs = np.sort(np.asarray(log_scales, np.float64), axis=1)
        is_there = 2 * (logs[:, 0] - logs[:, 2]) > np.log(_EIGENVALUE_NOISE)
    return int(np.count_nonzero(is_flat & is_there))


def encode_gaussians(
    means: NDArray[Any], opacities: NDArray[Any], covariances: NDArray[Any], *, precision: Precision = "f16"
) -> Words:
    """Return the Gaussian buffer.

    Parameters
    ----------
    means
        (N, 3) centers.
    opacities
        (N,) linear opacities.
    covariances
        (N, 6) upper triangles xx, xy, xz, yy, yz, zz.
    precision
        "f32" or "f16".

    Returns
    -------
    NDArray
        (N, 10) or (N, 5) uint32, little-endian bytes. Halves are rounded to nearest, ties to even; below 2^-25 they are
        0, from 65520 infinite.

    Raises
    ------
    ValueError
        The precision is unknown.
    """
    scalars = np.concatenate([means, np.asarray(opacities)[:, None], covariances], axis=1)
    return _to_words(scalars, precision)


def decode_gaussians(words: Words, *, precision: Precision = "f16") -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return means (N, 3), opacities (N,) and covariances (N, 6) as float32.

    Parameters
    ----------
    words
        (N, 10) or (N, 5) uint32.
    precision
        "f32" or "f16".

    Raises
    ------
    ValueError
        The precision is unknown, or the shape does not fit it.
    """
    scalars = _to_scalars(words, precision, GAUSSIAN_SCALARS)
    return scalars[:, :3], scalars[:, 3], scalars[:, 4:]


def encode_sh(sh0: NDArray[Any], shN: NDArray[Any], *, precision: Precision = "f16", layout: ShLayout = "interleaved") -> Words:
    """Return the SH buffer; what the degree lacks is 0.

    Parameters
    ----------
    sh0
        (N, 3) constant terms.
    shN
        (N, K - 1, 3) higher coefficients, basis-major, up to degree 3.
    precision
        "f32" or "f16".
    layout
        "interleaved", which Visionary reads, or "channel-major", which its shader has but nothing switches on.

    Returns
    -------
    NDArray
        (N, 48) or (N, 24) uint32.

    Raises
    ------
    ValueError
        Precision or layout is unknown, or the degree is above 3.
    """
    _check_layout(layout)
    count, num_rest = shN.shape[:2]
    if num_rest not in (0, 3, 8, 15):
        raise ValueError(f"Visionary's buffer holds SH degrees 0 to {MAX_SH_DEGREE}, got {num_rest} higher coefficients")
    scalars = np.zeros((count, SH_SCALARS), np.float32)
    scalars[:, :3] = sh0
    rest = np.moveaxis(shN, 1, 2) if layout == "channel-major" else shN
    scalars[:, 3 : 3 + 3 * num_rest] = rest.reshape(count, 3 * num_rest)
    return _to_words(scalars, precision)


def decode_sh(
    words: Words, degree: int, *, precision: Precision = "f16", layout: ShLayout = "interleaved"
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return sh0 (N, 3) and shN (N, K - 1, 3) as the shader reads them.

    Parameters
    ----------
    words
        (N, 48) or (N, 24) uint32.
    degree
        The shader's maxShDeg, 0 to 3. A channel-major buffer has to be read with the degree it was written for.
    precision
        "f32" or "f16".
    layout
        "interleaved" or "channel-major".

    Raises
    ------
    ValueError
        Precision, layout or degree is unknown, or the shape does not fit.
    """
    _check_layout(layout)
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"degree must lie in 0..{MAX_SH_DEGREE}, got {degree}")
    scalars = _to_scalars(words, precision, SH_SCALARS)
    num_rest = (degree + 1) ** 2 - 1
    rest = scalars[:, 3 : 3 + 3 * num_rest]
    shN = (
        np.moveaxis(rest.reshape(len(words), 3, num_rest), 1, 2)
        if layout == "channel-major"
        else rest.reshape(len(words), num_rest, 3)
    )
    return np.ascontiguousarray(scalars[:, :3]), np.ascontiguousarray(shN)


def encode_raw_colors(colors: NDArray[Any], *, precision: Precision = "f16") -> Words:
    """Return the buffer of raw colors.

    Parameters
    ----------
    colors
        (N, 3) linear RGB, without SH.
    precision
        "f32" or "f16".

    Returns
    -------
    NDArray
        (N, 3) or (N, 2) uint32.

    Raises
    ------
    ValueError
        The precision is unknown.
    """
    if precision == "f16":
        colors = np.concatenate([colors, np.zeros((len(colors), 1), np.float32)], axis=1)
    return _to_words(colors, precision)


def decode_raw_colors(words: Words, *, precision: Precision = "f16") -> NDArray[np.float32]:
    """Return raw colors (N, 3); the fourth half is ignored.

    Parameters
    ----------
    words
        (N, 3) or (N, 2) uint32.
    precision
        "f32" or "f16".

    Raises
    ------
    ValueError
        The precision is unknown, or the shape does not fit it.
    """
    scalars = _to_scalars(words, precision, 4 if precision == "f16" else 3)
    return np.ascontiguousarray(scalars[:, :3])


def convert_precision(words: Words, *, source: Precision, target: Precision) -> Words:
    """Return a buffer in another precision, as Visionary's convert_precision pass does from f32 to f16.

    Parameters
    ----------
    words
        (N, D) uint32 for f32, (N, W) for f16.
    source, target
        "f32" or "f16". From f32 to f16 an odd number of scalars gets a last half of 0; back, it stays.

    Returns
    -------
    NDArray
        (N, D), (N, ceil(D / 2)) or (N, 2 W) uint32; `half_error` bounds what is lost.

    Raises
    ------
    ValueError
        A precision is unknown, or the words are not a two-dimensional uint32 array.
    """
    width = words.shape[1] * (2 if source == "f16" else 1) if words.ndim == 2 else 0
    scalars = _to_scalars(words, source, width)
    if target == "f16" and width % 2:
        scalars = np.concatenate([scalars, np.zeros((len(scalars), 1), np.float32)], axis=1)
    return _to_words(scalars, target)


def half_error(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return the largest error of each value in half precision: 2^-11 of it, 2^-25 at least, infinity where it overflows.

    Parameters
    ----------
    values
        Any shape, finite.
    """
    sizes = np.abs(values.astype(np.float64))
    return np.where(sizes >= _HALF_OVERFLOW, np.inf, np.maximum(sizes * 2.0**-11, 2.0**-25))


def to_halves(values: NDArray[Any]) -> NDArray[np.float16]:
    """Return values rounded to half precision: nearest, ties to even, overflow to infinity, one pattern of NaN.

    Parameters
    ----------
    values
        Any shape, float32 or float64.
    """
    with np.errstate(over="ignore", under="ignore"):
        halves = values.astype("<f2")
    is_nan = np.isnan(halves)
    if is_nan.any():
        halves[is_nan] = np.array(0x7E00, "<u2").view("<f2")
    return halves


def _to_words(scalars: NDArray[Any], precision: str) -> Words:
    """Return scalars (N, W) as words."""
    if precision == "f32":
        return np.ascontiguousarray(scalars, "<f4").view("<u4")
    if precision == "f16":
        return to_halves(np.ascontiguousarray(scalars)).view("<u4")
    raise ValueError(f"precision must be one of {', '.join(get_args(Precision))}, got {precision!r}")


def _to_scalars(words: Words, precision: str, num_scalars: int) -> NDArray[np.float32]:
    """Return words as scalars (N, W) float32."""
    if precision not in get_args(Precision):
        raise ValueError(f"precision must be one of {', '.join(get_args(Precision))}, got {precision!r}")
    width = num_scalars if precision == "f32" else num_scalars // 2
    if words.ndim != 2 or words.shape[1] != width or words.dtype != np.uint32:
        raise ValueError(f"expected (N, {width}) uint32 words for {precision}, got {words.dtype} of shape {words.shape}")
    words = np.ascontiguousarray(words, "<u4")
    return words.view("<f4" if precision == "f32" else "<f2").astype(np.float32, copy=False)


def _check_layout(layout: str) -> None:
    """Refuse an unknown layout of SH."""
    if layout not in get_args(ShLayout):
        raise ValueError(f"layout must be one of {', '.join(get_args(ShLayout))}, got {layout!r}")
