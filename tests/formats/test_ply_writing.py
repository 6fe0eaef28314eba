"""Writing PLY: the bytes that were asked for, and every bit back."""

from __future__ import annotations

import io
import itertools
import struct

import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, LossyConversionWarning
from gsplat_tools.formats import ply
from tests.builders import PlyElement, ply_file, splat_arrays, splat_columns


def make_cloud(count: int, sh_degree: int, seed: int = 0, **changes) -> GaussianCloud:
    """A cloud of arbitrary float32 bits, NaN payloads included."""
    rng = np.random.default_rng(seed)
    bits = lambda *shape: rng.integers(0, 1 << 32, shape, np.uint32).view(np.float32)  # noqa: E731
    return GaussianCloud(
        bits(count, 3),
        bits(count, 3),
        bits(count, 4),
        bits(count),
        bits(count, 3),
        bits(count, (sh_degree + 1) ** 2 - 1, 3),
        **changes,
    )


def motion(count: int, seed: int = 1):
    rng = np.random.default_rng(seed)
    return {
        "velocities": rng.standard_normal((count, 3)).astype(np.float32),
        "times": rng.random(count, np.float32),
        "durations": rng.random(count, np.float32),
    }


def written(scene) -> bytes:
    stream = io.BytesIO()
    ply.write(scene, stream)
    return stream.getvalue()


def assert_same(found: GaussianCloud, expected: GaussianCloud) -> None:
    assert found.arrays().keys() == expected.arrays().keys()
    for name, values in expected.arrays().items():
        assert found.arrays()[name].tobytes() == values.tobytes(), name
    assert found.extra.keys() == expected.extra.keys()
    for name, values in expected.extra.items():
        assert found.extra[name].dtype == values.dtype
        assert found.extra[name].tobytes() == values.tobytes()
    np.testing.assert_array_equal(found.origin, expected.origin)
    for name in ("time_model", "coordinate_system", "splat_model"):
        assert getattr(found, name) == getattr(expected, name)


def test_write__gives_exactly_these_bytes():
    columns = splat_columns(2, 1, normals=False)

    data = written(GaussianCloud(**splat_arrays(columns)))

    assert data == ply_file(PlyElement("vertex", columns))


@settings(deadline=None, max_examples=40)
@given(count=st.integers(0, 40), sh_degree=st.integers(0, 4), seed=st.integers(0, 9), has_motion=st.booleans(), data=st.data())
def test_write__brings_every_bit_back(count, sh_degree, seed, has_motion, data):
    kinds = data.draw(st.lists(st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]), max_size=3))
    rng = np.random.default_rng(seed)
    cloud = make_cloud(
        count,
        sh_degree,
        seed,
        **(motion(count) if has_motion else {}),
        time_model=data.draw(st.sampled_from(["window", "gaussian"])) if has_motion else "window",
        origin=data.draw(st.sampled_from([(0, 0, 0), (1e5 + 1 / 3, -0.1, 5e-324)])),
        coordinate_system=data.draw(st.sampled_from(["unknown", "RUB", "LFU"])),
        splat_model=data.draw(st.sampled_from(["default", "antialiased"])),
        extra={f"extra{i}": rng.integers(0, 100, count).astype(kind) for i, kind in enumerate(kinds)},
    )
    if has_motion:  # below the smallest sigma
        cloud = cloud.replace(durations=np.maximum(cloud.durations, np.float32(1e-3)))

    data_written = written(cloud)

    assert_same(ply.read(io.BytesIO(data_written)), cloud)
    assert written(ply.read(io.BytesIO(data_written))) == data_written


def test_write__is_what_plyfile_reads():
    cloud = make_cloud(50, 2, **motion(50), extra={"label": np.arange(50, dtype=np.uint8), "nx": np.ones(50, np.float32)})

    vertex = plyfile.PlyData.read(io.BytesIO(written(cloud)))["vertex"]

    assert vertex["x"].tobytes() == cloud.means[:, 0].tobytes()
    assert vertex["f_rest_9"].tobytes() == cloud.shN[:, 1, 1].tobytes()
    assert vertex["rot_0"].tobytes() == cloud.quats[:, 0].tobytes()
    assert vertex["vz"].tobytes() == cloud.velocities[:, 2].tobytes()
    assert vertex["duration"].tobytes() == cloud.durations.tobytes()
    np.testing.assert_array_equal(vertex["label"], np.arange(50))
    np.testing.assert_array_equal(vertex["nx"], 1)


def test_write__takes_chunks_of_any_size():
    pairs = np.arange(202, dtype=np.float64).reshape(101, 2)
    cloud = make_cloud(101, 3, **motion(101), extra={"label": np.arange(101, dtype=np.int16), "pair": pairs})
    sizes = [1, 40, 0, 60]
    starts = np.cumsum([0, *sizes])
    pieces = [cloud.take(slice(a, b)) for a, b in itertools.pairwise(starts)]
    chunks = CloudChunks(101, cloud.take(slice(0, 0)), lambda: iter(pieces))

    assert written(chunks) == written(cloud)
    assert written(as_chunks(cloud, 7)) == written(cloud)


def test_write__leaves_out_the_third_scale_of_flat_splats():
    cloud = make_cloud(4, 0, splat_model="2dgs")
    log_scales = cloud.log_scales.copy()
    log_scales[:, 2] = -np.inf
    flat = cloud.replace(log_scales=log_scales)

    data = written(flat)

    assert b"scale_1" in data
    assert b"scale_2" not in data
    assert_same(ply.read(io.BytesIO(data)), flat)
    with pytest.warns(LossyConversionWarning, match="that of 4 splats"):
        assert written(cloud) == data


def test_write__spells_types_that_ply_lacks():
    extra = {
        "flag": np.array([True, False]),
        "half": np.array([0.5, -2], np.float16),
        "pair": np.array([[1, 2], [3, 4]], np.int16),
    }
    cloud = make_cloud(2, 0, extra=extra)

    found = ply.read(io.BytesIO(written(cloud))).extra

    assert {name: values.dtype for name, values in found.items()} == {
        "flag": np.uint8, "half": np.float32, "pair_0": np.int16, "pair_1": np.int16,
    }  # fmt: skip
    np.testing.assert_array_equal(found["flag"], [1, 0])
    np.testing.assert_array_equal(found["half"], [0.5, -2])
    np.testing.assert_array_equal(found["pair_1"], [2, 4])
    with pytest.warns(LossyConversionWarning, match=r"id \(int64\)"):
        data = written(make_cloud(2, 0, extra={"id": np.array([1, 2])}))
    assert b" id\n" not in data


@pytest.mark.parametrize(
    "name", ["x", "scale_2", "rot_0", "f_rest_7", "f_rest_100", "vx", "t", "two words", "größe", "", "line\nbreak"]
)
def test_write__refuses_names_that_mean_something_else(name):
    with pytest.raises(CapabilityError, match="rename it"):
        written(make_cloud(2, 0, extra={name: np.zeros(2, np.float32)}))


def test_write__keeps_an_alias_of_motion_as_it_was_read():
    columns = splat_columns(2) | {"time": ("float", [0.5, 1.0]), "t": ("float", [3.0, 4.0])}
    cloud = ply.read(io.BytesIO(ply_file(PlyElement("vertex", columns))))

    again = ply.read(io.BytesIO(written(cloud)))

    np.testing.assert_array_equal(cloud.extra["t"], [3.0, 4.0])
    assert_same(again, cloud)


def test_bounds__are_zero():
    cloud = make_cloud(2, 1, **motion(2))

    bounds = ply.FORMAT.bounds(cloud, io.BytesIO(), 0)

    assert set(bounds) == {"means", "scales", "covariances", "opacities", "sh0", "shN", "velocities", "times", "durations"}
    assert not any(values.any() for values in bounds.values())
    for name in ("means", "sh0", "shN", "velocities", "times", "durations"):
        np.broadcast_to(bounds[name], cloud.arrays()[name].shape)


def test_write__says_where_the_scene_is():
    data = written(make_cloud(1, 0, origin=(0.1, -2e-7, 123456789.125), coordinate_system="RDF", splat_model="antialiased"))

    head = data[: data.index(b"element")].decode()

    assert head == (
        "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\ncomment antialiased 1\n"
        "comment coordinate_system RDF\ncomment origin 0.1 -2e-07 123456789.125\n"
    )
    assert len(data) == data.index(b"end_header\n") + 11 + struct.calcsize("<14f")
