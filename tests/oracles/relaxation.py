"""Choice of cheap codes by trying all of them."""

from __future__ import annotations

import numpy as np


def best_number(target, cost, bits, carry, most, low, high):
    """The code with the smallest sum of bits and cost, the smallest of equally good ones."""
    codes = np.arange(low, high + 1)
    nearest = int(np.clip(np.rint(target), low, high))
    distances = cost * (codes - target) ** 2
    allowed = (codes == nearest) | ((distances <= most) & (np.abs(codes - nearest) <= 255))
    totals = distances + bits[codes & 255] + carry * ((codes >> 8) != (nearest >> 8))
    return int(codes[np.argmin(np.where(allowed, totals, np.inf))])


def best_color(target, cost, codebook, bits, nearest, most):
    """The smallest sum over three channels, red and blue coded as their difference from green."""
    entries = np.arange(len(codebook))
    distances = cost * (codebook.astype(np.float64)[None, :] - target.astype(np.float64)[:, None]) ** 2
    allowed = (distances <= most) | (entries[None, :] == np.asarray(nearest)[:, None])
    least = np.inf
    for green in entries[allowed[1]]:
        total = distances[1, green] + bits[1, green]
        for channel in (0, 2):
            total += np.where(allowed[channel], distances[channel] + bits[channel][(entries - green) & 255], np.inf).min()
        least = min(least, total)
    return least


def turn_cost(quat, stored, costs):
    """What the turn from a unit quaternion to a stored one costs, by the rotation matrices: skew part 2 sin(angle) n."""
    turn = matrix(quat).T @ matrix(stored / np.linalg.norm(stored))
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = axis / max(np.linalg.norm(axis), 1e-300)
    return float(costs @ (2 * np.sin(angle / 2) * axis) ** 2), float(angle)


def matrix(quat):
    w, x, y, z = quat
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
