"""Search among cells: exact whatever the cells are, and silent about vectors that are not there."""

import numpy as np
import pytest

from gsplat_tools.kernels.cells import CELL, GROUP, nearest_in_cells
from tests.oracles.clustering import nearest

pytestmark = pytest.mark.uncompiled


def in_groups(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates in groups, and the length of what follows each."""
    groups = rows.reshape(len(rows), -1, GROUP)
    lengths = (groups.astype(np.float64) ** 2).sum(axis=2)
    tails = np.sqrt(lengths.sum(axis=1, keepdims=True) - np.cumsum(lengths, axis=1)).astype(np.float32)
    return np.ascontiguousarray(groups), np.nan_to_num(tails)


@pytest.mark.parametrize("is_exact", [True, False])
def test_nearest_in_cells__finds_the_nearest_and_skips_boxes(is_exact: bool) -> None:
    rng = np.random.default_rng(3)
    near, far = rng.normal(0, 1, (40, 2 * GROUP)), rng.normal(100, 1, (CELL, 2 * GROUP))
    rows = np.concatenate([near, far]).astype(np.float32)
    groups, tails = in_groups(rows)
    cells = np.full((2, 2, GROUP + 1, CELL), np.inf, np.float32)
    slots = np.concatenate([np.arange(40), CELL + np.arange(CELL)])
    cells[slots // CELL, :, :GROUP, slots % CELL] = groups
    cells[slots // CELL, :, GROUP, slots % CELL] = tails
    boxed = np.concatenate([groups[:, 0], tails[:, :1]], axis=1)
    lows, highs = (np.stack([pick(boxed[:40], axis=0), pick(boxed[40:], axis=0)]) for pick in (np.min, np.max))
    points = np.concatenate([rng.normal(0, 1, (6, 2 * GROUP)), rng.normal(100, 1, (6, 2 * GROUP))]).astype(np.float32)
    labels, distances = np.empty(12, np.int64), np.empty(12, np.float32)

    work = nearest_in_cells(*in_groups(points), cells, lows, highs, 1, is_exact, labels, distances)

    expected, squares = nearest(points, rows)
    assert np.array_equal(labels, slots[expected])
    assert np.allclose(distances, squares, rtol=1e-4)
    assert 12 <= work <= 24  # one cell of two a point: the other's box is too far away
