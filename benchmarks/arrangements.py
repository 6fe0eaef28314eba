"""Arrangements of splats that were tried and are no part of the package; docs/codebooks.md says what they bring."""

from __future__ import annotations

import numpy as np
from numba import njit

from gsplat_tools.attributes.activations import sigmoid
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.ops.ordering import morton_order

_BITS = 16


def hilbert3d_order(means: np.ndarray) -> np.ndarray:
    """Order along a Hilbert path through space.

    Source
    ------
    Skilling 2004, Programming the Hilbert curve.
    """
    low, span = means.min(axis=0).astype(np.float64), np.ptp(means, axis=0).astype(np.float64)
    axes = list(((means - low) / np.where(span > 0, span, 1) * ((1 << _BITS) - 1)).astype(np.int64).T)
    for bit in range(_BITS - 1, 0, -1):
        mask = (1 << bit) - 1
        for j in range(3):
            is_set = (axes[j] >> bit & 1).astype(bool)
            swap = np.where(is_set, 0, (axes[0] ^ axes[j]) & mask)
            axes[0] = np.where(is_set, axes[0] ^ mask, axes[0] ^ swap)
            axes[j] = axes[j] ^ swap if j else axes[0]
    axes[1] = axes[1] ^ axes[0]
    axes[2] = axes[2] ^ axes[1]
    flips = np.zeros_like(axes[0])
    for bit in range(_BITS - 1, 0, -1):
        flips ^= np.where(axes[2] >> bit & 1, (1 << bit) - 1, 0)
    keys = np.zeros_like(flips)
    for bit in range(_BITS - 1, -1, -1):
        for axis in axes:
            keys = keys << 1 | ((axis ^ flips) >> bit & 1)
    return np.argsort(keys, kind="stable")


def chain_order(cloud: GaussianCloud, window: int) -> np.ndarray:
    """Morton order in which each splat is followed by the one of the next `window` that differs in the fewest bits."""
    order = morton_order(cloud.means)
    sorted_cloud = cloud.take(order)
    low, span = cloud.means.min(axis=0), np.ptp(cloud.means, axis=0)
    quats = sorted_cloud.quats / np.linalg.norm(sorted_cloud.quats, axis=1, keepdims=True)
    features = np.concatenate(
        [
            (sorted_cloud.means - low) / span * 65535,
            np.where(quats[:, :1] < 0, -quats, quats)[:, 1:] * 64,
            np.sort(sorted_cloud.log_scales, axis=1) * 12,
            sorted_cloud.sh0 * 24,
            255 * sigmoid(sorted_cloud.opacity_logits)[:, None],
        ],
        axis=1,
    )
    return order[_chain(np.ascontiguousarray(features, np.float32), window)]


@njit(cache=True)
def _chain(features, window):
    """Greedy chain; the cost of a step is the sum of log2(1 + |difference|); nothing waits longer than four windows."""
    count, dimensions = features.shape
    chosen = np.empty(count, np.int64)
    waiting = np.empty(window, np.int64)
    size = min(window, count)
    for k in range(size):
        waiting[k] = k
    following = size
    for i in range(count):
        best, place = np.float32(np.inf), 0
        if i > 0 and waiting[0] + 4 * window >= i:
            for k in range(size):
                cost = np.float32(0)
                for d in range(dimensions):
                    cost += np.log2(np.float32(1) + abs(features[waiting[k], d] - features[chosen[i - 1], d]))
                if cost < best:
                    best, place = cost, k
        chosen[i] = waiting[place]
        for k in range(place, size - 1):
            waiting[k] = waiting[k + 1]
        if following < count:
            waiting[size - 1] = following
            following += 1
        else:
            size -= 1
    return chosen
