"""Quaternions in four bytes w x y z, value (b - 128) / 128; the decoder normalizes (.sog4d, .splat4d, .splat)."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import CloudError
from gsplat_tools.parallel import run_blocks

Mode = Literal["best", "reference"]
FrameMode = Literal["best", "small"]

MAX_ANGLE = 2.0 * float(np.arcsin(1.0 / 127.0))
"""Largest rotation error of both modes, in radians (0.902 degrees).

Rounding leaves a residual of at most half a step in each of four components, so of at most one step in all, on a ray of
at least 127.49 ("best", saturation) or 128 steps ("reference"); a rotation turns by twice the angle of its quaternion.
Where "reference" clamps 128 to 127 the other components span at most 11.3 steps, so that of the clamped step 0.09 lies
across the ray and the residual across it is at most sqrt(3) / 2 + 0.09 steps.
"""


def encode(quats: NDArray[np.floating[Any]], *, mode: Mode = "best") -> NDArray[np.uint8]:
    """Quantize rotations to four bytes.

    Parameters
    ----------
    quats
        (N, 4) wxyz, of any length; length 0 is taken as the identity.
    mode
        "reference" rounds the unit quaternion; "best" also searches the length that is stored, which decoders
        normalize away, for the smallest angle, and stores w >= 0.

    Returns
    -------
    NDArray[np.uint8]
        (N, 4) codes w x y z.

    Raises
    ------
    CloudError
        A component is not finite.
    """
    from gsplat_tools.kernels import quaternion_u8 as kernels

    if mode not in get_args(Mode):
        raise ValueError(f"mode must be one of {get_args(Mode)}, got {mode!r}")
    values = _checked(quats)
    codes = np.empty(values.shape, np.uint8)
    quantize = kernels.quantize_best if mode == "best" else kernels.quantize_reference
    run_blocks(lambda start, stop: quantize(values[start:stop], codes[start:stop]), len(values))
    return codes


def encode_with_frames(
    quats: NDArray[np.floating[Any]], log_scales: NDArray[np.floating[Any]], *, mode: FrameMode = "best"
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Quantize rotations to four bytes, each in the one of its 24 frames that suits best.

    Relabeling the axes of a Gaussian permutes its scales and does not change its covariance. Not for keyframes that are
    interpolated, unless one frame serves all of them.

    Parameters
    ----------
    quats
        (N, 4) wxyz, of any length; length 0 is taken as the identity.
    log_scales
        (N, 3) natural logs of the scales along the local axes.
    mode
        "best" has the smallest error of the covariance; "small" takes the smallest turn, whose bytes compress best, and
        then the best length.

    Returns
    -------
    tuple
        codes (N, 4) u8 w x y z · log_scales (N, 3) f32 in the order of the new axes.

    Raises
    ------
    CloudError
        A component of a quaternion is not finite.
    """
    from gsplat_tools.kernels import quaternion_u8 as kernels
    from gsplat_tools.kernels import rotation_frames

    if mode not in get_args(FrameMode):
        raise ValueError(f"mode must be one of {get_args(FrameMode)}, got {mode!r}")
    values, scales = _checked(quats), np.ascontiguousarray(log_scales, np.float32)
    if scales.shape != (len(values), 3):
        raise ValueError(f"log_scales must have shape ({len(values)}, 3), got {scales.shape}")
    codes, frames = np.empty(values.shape, np.uint8), np.empty(len(values), np.uint8)

    def quantize(start: int, stop: int) -> None:
        part = slice(start, stop)
        if mode == "best":
            kernels.quantize_in_frames(values[part], scales[part], codes[part], frames[part])
            return
        turned, permuted = np.empty((stop - start, 4), np.float32), np.empty((stop - start, 3), np.float32)
        rotation_frames.frames_of_largest_w(values[part], frames[part])
        rotation_frames.apply_frames(values[part], scales[part], frames[part], turned, permuted)
        kernels.quantize_best(turned, codes[part])

    run_blocks(quantize, len(values))
    axes = rotation_frames.FRAME_AXES[frames]
    return codes, np.take_along_axis(scales, axes, axis=1)


def encode_constant_w(quats: NDArray[np.float32], steps: int) -> NDArray[np.uint8]:
    """Quantize rotations with w as the same number of steps everywhere, so that one byte of four says nothing.

    Parameters
    ----------
    quats
        (N, 4) wxyz, finite, of any length; length 0 is taken as the identity. Where w is not the largest component, the
        quaternion is shortened until all fit.
    steps
        1 to 127; the error is at most 2 asin(sqrt(3) / 2 / steps) radians where w is the largest component.

    Returns
    -------
    NDArray[np.uint8]
        (N, 4) codes w x y z.
    """
    wide = quats.astype(np.float64)
    wide *= np.where(wide[:, :1] < 0, -1.0, 1.0)
    largest = np.abs(wide).max(axis=1, keepdims=True)
    is_null = largest == 0
    wide[is_null[:, 0]] = (1, 0, 0, 0)
    # 127 steps for the largest component are the end of the byte.
    scale = np.minimum(steps / np.maximum(wide[:, :1], 1e-30), 127 / np.where(is_null, 1.0, largest))
    return (np.rint(wide * scale) + 128).astype(np.uint8)


def _checked(quats: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return quaternions as the kernels take them."""
    values = np.ascontiguousarray(quats, np.float32)
    if values.ndim != 2 or values.shape[1] != 4:
        raise ValueError(f"quats must have shape (N, 4), got {values.shape}")
    if not np.isfinite(values).all():
        bad = int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        raise CloudError(f"{bad} of {len(values)} quaternions are not finite; drop them first", field="quats")
    return values


def decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the unit quaternions, wxyz with w >= 0, that (N, 4) codes stand for; (128, 128, 128, 128) is the identity."""
    values = (codes.astype(np.float32) - 128) / 128
    squares = np.square(values).sum(axis=1, keepdims=True)
    is_null = squares == 0
    lengths = np.sqrt(np.where(is_null, np.float32(1), squares))
    unit = values / np.where(values[:, :1] < 0, -lengths, lengths)
    return np.where(is_null, np.array([1, 0, 0, 0], np.float32), unit).astype(np.float32)
