"""Clustering and space-filling orders, slowly and plainly."""

from itertools import combinations, pairwise

import numpy as np


def nearest(points, centroids):
    """Index and squared distance of the nearest centroid, by comparing all, in float64."""
    labels, distances = [], []
    for point in np.asarray(points, np.float64):
        squares = ((np.asarray(centroids, np.float64) - point) ** 2).sum(axis=1)
        labels.append(int(squares.argmin()))
        distances.append(squares.min())
    return np.array(labels), np.array(distances)


def best_cuts(values, weights, count):
    """Least weighted squared error of sorted values cut into `count` runs, by trying every choice of cuts."""
    values, weights = np.asarray(values, float), np.asarray(weights, float)
    least = np.inf
    for cuts in combinations(range(1, len(values)), count - 1):
        edges = [0, *cuts, len(values)]
        error = 0.0
        for start, stop in pairwise(edges):
            mean = np.average(values[start:stop], weights=weights[start:stop])
            error += float((weights[start:stop] * (values[start:stop] - mean) ** 2).sum())
        least = min(least, error)
    return least


def morton_code(cells):
    """Interleave three integers of 21 bits, the first in the lowest bit."""
    code = 0
    for bit in range(21):
        for axis in range(3):
            code |= ((int(cells[axis]) >> bit) & 1) << (3 * bit + axis)
    return code
