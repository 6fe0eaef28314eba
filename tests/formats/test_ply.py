"""Reading PLY: every dialect gives the same arrays, whole, in chunks and from any stream."""

from __future__ import annotations

import io
import subprocess
import sys

import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.errors import (
    LossyConversionWarning,
    TruncatedDataError,
)
from gsplat_tools.formats import ply
from gsplat_tools.parallel import use_jobs
from tests.builders import PlyElement, ply_file, splat_columns
from tests.formats.ply_cases import ENCODINGS, assert_holds, read, vertex


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


@settings(deadline=None, max_examples=40)
@given(values=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=4))
def test_read__parses_text_as_plyfile_does(values):
    count = len(values)
    columns = splat_columns(count) | {"x": ("float", values), "wide": ("double", values), "id": ("int", list(range(count)))}
    data = ply_file(vertex(columns), encoding="ascii")
    with np.errstate(over="ignore"):
        expected = plyfile.PlyData.read(io.BytesIO(data))["vertex"]

    cloud = read(data)

    np.testing.assert_array_equal(cloud.means[:, 0], expected["x"])
    np.testing.assert_array_equal(cloud.extra["wide"], expected["wide"])
    np.testing.assert_array_equal(cloud.extra["id"], expected["id"])
