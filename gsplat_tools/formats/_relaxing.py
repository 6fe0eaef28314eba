"""What formats of images share when codes move to cheap neighbors: colors, and the choice of the smaller image."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import relaxation
from gsplat_tools.formats import _webp
from gsplat_tools.ops.visibility import MOST, VisibleCosts

Float32 = NDArray[np.float32]
Codes = NDArray[np.uint8]
Number = TypeVar("Number", np.uint8, np.uint16)

_TRIAL_EFFORT = 1


def relaxed_colors(cloud: GaussianCloud, codebook: Float32, plain: Codes, costs: VisibleCosts) -> Codes:
    """Return indices of sh0 into an ascending codebook, and the opacity in 255ths, (N, 4); `plain` are the nearest."""
    from gsplat_tools.attributes.activations import sigmoid

    codes = plain.copy()
    codes[:, :3] = relaxed_indices(cloud.sh0, costs.color, codebook, plain[:, :3])
    opacities = 255 * sigmoid(cloud.opacity_logits.astype(np.float64))
    codes[:, 3] = relaxation.relax_numbers(opacities, costs.opacity / 255**2, low=0, high=255, most=MOST)
    return codes


def relaxed_indices(values: Float32, costs: NDArray[np.float64], codebook: Float32, plain: Codes) -> Codes:
    """Return three indices of each splat into an ascending codebook; `plain` are the nearest."""
    # Where there are fewer distinct values than entries, the last one is repeated.
    used = codebook[: int(np.argmax(codebook)) + 1]
    nearest = np.minimum(plain, np.uint8(len(used) - 1))
    return relaxation.relax_colors(np.maximum(values, used[0]), costs, used, nearest, most=MOST)


def smaller(relaxed: NDArray[Number], plain: NDArray[Number], layout: tuple[int, int]) -> NDArray[Number]:
    """Return whichever codes compress better at a low effort: regular scenes repeat what relaxing would disturb."""
    return relaxed if _trial_size(relaxed, layout) < _trial_size(plain, layout) else plain


def _trial_size(codes: NDArray[Any], layout: tuple[int, int]) -> int:
    """Return the bytes of the images of 8-bit codes, or of both halves of 16-bit codes."""
    width, height = layout
    halves = [codes] if codes.dtype == np.uint8 else [codes >> 8, codes & 0xFF]
    size = 0
    for half in halves:
        image = np.full((height, width, 4), 255, np.uint8)
        image.reshape(-1, 4)[: len(half), : half.shape[1]] = half
        size += len(_webp.encode_rgba(image, _TRIAL_EFFORT))
    return size
