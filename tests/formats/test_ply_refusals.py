"""What cannot be read says why, where, and by how many bytes."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from gsplat_tools.errors import (
    CorruptDataError,
    FormatError,
    GsplatError,
    GsplatWarning,
    TruncatedDataError,
)
from tests.builders import PlyElement, ply_file, splat_columns
from tests.formats.ply_cases import ENCODINGS, read, vertex


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
