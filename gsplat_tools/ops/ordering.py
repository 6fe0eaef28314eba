"""Orders that put splats that lie close together close together, as permutations."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.parallel import run_blocks

Order = NDArray[np.uint32]
OrderMethod = Literal["morton", "hilbert2d", "none"]

_CELLS = float((1 << 21) - 1)


def image_layout(count: int) -> tuple[int, int]:
    """Return (width, height) of the smallest nearly square image that holds `count` pixels."""
    width = max(1, math.isqrt(max(count - 1, 0)) + 1)
    return width, max(1, -(-count // width))


def morton_order(means: NDArray[np.float32]) -> Order:
    """Return the permutation that sorts points along a Morton curve through their box.

    Parameters
    ----------
    means
        (N, 3) positions, finite.

    Returns
    -------
    Order
        (N,) uint32; equal cells (2^-21 of the box an axis) keep their order.
    """
    if len(means) == 0:
        return np.zeros(0, np.uint32)
    return order_of_codes(cell_codes(means, means.min(axis=0), means.max(axis=0)))


def cell_codes(means: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return the Morton code of every point's cell in the box of a scene, of which the points may be a part.

    Parameters
    ----------
    means
        (N, 3) positions, finite.
    low, high
        (3,) ends of the box of all points.
    """
    from gsplat_tools.kernels.morton import morton_codes

    means = np.ascontiguousarray(means, np.float32)
    low = low.astype(np.float64)
    span = high - low
    with np.errstate(divide="ignore", over="ignore"):
        step = np.where(span > 0, _CELLS / span, 0.0)
    step = np.where(np.isfinite(step), step, 0.0)
    codes = np.empty(len(means), np.uint64)
    run_blocks(lambda start, stop: morton_codes(means, low, step, start, stop, codes), len(means), 1 << 16)
    return codes


def order_of_codes(codes: NDArray[np.uint64], method: OrderMethod = "morton", layout: tuple[int, int] | None = None) -> Order:
    """Return what `splat_order` gives, from the cells of all splats instead of the splats."""
    if method == "none":
        return np.arange(len(codes), dtype=np.uint32)
    order = np.argsort(codes, kind="stable").astype(np.uint32)
    return order if method == "morton" else _along_hilbert(order, layout)


def hilbert2d_order(means: NDArray[np.float32], layout: tuple[int, int] | None = None) -> Order:
    """Return the permutation that lays a Morton path through space along a Hilbert path through an image.

    Parameters
    ----------
    means
        (N, 3) positions, finite.
    layout
        (width, height) of the image whose pixel i (row-major) shows splat i; by default `image_layout`.

    Returns
    -------
    Order
        (N,) uint32; splat `order[i]` goes to pixel i.

    Raises
    ------
    ValueError
        The layout has fewer pixels than there are points.
    """
    return _along_hilbert(morton_order(means), layout)


def _along_hilbert(path: Order, layout: tuple[int, int] | None) -> Order:
    """Return the permutation that lays a path through space along a Hilbert path through an image."""
    from gsplat_tools.kernels.morton import hilbert_path

    count = len(path)
    width, height = image_layout(count) if layout is None else layout
    if width * height < count:
        raise ValueError(f"layout {width} x {height} has fewer pixels than {count} splats")
    xs, ys = np.empty(width * height, np.int32), np.empty(width * height, np.int32)
    hilbert_path(width, height, xs, ys)
    pixels = ys.astype(np.int64) * width + xs
    order = np.empty(count, np.uint32)
    order[pixels[pixels < count]] = path
    return order


def splat_order(cloud: GaussianCloud, method: OrderMethod, layout: tuple[int, int] | None = None) -> Order:
    """Return the permutation that a method gives for a cloud.

    Parameters
    ----------
    cloud
        N splats with finite means.
    method
        "morton", "hilbert2d", or "none" for the order as it is.
    layout
        (width, height) of the images of the target, for "hilbert2d".

    Returns
    -------
    Order
        (N,) uint32, to be used as `cloud.take(order)`.

    Raises
    ------
    ValueError
        The method is unknown.
    """
    if method == "morton":
        return morton_order(cloud.means)
    if method == "hilbert2d":
        return hilbert2d_order(cloud.means, layout)
    if method == "none":
        return np.arange(len(cloud), dtype=np.uint32)
    raise ValueError(f"order must be one of {get_args(OrderMethod)}, got {method!r}")


def order_splats(cloud: GaussianCloud, method: OrderMethod, layout: tuple[int, int] | None = None) -> GaussianCloud:
    """Return the cloud in the order that `splat_order` gives."""
    return cloud if method == "none" else cloud.take(splat_order(cloud, method, layout))
