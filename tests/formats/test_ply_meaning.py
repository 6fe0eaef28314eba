"""What a PLY says beyond its columns: models, places, axes, wide positions, motion."""

from __future__ import annotations

import io

import numpy as np
import pytest

from gsplat_tools.errors import (
    CorruptDataError,
    LossyConversionWarning,
)
from gsplat_tools.formats import ply
from tests.builders import ply_file, splat_columns
from tests.formats.ply_cases import ENCODINGS, assert_holds, read, vertex


@pytest.mark.parametrize(
    ("comments", "model"),
    [
        ([], "default"),
        (["SplatRenderMode: mip"], "antialiased"),
        (["SplatRenderMode: default"], "default"),
        (["antialiased 1"], "antialiased"),
        (["antialiased 0"], "default"),
        (["antialiased 1", "SplatRenderMode: default"], "default"),
        (["antialiased by hand", "Übergröße"], "default"),
    ],
)
def test_read__takes_the_splat_model_from_comments(comments, model):
    assert read(ply_file(vertex(splat_columns()), comments=comments)).splat_model == model
    assert read(ply_file(vertex(splat_columns(), comments=comments))).splat_model == model


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_read__takes_two_scales_for_flat_splats(encoding):
    columns = splat_columns(3, 1)
    del columns["scale_2"]

    cloud = read(ply_file(vertex(columns), encoding=encoding, obj_info=["num_cols 3"]))

    assert cloud.splat_model == "2dgs"
    assert (cloud.log_scales[:, 2] == -np.inf).all()
    assert_holds(cloud, columns | {"scale_2": ("float", [-np.inf] * 3)})


def test_read__takes_origin_and_axes_from_comments():
    comments = ["origin 512345.125 -5.5e3 0.1", "coordinate_system RUB", "origin of the scene", "coordinate_system unclear"]

    cloud = read(ply_file(vertex(splat_columns()), comments=comments))

    np.testing.assert_array_equal(cloud.origin, [512345.125, -5500.0, 0.1])
    assert cloud.coordinate_system == "RUB"
    with pytest.raises(CorruptDataError, match="three finite numbers"):
        read(ply_file(vertex(splat_columns()), comments=["origin 1 nan 2"]))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_read__subtracts_an_origin_from_double_positions(encoding):
    rng = np.random.default_rng(1)
    world = np.array([512345.678, 5403210.123, 120.5]) + rng.uniform(-50, 50, (40, 3))
    world[7] = np.nan
    columns = splat_columns(40) | {name: ("double", world[:, i].tolist()) for i, name in enumerate("xyz")}

    cloud = read(ply_file(vertex(columns), encoding=encoding, comments=["origin 1000 0 -3"]))

    found = cloud.origin + cloud.means.astype(np.float64) - [1000, 0, -3]
    finite = np.arange(40) != 7
    assert np.isnan(found[7]).all()
    # Half a float32 step of at most 100 units, and of the float64 sums.
    assert np.abs(found - world)[finite].max() <= 2.0**-18 + 2.0**-29
    assert np.abs(world - world.astype(np.float32))[finite].max() > 0.1  # what plain narrowing would have cost


@pytest.mark.parametrize("kind", ["double", "int"])
def test_read__leaves_wide_positions_alone_that_float32_holds(kind):
    columns = splat_columns(4)
    values = {"x": [0.25, 1e6, -3.0, 7.0], "y": [1.0, 2.0, 3.0, 4.0], "z": [0.0, 0.0, 0.0, -1.0]}
    columns |= {name: (kind, [int(v) for v in column] if kind == "int" else column) for name, column in values.items()}

    cloud = read(ply_file(vertex(columns)))

    assert not cloud.origin.any()
    assert_holds(cloud, columns)


def test_read__turns_doubles_beyond_float32_infinite():
    columns = splat_columns(2)
    columns["f_dc_0"] = ("double", [1e300, 1.0])
    columns["y"] = ("double", [1e300, 0.1])

    cloud = read(ply_file(vertex(columns)))

    assert cloud.sh0[0, 0] == np.inf
    assert cloud.means[0, 1] == np.inf
    assert np.isfinite(cloud.sh0[1]).all()
    assert abs(cloud.origin[1] + cloud.means[1, 1] - 0.1) < 1e-8  # the other one is where it was


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    "names", [("vx", "vy", "vz", "time", "duration"), ("velocity_x", "velocity_y", "velocity_z", "t", "dt")]
)
def test_read__knows_both_spellings_of_motion(encoding, names):
    values = [[1.0, -2.0], [0.5, 0.25], [3.0, 4.0], [0.0, 0.75], [1.0, 0.125]]
    columns = splat_columns(2) | {name: ("float", column) for name, column in zip(names, values, strict=True)}

    cloud = read(ply_file(vertex(columns), encoding=encoding))

    np.testing.assert_array_equal(cloud.velocities, np.transpose(values[:3]))
    np.testing.assert_array_equal(cloud.times, values[3])
    np.testing.assert_array_equal(cloud.durations, values[4])
    assert cloud.time_model == "window"
    assert not cloud.extra


@pytest.mark.parametrize(("name", "attribute"), [("vy", "velocities"), ("t", "times"), ("duration", "durations")])
def test_read__fills_in_the_motion_that_is_missing(name, attribute):
    cloud = read(ply_file(vertex(splat_columns(2) | {name: ("double", [0.5, 0.25])})))

    expected = {"velocities": np.zeros((2, 3)), "times": np.zeros(2), "durations": np.ones(2)}
    if attribute == "velocities":
        expected[attribute][:, 1] = [0.5, 0.25]
    else:
        expected[attribute] = np.array([0.5, 0.25])
    for key, values in expected.items():
        np.testing.assert_array_equal(getattr(cloud, key), values)


def motion_file(times, durations, comments=()):
    columns = splat_columns(len(times)) | {"time": ("float", times), "duration": ("float", durations)}
    return ply_file(vertex(columns), comments=comments)


def test_read__clamps_windows_once_with_counts_and_range(monkeypatch):
    monkeypatch.setattr("gsplat_tools.formats.ply.reading.CHUNK_SIZE", 2)
    data = motion_file([-0.5, 0.5, 1.5, np.nan, np.inf], [1.0, -2.0, 0.5, 0.5, 0.5])
    message = r"changed 3 times \(found -0.5 to 1.5\) and 1 durations \(found -2 to -2\) of 5 splats"

    with pytest.warns(LossyConversionWarning, match=message) as caught:
        cloud = read(data)
    chunks = ply.read_chunks(io.BytesIO(data))
    with pytest.warns(LossyConversionWarning, match=message) as caught_again:
        in_chunks = chunks.read()
    chunks.read()  # warns once

    assert len(caught) == len(caught_again) == 1
    for found in (cloud, in_chunks):
        np.testing.assert_array_equal(found.times, [0.0, 0.5, 1.0, np.nan, 1.0])
        np.testing.assert_array_equal(found.durations, [1.0, 0.0, 0.5, 0.5, 0.5])


def test_read__repairs_gaussians_in_time():
    data = motion_file([-0.5, np.nan, np.inf], [0.0, 0.25, np.nan])

    with pytest.warns(LossyConversionWarning, match=r"changed 2 times \(not finite\) and 2 durations"):
        cloud = read(data, time_model="gaussian")

    assert cloud.time_model == "gaussian"
    np.testing.assert_array_equal(cloud.times, [-0.5, 0.0, 0.0])
    np.testing.assert_array_equal(cloud.durations, np.array([1e-6, 0.25, 1.0], np.float32))


def test_read__takes_the_time_model_from_the_file_unless_told_otherwise():
    data = motion_file([0.5], [0.5], ["time_model gaussian"])

    assert read(data).time_model == "gaussian"
    assert read(data, time_model="window").time_model == "window"
