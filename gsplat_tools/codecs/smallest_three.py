"""Rotations in 32 or 24 bits: three components of the quaternion on a grid, the fourth made up by the decoder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.parallel import run_blocks

Float32 = NDArray[np.float32]

Rotation = Literal["reference", "best", "small"]
"""How the frame of a rotation is chosen: as the format's own encoder, smallest error, or smallest turn."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the stored components may lie: (integer + offset) / steps.

    Parameters
    ----------
    steps
        Grid points per unit.
    offset
        0 where 0 is a grid point, 0.5 where it lies between two.
    drops_w
        Whether w is the component that is left out whatever its size, instead of the largest.
    """

    steps: float
    offset: float
    drops_w: bool = False

    @property
    def max_angle(self) -> float:
        """Largest rotation error for any rotation in its own frame, radians.

        Notes
        -----
        Three components move by at most half a step each, together by e = sqrt(3) / (2 steps). On the unit sphere that
        moves the point by at most e / l, l the smallest value of the component left out on the way. The largest of four
        is at least 1/2 before, so that l^2 >= 1 - (sqrt(3) / 2 + e)^2. Where w is left out it can be 0, and two points of
        the half sphere whose projections are at most e apart are at most arccos(1 - e) apart (one of them on the rim).
        A rotation turns by twice the angle of its quaternion.
        """
        moved = np.sqrt(3.0) / (2 * self.steps)
        if self.drops_w:
            return float(2 * np.arccos(1 - moved))
        return float(2 * moved / np.sqrt(1 - (np.sqrt(0.75) + moved) ** 2))


SPZ_SMALLEST_THREE = Grid(steps=511 * np.sqrt(2.0), offset=0.0)
"""Sign and nine bits over 0..sqrt(1/2) (SPZ 3 and 4): 0.276 degrees at most."""

SPZ_FIRST_THREE = Grid(steps=127.5, offset=0.5, drops_w=True)
"""Eight bits over -1..1 of x, y and z (SPZ 1 and 2): 13.4 degrees at most."""

PACKED_PLY = Grid(steps=1023 * np.sqrt(0.5), offset=0.5)
"""Ten bits over -sqrt(1/2)..sqrt(1/2) (compressed.ply): 0.276 degrees at most."""


def choose_frames(
    quats: Float32, log_scales: Float32, grid: Grid, rotation: Rotation, *, by_angle: bool = False
) -> NDArray[np.uint8]:
    """Return the frame, 0 to 23 of `kernels.rotation_frames`, in which each splat is to be stored.

    Parameters
    ----------
    quats, log_scales
        (N, 4) wxyz of any length and (N, 3) of the splats, C-contiguous.
    grid
        Grid of the format.
    rotation
        "best" takes the smallest error after decoding, "small" the smallest turn; "reference" keeps every frame.
    by_angle
        Let the error be the angle, not that of the covariance.

    Returns
    -------
    NDArray[np.uint8]
        (N,), or (0,) for "reference".
    """
    from gsplat_tools.kernels import rotation_frames, smallest_three

    if rotation not in get_args(Rotation):
        raise ValueError(f"rotation must be one of {', '.join(get_args(Rotation))}, got {rotation!r}")
    if rotation == "reference":
        return np.empty(0, np.uint8)
    frames = np.empty(len(quats), np.uint8)

    def choose(start: int, stop: int) -> None:
        part = slice(start, stop)
        if rotation == "small":
            rotation_frames.frames_of_largest_w(quats[part], frames[part])
        else:
            smallest_three.choose_frames(quats[part], log_scales[part], grid.steps, grid.offset, by_angle, frames[part])

    run_blocks(choose, len(quats))
    return frames


def in_frames(quats: Float32, log_scales: Float32, frames: NDArray[np.uint8]) -> tuple[Float32, Float32]:
    """Return quaternions and log scales with every splat's axes relabelled; the same arrays where there are no frames."""
    from gsplat_tools.kernels import rotation_frames

    if not len(frames):
        return quats, log_scales
    turned, relabelled = np.empty_like(quats), np.empty_like(log_scales)

    def apply(start: int, stop: int) -> None:
        part = slice(start, stop)
        rotation_frames.apply_frames(quats[part], log_scales[part], frames[part], turned[part], relabelled[part])

    run_blocks(apply, len(quats))
    return turned, relabelled
