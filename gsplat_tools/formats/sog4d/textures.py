"""Images of a frame to and from arrays of numbers: pixel i, row by row, is splat i."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats._webp import Image


def blank(width: int, height: int) -> Image:
    """Return an opaque black image."""
    image = np.zeros((height, width, 4), np.uint8)
    image[..., 3] = 255
    return image


def rgba_image(codes: NDArray[np.uint8], width: int, height: int) -> Image:
    """Return an image of (N, 2), (N, 3) or (N, 4) bytes; what is left over is opaque black."""
    image = blank(width, height)
    image.reshape(-1, 4)[: len(codes), : codes.shape[1]] = codes
    return image


def index_image(indices: NDArray[np.integer[Any]], width: int, height: int) -> Image:
    """Return an image of (N,) numbers of 16 bits: low byte in red, high byte in green."""
    return rgba_image(index_columns(indices), width, height)


def index_columns(indices: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
    """Return the low and the high byte of (N,) numbers of 16 bits, (N, 2)."""
    return np.stack([indices & 0xFF, indices >> 8], axis=1).astype(np.uint8)


def pixels_of(image: Image, count: int) -> NDArray[np.uint8]:
    """Return the first `count` pixels, (N, 4)."""
    return image.reshape(-1, 4)[:count]


def indices_of(image: Image, count: int) -> NDArray[np.uint16]:
    """Return the 16-bit numbers of the first `count` pixels."""
    pixels = pixels_of(image, count)
    low: NDArray[np.uint16] = pixels[:, 0].astype(np.uint16)
    return low | pixels[:, 1].astype(np.uint16) << np.uint16(8)


def check_indices(code: str, indices: NDArray[np.uint16], limit: int, what: str, field: str, frame: int) -> list[Issue]:
    """Return an issue where an index reaches the limit."""
    is_bad = indices >= limit
    if not is_bad.any():
        return []
    first = int(np.argmax(is_bad))
    return [
        Issue(
            code=code,
            message=f"expected a {what} below {limit}, found {indices[first]} at splat {first}",
            field=field,
            frame=frame,
            splat=first,
            value=int(indices[first]),
            count=int(np.count_nonzero(is_bad)),
        )
    ]
