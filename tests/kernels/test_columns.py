"""Rows to columns and back, against plain indexing."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.kernels.columns import gather_rows, scatter_rows

pytestmark = pytest.mark.uncompiled


def empty_arrays(count, num_rest):
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, num_rest, 3)]
    return [np.full(shape, np.float32(9e9)) for shape in shapes]


@pytest.mark.parametrize("num_rest", [0, 3, 24])
def test_scatter_rows__follows_the_columns(num_rest):
    rng = np.random.default_rng(num_rest)
    width = 20 + 3 * num_rest
    rows = rng.standard_normal((7, width)).astype(np.float32)
    columns = rng.permutation(width)[: 14 + 3 * num_rest]
    means, log_scales, quats, opacity_logits, sh0, shN = arrays = empty_arrays(7, num_rest)

    has_normals = scatter_rows(rows, columns, np.empty(0, np.int64), *arrays)

    assert not has_normals
    np.testing.assert_array_equal(means, rows[:, columns[0:3]])
    np.testing.assert_array_equal(log_scales, rows[:, columns[3:6]])
    np.testing.assert_array_equal(quats, rows[:, columns[6:10]])
    np.testing.assert_array_equal(opacity_logits, rows[:, columns[10]])
    np.testing.assert_array_equal(sh0, rows[:, columns[11:14]])
    np.testing.assert_array_equal(shN, rows[:, columns[14:]].reshape(7, 3, num_rest).transpose(0, 2, 1))


def test_scatter_rows__fills_in_the_missing_scale():
    columns = np.arange(14)
    columns[5] = -1
    arrays = empty_arrays(4, 0)

    scatter_rows(np.ones((4, 14), np.float32), columns, np.empty(0, np.int64), *arrays)

    np.testing.assert_array_equal(arrays[1], [[1, 1, -np.inf]] * 4)


@pytest.mark.parametrize(("value", "expected"), [(0.0, False), (-0.0, False), (1e-45, True), (np.nan, True)])
def test_scatter_rows__notices_normals(value, expected):
    rows = np.zeros((5, 17), np.float32)
    rows[3, 15] = value

    assert scatter_rows(rows, np.arange(14), np.array([14, 15, 16]), *empty_arrays(5, 0)) == expected


@pytest.mark.parametrize("num_scales", [2, 3])
@pytest.mark.parametrize("num_rest", [0, 8])
def test_gather_rows__is_undone_by_scatter_rows(num_scales, num_rest):
    rng = np.random.default_rng(3)
    arrays = [rng.integers(0, 1 << 32, values.shape, np.uint32).view(np.float32) for values in empty_arrays(9, num_rest)]
    rows = np.empty((9, 11 + num_scales + 3 * num_rest), np.float32)
    tail = 6 + 3 * num_rest
    scales = [tail + 1, tail + 2, tail + 3 if num_scales == 3 else -1]
    quats = [tail + 1 + num_scales + i for i in range(4)]
    columns = np.array([0, 1, 2, *scales, *quats, tail, 3, 4, 5, *range(6, tail)])
    found = empty_arrays(9, num_rest)

    gather_rows(*arrays, num_scales, rows)
    scatter_rows(rows, columns, np.empty(0, np.int64), *found)

    if num_scales == 2:
        arrays[1][:, 2] = -np.inf
    for values, expected in zip(found, arrays, strict=True):
        assert values.tobytes() == expected.tobytes()
