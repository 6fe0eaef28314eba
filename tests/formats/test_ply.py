"""Reading PLY: every dialect gives the same arrays, and what cannot be read says why."""

from __future__ import annotations

import io
import subprocess
import sys
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.errors import (
    CorruptDataError,
    FormatError,
    GsplatError,
    GsplatWarning,
    LossyConversionWarning,
    TruncatedDataError,
)
from gsplat_tools.formats import ply
from gsplat_tools.parallel import use_jobs
from tests.builders import PlyElement, ply_file, splat_arrays, splat_columns

ENCODINGS = ["binary_little_endian", "binary_big_endian", "ascii"]


def read(data: bytes, **options):
    return ply.read(io.BytesIO(data), ply.ReadOptions(**options))


def vertex(columns, **changes):
    return PlyElement("vertex", columns, **changes)


def assert_holds(cloud, columns):
    expected = splat_arrays(columns)
    found = cloud.arrays()
    for name, values in expected.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name].view(np.uint32), values.view(np.uint32), err_msg=name)


# ---- dialects


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("sh_degree", range(5))
def test_read__gives_the_same_arrays_in_every_encoding_and_degree(encoding, sh_degree):
    columns = splat_columns(5, sh_degree)

    cloud = read(ply_file(vertex(columns), encoding=encoding))

    assert cloud.sh_degree == sh_degree
    assert_holds(cloud, columns)
    assert not cloud.extra
    assert not cloud.has_motion


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("newline", [b"\n", b"\r\n", b"\r"])
def test_read__understands_all_line_ends(encoding, newline):
    columns = splat_columns()
    columns["x"] = ("float", [struct_float(b"\n\n\n\n"), 1.0, 2.0])  # the first byte of the rows looks like a line end

    cloud = read(ply_file(vertex(columns), encoding=encoding, newline=newline, comments=["made by hand"]))

    assert_holds(cloud, columns)


def struct_float(raw: bytes) -> float:
    return float(np.frombuffer(raw, "<f4")[0])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_read__understands_mixed_types_and_their_other_names(encoding):
    columns = splat_columns(4, 1)
    kinds = ["float32", "double", "float64", "float"]
    columns = {name: (kinds[i % 4], values) for i, (name, (_, values)) in enumerate(columns.items())}
    columns["scale_0"] = ("int8", [-5, -4, -3, 127])
    columns["rot_1"] = ("uint16", [0, 1, 2, 65535])

    cloud = read(ply_file(vertex(columns), encoding=encoding))

    assert_holds(cloud, columns)


@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_read__does_not_depend_on_the_order_of_properties(data):
    columns = splat_columns(2, 2)
    columns["label"] = ("float", [3.0, 4.0])
    shuffled = {name: columns[name] for name in data.draw(st.permutations(list(columns)))}

    cloud = read(ply_file(vertex(shuffled)))

    assert_holds(cloud, columns)
    np.testing.assert_array_equal(cloud.extra["label"], [3.0, 4.0])


def test_read__skips_other_elements_and_names_them():
    columns = splat_columns(4)
    before = PlyElement("camera", {"fov": ("double", [1.0, 2.0])})
    faces = PlyElement(
        "face", {"vertex_indices": ("list uchar int", [[0, 1, 2], [], [1, 2, 3, 0]]), "flag": ("uchar", [1, 2, 3])}
    )

    for encoding in ENCODINGS:
        for elements in ([before, vertex(columns), faces], [faces, vertex(columns), before]):
            with pytest.warns(LossyConversionWarning, match=r"camera \(2 rows\).*|face \(3 rows\).*") as caught:
                cloud = read(ply_file(*elements, encoding=encoding))
            assert len(caught) == 1
            assert_holds(cloud, columns)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_read__leaves_out_lists_of_the_vertex_element(encoding):
    columns = splat_columns(3) | {"neighbors": ("list uchar short", [[1], [], [2, 3]]), "id": ("ushort", [7, 8, 9])}

    with pytest.warns(LossyConversionWarning, match="neighbors"):
        cloud = read(ply_file(vertex(columns), encoding=encoding))

    assert_holds(cloud, splat_columns(3))
    assert list(cloud.extra) == ["id"]
    np.testing.assert_array_equal(cloud.extra["id"], [7, 8, 9])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_read__keeps_other_properties_in_their_own_types(encoding):
    columns = splat_columns(3) | {
        "red": ("uchar", [0, 128, 255]),
        "weight": ("double", [1e-300, 2.5, -0.0]),
        "id": ("int", [-1, 0, 9]),
    }

    cloud = read(ply_file(vertex(columns), encoding=encoding))

    assert {name: values.dtype for name, values in cloud.extra.items()} == {
        "red": np.uint8,
        "weight": np.float64,
        "id": np.int32,
    }
    for name, values in cloud.extra.items():
        np.testing.assert_array_equal(values, columns[name][1])
        assert values.dtype.isnative


@pytest.mark.parametrize("kind", ["float", "double"])
def test_read__keeps_normals_only_where_one_is_not_zero(kind):
    columns = splat_columns(6)
    columns["ny"] = (kind, [0, 0, 0, 0, 0, 0.5])

    cloud = read(ply_file(vertex(columns)))
    chunks = ply.read_chunks(io.BytesIO(ply_file(vertex(columns)))).read()

    for found in (cloud, chunks):
        assert list(found.extra) == ["nx", "ny", "nz"]
        np.testing.assert_array_equal(found.extra["ny"], columns["ny"][1])


def test_read_chunks__counts_normals_that_the_probes_missed(monkeypatch):
    monkeypatch.setattr("gsplat_tools.formats.ply.reading._PROBES", 2)
    monkeypatch.setattr("gsplat_tools.formats.ply.reading._PROBE_ROWS", 1)
    columns = splat_columns(5)
    columns["nz"] = ("float", [0.0, 0.0, 1.0, 1.0, 0.0])
    chunks = ply.read_chunks(io.BytesIO(ply_file(vertex(columns))))

    with pytest.warns(LossyConversionWarning, match="normals of 2 of 5"):
        cloud = chunks.read()

    assert not cloud.extra
    chunks.read()  # warns once


def test_read__without_splats_is_a_cloud_without_splats():
    for encoding in ENCODINGS:
        cloud = read(ply_file(vertex(splat_columns(0, 3)), encoding=encoding))
        assert len(cloud) == 0
        assert cloud.sh_degree == 3


def test_read__keeps_nan_payloads_signs_of_zero_and_infinities():
    bits = np.array([0x7F800001, 0xFFC12345, 0x80000000, 0x7F800000, 0xFF800000, 0x00000001], np.uint32)
    columns = splat_columns(6, 1)
    order = list(columns)
    data = bytearray(ply_file(vertex(columns)))
    row = 4 * len(order)
    for i, value in enumerate(bits):
        for name in ("x", "f_rest_4", "opacity", "rot_3"):
            place = len(data) - (6 - i) * row + 4 * order.index(name)
            data[place : place + 4] = int(value).to_bytes(4, "little")

    cloud = read(bytes(data))

    for found in (cloud.means[:, 0], cloud.shN[:, 1, 1], cloud.opacity_logits, cloud.quats[:, 3]):
        np.testing.assert_array_equal(np.ascontiguousarray(found).view(np.uint32), bits)


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_read__is_the_same_from_files_streams_and_chunks(tmp_path, jobs, monkeypatch):
    monkeypatch.setattr("gsplat_tools.formats.ply.rows.BLOCK_BYTES", 5000)
    monkeypatch.setattr("gsplat_tools.formats.ply.reading.CHUNK_SIZE", 100)
    columns = splat_columns(333, 3)
    data = ply_file(vertex(columns))
    path = tmp_path / "scene.ply"
    path.write_bytes(data)

    with use_jobs(jobs), path.open("rb") as file, path.open("rb", buffering=0) as raw:
        clouds = [ply.read(stream) for stream in (file, raw, io.BytesIO(data))]
        chunks = ply.read_chunks(file)
        parts = list(chunks)
        clouds.append(chunks.read())

    assert [len(part) for part in parts] == [100, 100, 100, 33]
    for cloud in clouds:
        assert_holds(cloud, columns)


def test_rows__reads_beyond_4_gib(tmp_path):
    from gsplat_tools.formats._ply_header import read_header
    from gsplat_tools.formats.ply.rows import open_rows

    columns = splat_columns(1, 3)
    count = (5 << 30) // 248
    data = ply_file(vertex(columns, count=count))
    row = data[-248:]
    path = tmp_path / "large.ply"
    with path.open("wb") as file:
        file.write(data[:-248])
        file.seek(len(data) - 248 + 248 * (count - 1))  # all but the last row is a hole
        file.write(row)

    for buffering in (-1, 0):
        with path.open("rb", buffering=buffering) as stream:
            header = read_header(stream)
            rows = open_rows(stream, header, header.elements[0])
            assert rows.block(count - 2, count).tobytes() == bytes(248) + row


# ---- what stands in comments


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


# ---- wide positions


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


# ---- motion


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


# ---- refusals


def test_read__says_what_a_point_cloud_is():
    columns = {name: ("float", [0.0]) for name in "xyz"} | {name: ("uchar", [1]) for name in ("red", "green", "blue")}

    with pytest.raises(FormatError, match=r"lacks f_dc_0.*found x, y, z, red, green, blue.*point cloud") as caught:
        read(ply_file(vertex(columns)))

    assert caught.value.field == "vertex"
    assert caught.value.offset == len(b"ply\nformat binary_little_endian 1.0\n")


def test_read__says_what_a_mesh_and_others_are():
    xyz = {name: ("float", [0.0]) for name in "xyz"}
    faces = PlyElement("face", {"vertex_indices": ("list uchar int", [[0, 0, 0]])})
    activated = xyz | {name: ("float", [0.0]) for name in ("scale_x", "scale_y", "scale_z", "alpha")}
    packed = {name: ("uint", [0]) for name in ("packed_position", "packed_rotation", "packed_scale", "packed_color")}
    as_list = splat_columns(1) | {"opacity": ("list uchar float", [[1.0]])}

    for elements, message in [
        ([vertex(xyz), faces], "mesh"),
        ([vertex(xyz)], "point cloud"),
        ([vertex(activated)], "activated"),
        ([PlyElement("chunk", {"min_x": ("float", [0.0])}), vertex(packed)], "compressed-ply"),
        ([faces], "no element 'vertex'.*face"),
        ([vertex(as_list)], "expected scalars, found lists: opacity"),
    ]:
        with pytest.raises(FormatError, match=message):
            read(ply_file(*elements))


@pytest.mark.parametrize("count", [1, 8, 10, 44, 46, 71])
def test_read__refuses_other_counts_of_f_rest(count):
    columns = splat_columns(1) | {f"f_rest_{i}": ("float", [0.0]) for i in range(count)}

    with pytest.raises(CorruptDataError, match=f"found {count} f_rest.*0, 9, 24, 45, 72"):
        read(ply_file(vertex(columns)))


def test_read__refuses_gaps_in_f_rest():
    columns = splat_columns(1) | {f"f_rest_{i}": ("float", [0.0]) for i in [*range(8), 9]}

    with pytest.raises(CorruptDataError, match="expected f_rest_8, found f_rest_9"):
        read(ply_file(vertex(columns)))


@pytest.mark.parametrize("encoding", ENCODINGS[:2])
@pytest.mark.parametrize("lists", [False, True])
def test_read__refuses_every_length_but_the_right_one(encoding, lists):
    columns = splat_columns(3) | ({"ids": ("list uchar short", [[1], [], [2, 3]])} if lists else {})
    faces = PlyElement("face", {"vertex_indices": ("list uchar int", [[0, 1, 2], [1]])})
    data = ply_file(vertex(columns), faces, encoding=encoding)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert len(read(data)) == 3
        for length in range(len(data)):
            with pytest.raises((TruncatedDataError, CorruptDataError)):
                read(data[:length])
        with pytest.raises(CorruptDataError, match="2 bytes follow") as caught:
            read(data + b"xy")
    assert caught.value.offset == len(data)


def test_read__counts_the_bytes_that_are_missing():
    data = ply_file(vertex(splat_columns(3)))
    header = data.index(b"end_header\n") + 11

    with pytest.raises(TruncatedDataError, match=r"3 rows of 68 bytes \(204 bytes\), but 203 bytes remain") as caught:
        read(data[:-1])

    assert (caught.value.field, caught.value.offset) == ("vertex", header)


def test_read__refuses_huge_counts_before_allocating():
    for encoding in ENCODINGS:
        for count in (4_000_000_000, 10**17):
            with pytest.raises(TruncatedDataError, match=str(count)):
                read(ply_file(vertex(splat_columns(3), count=count), encoding=encoding))


def test_read__refuses_text_that_does_not_fit_the_header():
    data = ply_file(vertex(splat_columns(3)), encoding="ascii")
    lines = data.splitlines(keepends=True)

    with pytest.raises(TruncatedDataError, match="row 2 of 3"):
        read(b"".join(lines[:-1]).replace(b" ", b" " * 20))
    with pytest.raises(CorruptDataError, match="bytes of text follow"):
        read(data + b"1 2 3\n")
    with pytest.raises(CorruptDataError, match="row 2 of 3, property rot_3"):
        read(b"".join(lines[:-1]) + lines[-1].rsplit(b" ", 1)[0] + b"\n")
    with pytest.raises(CorruptDataError, match="row 2 of 3: expected end-of-line"):
        read(b"".join(lines[:-1]) + lines[-1].rstrip() + b" 5\n")
    with pytest.raises(CorruptDataError, match="row 2 of 3, property rot_3: malformed"):
        read(b"".join(lines[:-1]) + lines[-1].rsplit(b" ", 1)[0] + b" five\n")
    with pytest.raises(CorruptDataError):
        read(data[:-10] + b"\xff" * 10)
    assert len(read(data + b" \n\n")) == 3
    with pytest.warns(GsplatWarning, match="without a line end"):
        read(data[:-1])


def test_read__refuses_or_reads_whatever_a_byte_of_the_header_becomes():
    data = ply_file(vertex(splat_columns(2, 1)), comments=["origin 1 2 3"])
    length = data.index(b"end_header\n") + 11
    rng = np.random.default_rng(5)
    refused = 0

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for place in range(length):
            for value in {0, 10, 13, 32, 45, 57, 255, int(rng.integers(256))} - {data[place]}:
                changed = data[:place] + bytes([value]) + data[place + 1 :]
                try:
                    read(changed)
                except GsplatError:
                    refused += 1
    assert refused > length  # most changes matter


# ---- inspect, and the record


def test_inspect__tells_the_header_without_reading_rows():
    columns = splat_columns(3, 2) | {"vx": ("float", [0.0] * 3), "label": ("uchar", [0] * 3)}
    comments = ["antialiased 1", "coordinate_system RDF", "origin 1 2 3"]

    info = ply.inspect(io.BytesIO(ply_file(vertex(columns), comments=comments)))

    assert (info.splats, info.sh_degree, info.splat_model, info.coordinate_system) == (3, 2, "antialiased", "RDF")
    assert info.origin == (1.0, 2.0, 3.0)
    assert info.encoding["row_bytes"] == 4 * (17 + 24 + 1) + 1
    assert info.encoding["properties"]["label"] == "uint8"
    assert info.encoding["has_motion"] is True
    assert info.encoding["extras"] == ["label"]
    assert info.encoding["comments"] == comments
    with pytest.raises(TruncatedDataError):
        ply.inspect(io.BytesIO(ply_file(vertex(columns))[:-1]))


def test_inspect__loads_no_compiler(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file(vertex(splat_columns(3))))
    code = "import sys, gsplat_tools.formats.ply as p; p.inspect(open(sys.argv[1], 'rb')); sys.exit('numba' in sys.modules)"

    assert subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode == 0


def test_matches__leaves_the_packed_kind_to_its_own_format():
    packed = ply_file(PlyElement("chunk", {"min_x": ("float", [0.0])}), comments=["made by another tool"])

    assert ply.FORMAT.matches(ply_file(vertex(splat_columns()))[:64])
    assert ply.FORMAT.matches(ply_file(vertex(splat_columns()), newline=b"\r\n")[:64])
    assert not ply.FORMAT.matches(packed)
    assert not ply.FORMAT.matches(b"plywood\n")
    assert not ply.FORMAT.matches(b"")
