"""PLY headers: dialects, places, and claims."""

from __future__ import annotations

import io
import time

import numpy as np
import pytest

from gsplat_tools.errors import CorruptDataError, LimitExceededError, TruncatedDataError
from gsplat_tools.formats._ply_header import MAX_HEADER_BYTES, element_offsets, read_header
from tests.builders import PlyElement, ply_file


def header_of(*lines: str, body: bytes = b""):
    return read_header(io.BytesIO("\n".join(["ply", *lines, "end_header", ""]).encode() + body))


def test_read_header__tells_elements_types_and_places():
    data = ply_file(
        PlyElement("a", {"p": ("uchar", [1, 2]), "q": ("float64", [1.0, 2.0])}),
        PlyElement("b", {"list_of": ("list ushort int8", [[1, 2], []])}, comments=["äöü"]),
        encoding="binary_big_endian",
        comments=["one", "two words"],
        obj_info=["kept"],
    )

    header = read_header(io.BytesIO(data))

    assert header.encoding == "binary_big_endian"
    assert header.comments == ("one", "two words", "äöü")
    assert header.obj_info == ("kept",)
    assert data[: header.size].endswith(b"end_header\n")
    a, b = header.elements
    assert (a.name, a.count, a.line_offset, a.has_lists) == ("a", 2, data.index(b"element a"), False)
    assert a.row_dtype == np.dtype([("p", "u1"), ("q", ">f8")])
    assert (b.name, b.count, b.has_lists, b.min_row_bytes) == ("b", 2, True, 2)
    assert b.properties[0].count_dtype == np.dtype(">u2")
    assert header.element("b") is b
    assert header.element("c") is None
    assert element_offsets(header, io.BytesIO(data)) == {"a": header.size, "b": header.size + 18}


def test_read_header__bears_blank_lines_spaces_and_late_obj_info():
    header = header_of(
        "format  ascii   1.0", "", "element vertex   3 ", "\tproperty  float   x", "obj_info late", "comment\tafter a tab"
    )

    assert header.encoding == "ascii"
    assert (header.elements[0].count, header.elements[0].properties[0].name) == (3, "x")
    assert header.obj_info == ("late",)
    assert header.comments == ("after a tab",)


@pytest.mark.parametrize(
    ("lines", "message", "offset"),
    [
        (["element v 1", "property float x"], "expected one of", 4),
        (["format binary 1.0"], "format 'binary'", 4),
        (["format ascii 2.0"], "version", 4),
        (["format ascii 1.0", "element v -1"], "found 'element v -1'", 21),
        (["format ascii 1.0", "element v 1_0"], "count", 21),
        (["format ascii 1.0", "element v 1e3"], "count", 21),
        (["format ascii 1.0", "element v 1234567890123456789"], "18 digits", 21),
        (["format ascii 1.0", "element v"], "NAME COUNT", 21),
        (["format ascii 1.0", "element v 1", "property quad x"], "quad", 33),
        (["format ascii 1.0", "comment ü", "element v 1", "nonsense"], "found 'nonsense'", 44),
        (["format ascii 1.0", "element v 1", "property list float int x"], "integer", None),
        (["format ascii 1.0", "element v 1", "property int x", "property int x"], "same name", 0),
        (["format ascii 1.0", "element v 1", "element v 1"], "same name", 0),
        (["format ascii 1.0", "element vü 1"], "not understood", 0),
    ],
)
def test_read_header__says_which_line_it_does_not_understand(lines, message, offset):
    with pytest.raises(CorruptDataError, match=message) as caught:
        header_of(*lines)

    assert caught.value.offset == offset


def test_read_header__refuses_what_is_no_ply_or_never_ends():
    for data in (b"PLY\n", b"plywood\n", b"gif89a", b"plx"):
        with pytest.raises(CorruptDataError, match="first line"):
            read_header(io.BytesIO(data))
    for data in (b"", b"p", b"ply", b"ply\r", b"ply\nformat ascii 1.0\nelement", b"ply\nformat ascii 1.0\nend_header"):
        with pytest.raises(TruncatedDataError):
            read_header(io.BytesIO(data))
    with pytest.raises(LimitExceededError, match="end_header"):
        read_header(io.BytesIO(b"ply\nformat ascii 1.0\n" + b"comment x\n" * (MAX_HEADER_BYTES // 10)))


def test_read_header__takes_rows_for_rows():
    # A row that looks like the end of the header, and a comment that mentions it.
    header = header_of("format ascii 1.0", "comment end_header", "element v 1", "property int x", body=b"\nend_header\n")

    assert header.elements[0].count == 1
    assert header.size == len("ply\nformat ascii 1.0\ncomment end_header\nelement v 1\nproperty int x\nend_header\n")


def test_element_offsets__walks_through_lists_longer_than_its_buffer(monkeypatch):
    monkeypatch.setattr("gsplat_tools.formats._ply_header._LIST_READ", 16)
    rng = np.random.default_rng(0)
    lists = [list(range(n)) for n in rng.integers(0, 30, 50)]
    faces = PlyElement("face", {"flag": ("double", [0.0] * 50), "ids": ("list uint short", lists)})
    tail = PlyElement("tail", {"x": ("uchar", [1, 2, 3])})

    for encoding in ("binary_little_endian", "binary_big_endian"):
        data = ply_file(faces, tail, encoding=encoding)
        header = read_header(io.BytesIO(data))
        assert element_offsets(header, io.BytesIO(data))["tail"] == len(data) - 3


def test_element_offsets__refuses_lists_of_negative_length():
    data = ply_file(PlyElement("face", {"ids": ("list char int", [[1, 2]])}))
    start = data.index(b"end_header\n") + 11
    data = data[:start] + b"\xff" + data[start + 1 :]

    with pytest.raises(CorruptDataError, match="length -1") as caught:
        element_offsets(read_header(io.BytesIO(data)), io.BytesIO(data))

    assert (caught.value.field, caught.value.offset) == ("ids", start)


@pytest.mark.parametrize("seed", range(6))
def test_element_offsets__end_lists_whatever_rows_repeat(seed: int) -> None:
    # Runs of rows alike are skipped at once, here across reads of the file too.
    rng = np.random.default_rng(seed)
    header = b"ply\nformat binary_little_endian 1.0\nelement face %d\nproperty list uchar short a\nproperty uchar b\n"
    header += b"property list ushort uchar c\nelement vertex 0\nproperty float x\nend_header\n"
    rows = []
    while len(rows) < 200_000:
        a, c = (int(n) for n in rng.integers(0, 3, 2))
        row = bytes([a]) + bytes(2 * a) + b"\7" + bytes([c, 0]) + bytes(c)
        rows += [row] * int(rng.choice([1, 2, 130, 300, 30_000]))
    body = b"".join(rows)
    whole = header.replace(b"%d", b"%d" % len(rows)) + body
    stream = io.BytesIO(whole)

    offsets = element_offsets(read_header(stream), stream)

    assert offsets == {"face": len(whole) - len(body), "vertex": len(whole)}


def test_element_offsets__of_many_empty_lists_take_no_time() -> None:
    count = 3_000_000
    header = b"ply\nformat binary_little_endian 1.0\nelement face %d\nproperty list uchar int a\nend_header\n" % count
    stream = io.BytesIO(header + bytes(count))
    parsed = read_header(stream)

    start = time.process_time()
    element_offsets(parsed, stream)

    assert time.process_time() - start < 0.5
