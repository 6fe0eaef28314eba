"""Renderings as 8-bit pictures: rounding, contact sheets, amplified differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_GAP = 4
_PAPER = 32
"""Width, px, and gray of what lies between the pictures of a sheet."""


def to_uint8(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a picture in 8 bits: clamped to [0, 1] and rounded; NaN becomes 0.

    Parameters
    ----------
    image
        (H, W, 3) colors, or (H, W) gray.

    Returns
    -------
    ndarray
        uint8 of the same shape. Colors are stored as they are: the pictures of splats are sRGB-encoded already.
    """
    if image.dtype == np.uint8:
        return image
    return np.rint(np.clip(np.nan_to_num(image.astype(np.float64), nan=0.0), 0.0, 1.0) * 255).astype(np.uint8)


def contact_sheet(images: Sequence[NDArray[Any]], *, columns: int | None = None) -> NDArray[np.uint8]:
    """Lay pictures out in rows.

    Parameters
    ----------
    images
        One or more pictures (H, W, 3); smaller ones are centered in the cell of the largest.
    columns
        Pictures in a row; by default as many as make the sheet about as wide as a screen.

    Returns
    -------
    ndarray
        (H', W', 3) uint8; a single picture is returned without a frame.

    Raises
    ------
    ValueError
        There is no picture, or `columns` is below 1.
    """
    if not images:
        raise ValueError("a contact sheet needs at least one picture")
    pictures = [to_uint8(image) for image in images]
    if len(pictures) == 1:
        return pictures[0]
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    if columns is None:
        # Columns that bring the sheet closest to 16:9.
        columns = max(1, round(math.sqrt(len(pictures) * (16 / 9) * height / width)))
    if columns < 1:
        raise ValueError(f"columns must be at least 1, got {columns}")
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3), _PAPER, np.uint8)
    for index, picture in enumerate(pictures):
        row, column = divmod(index, columns)
        top = row * (height + _GAP) + (height - picture.shape[0]) // 2
        left = column * (width + _GAP) + (width - picture.shape[1]) // 2
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def difference_picture(reference: NDArray[Any], candidate: NDArray[Any], *, gain: float = 10.0) -> NDArray[np.uint8]:
    """Return the absolute difference of two pictures, amplified.

    Parameters
    ----------
    reference, candidate
        (H, W, 3) colors, clamped to [0, 1].
    gain
        Factor of the difference; at 10 a step of 1/255 is just visible.

    Raises
    ------
    ValueError
        The shapes differ.
    """
    if reference.shape != candidate.shape:
        raise ValueError(f"expected two pictures of one shape, got {reference.shape} and {candidate.shape}")
    a, b = (np.clip(np.nan_to_num(image.astype(np.float64), nan=0.0), 0.0, 1.0) for image in (reference, candidate))
    return to_uint8(np.abs(a - b) * gain)
