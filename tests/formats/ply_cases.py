"""What the tests of the PLY reader share."""

from __future__ import annotations

import io

import numpy as np

from gsplat_tools.formats import ply
from tests.builders import PlyElement, splat_arrays

ENCODINGS = ["binary_little_endian", "binary_big_endian", "ascii"]


def read(data: bytes, **options):
    return ply.read(io.BytesIO(data), ply.ReadOptions(**options))


def vertex(columns, **changes):
    return PlyElement("vertex", columns, **changes)


def assert_holds(cloud, columns):
    """The arrays hold the columns, bit by bit."""
    expected = splat_arrays(columns)
    found = cloud.arrays()
    for name, values in expected.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name].view(np.uint32), values.view(np.uint32), err_msg=name)
