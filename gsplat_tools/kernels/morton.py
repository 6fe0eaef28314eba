"""Codes that follow space: bits of three coordinates interleaved, and a Hilbert path through a rectangle."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import device, kernel


@device()
def _spread(value):
    """Put two zero bits between the lowest 21 bits of `value` (uint64)."""
    v = np.uint64(value) & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@kernel()
def morton_codes(means, low, step, start, stop, codes):
    """63-bit Morton codes, 21 bits an axis, x in the lowest bit.

    means  float32 (N, 3)  read; finite
    low    float64 (3,)    read; smallest coordinate of each axis
    step   float64 (3,)    read; cells per world unit of each axis, 0 for a flat one
    start, stop  int       rows to do
    codes  uint64 (N,)     written in start..stop
    """
    for i in range(start, stop):
        code = np.uint64(0)
        for axis in range(3):
            cell = np.uint64(min(max((np.float64(means[i, axis]) - low[axis]) * step[axis], 0.0), 2097151.0))
            code |= _spread(cell) << np.uint64(axis)
        codes[i] = code


@kernel()
def hilbert_path(width, height, xs, ys):
    """Walk every pixel of a rectangle along a Hilbert-like path: neighbors in time are neighbors in the plane.

    width, height  int            size of the rectangle
    xs, ys         int32 (W * H,) written; pixel of each step

    A rectangle that is long along its first axis is cut in two there; otherwise into three parts that make the U of
    the Hilbert curve. Cuts are placed at even lengths where possible, so that steps stay of length one.
    """
    # Explicit stack of (x, y, ax, ay, bx, by): corner, main axis, other axis.
    stack = np.empty((256, 6), np.int64)
    depth = 0
    if width >= height:
        stack[0] = np.array([0, 0, width, 0, 0, height])
    else:
        stack[0] = np.array([0, 0, 0, height, width, 0])
    depth = 1
    done = 0
    while depth > 0:
        depth -= 1
        x, y, ax, ay, bx, by = stack[depth]
        w, h = abs(ax + ay), abs(bx + by)
        dax, day, dbx, dby = np.sign(ax), np.sign(ay), np.sign(bx), np.sign(by)
        if h == 1:
            for _ in range(w):
                xs[done], ys[done] = x, y
                done += 1
                x, y = x + dax, y + day
            continue
        if w == 1:
            for _ in range(h):
                xs[done], ys[done] = x, y
                done += 1
                x, y = x + dbx, y + dby
            continue
        ax2, ay2 = _half(ax), _half(ay)
        bx2, by2 = _half(bx), _half(by)
        w2, h2 = abs(ax2 + ay2), abs(bx2 + by2)
        if 2 * w > 3 * h:
            if w2 % 2 == 1 and w > 2:
                ax2, ay2 = ax2 + dax, ay2 + day
            stack[depth] = np.array([x + ax2, y + ay2, ax - ax2, ay - ay2, bx, by])
            stack[depth + 1] = np.array([x, y, ax2, ay2, bx, by])
            depth += 2
        else:
            if h2 % 2 == 1 and h > 2:
                bx2, by2 = bx2 + dbx, by2 + dby
            end_x, end_y = x + (ax - dax) + (bx2 - dbx), y + (ay - day) + (by2 - dby)
            stack[depth] = np.array([end_x, end_y, -bx2, -by2, -(ax - ax2), -(ay - ay2)])
            stack[depth + 1] = np.array([x + bx2, y + by2, ax, ay, bx - bx2, by - by2])
            stack[depth + 2] = np.array([x, y, bx2, by2, ax2, ay2])
            depth += 3


@device()
def _half(value):
    """Half of an integer, rounded toward zero."""
    return value // 2 if value >= 0 else -((-value) // 2)
