"""Bits where they show: a frame's codes moved to cheap neighbors, as far as the visual tolerance lets them."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import relaxation
from gsplat_tools.formats import _webp
from gsplat_tools.formats.sog4d.textures import rgba_image
from gsplat_tools.ops.visibility import MAX_TURN, MOST, VisibleCosts

Float32 = NDArray[np.float32]
Codes = NDArray[np.uint8]
Number = TypeVar("Number", np.uint8, np.uint16)

_TRIAL_EFFORT = 1


def positions(
    means: Float32, low: Float32, high: Float32, plain: NDArray[np.uint16], costs: VisibleCosts
) -> NDArray[np.uint16]:
    """Return codes of positions; `plain` are the nearest."""
    codes = plain.copy()
    for axis in range(3):
        step = (float(high[axis]) - float(low[axis])) / 65535
        if step > 0:
            targets = np.clip((means[:, axis].astype(np.float64) - float(low[axis])) / step, 0, 65535)
            codes[:, axis] = relaxation.relax_numbers(targets, costs.position * step**2, low=0, high=65535, most=MOST)
    return codes


def rotations(quats: Float32, is_fixed: NDArray[np.bool_] | None, plain: Codes, costs: VisibleCosts) -> Codes:
    """Return bytes of rotations; those that are fixed stay."""
    codes = relaxation.relax_rotations(quats, costs.rotation, plain, most=MOST, max_turn=MAX_TURN)
    if is_fixed is not None:
        codes[is_fixed] = plain[is_fixed]
    return codes


def colors(cloud: GaussianCloud, codebook: Float32, plain: Codes, costs: VisibleCosts) -> Codes:
    """Return indices of sh0 and the opacity, (N, 4)."""
    from gsplat_tools.attributes.activations import sigmoid

    codes = plain.copy()
    used = codebook[: int(np.argmax(codebook)) + 1]
    nearest = np.minimum(plain[:, :3], np.uint8(len(used) - 1))
    codes[:, :3] = relaxation.relax_colors(cloud.sh0, costs.color, used, nearest, most=MOST)
    opacities = 255 * sigmoid(cloud.opacity_logits.astype(np.float64))
    codes[:, 3] = relaxation.relax_numbers(opacities, costs.opacity / 255**2, low=0, high=255, most=MOST)
    return codes


def smaller(relaxed: NDArray[Number], plain: NDArray[Number], layout: tuple[int, int]) -> NDArray[Number]:
    """Return whichever codes compress better at a low effort: regular scenes repeat what relaxing would disturb."""
    return relaxed if _trial_size(relaxed, layout) < _trial_size(plain, layout) else plain


def _trial_size(codes: NDArray[Any], layout: tuple[int, int]) -> int:
    """Return the bytes of the images of 8-bit codes, or of both halves of 16-bit codes."""
    halves = [codes] if codes.dtype == np.uint8 else [(codes >> 8).astype(np.uint8), (codes & 0xFF).astype(np.uint8)]
    return sum(len(_webp.encode_rgba(rgba_image(half, *layout), _TRIAL_EFFORT)) for half in halves)
