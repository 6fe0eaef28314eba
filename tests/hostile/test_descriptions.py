"""Parsers of descriptions take any value and any bytes: they read them, or say what is wrong, and raise nothing else."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.errors import GsplatError
from gsplat_tools.formats import _json
from gsplat_tools.formats._label_delta import DeltaSegment, read_delta
from gsplat_tools.formats._ply_header import element_offsets, read_header
from gsplat_tools.formats._webp import parse_header
from gsplat_tools.formats.pack.description import Description
from gsplat_tools.formats.ply.layout import splat_layout
from gsplat_tools.formats.sog.meta import parse_meta as parse_sog
from gsplat_tools.formats.sog4d.meta_reader import parse_meta as parse_sog4d
from tests.formats.pack.gspk_by_hand import spark_description
from tests.formats.sog_files import version_2
from tests.sog4d_bundles import valid_meta


def is_read_or_located(run: Callable[[], object]) -> bool:
    """Whether something is read, or refused with a place; other exceptions pass."""
    try:
        run()
    except GsplatError as error:
        return error.field is not None or error.offset is not None
    return True


numbers = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just(10**400)
values = st.recursive(
    numbers, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4)
)


def changed(root: Any, path: list[int], value: Any) -> Any:
    """The value below `root` that the numbers lead to, replaced."""
    root = json.loads(json.dumps(root))
    node, last = root, None
    for step in path:
        keys = list(node) if isinstance(node, dict) else list(range(len(node))) if isinstance(node, list) else []
        if not keys:
            break
        last = node, keys[step % len(keys)]
        node = node[last[1]]
    if last is not None:
        last[0][last[1]] = value
    return root


paths = st.lists(st.integers(0, 40), min_size=1, max_size=5)


@given(paths, values)
def test_sog_meta__is_read_or_refused(path: list[int], value: Any) -> None:
    text = json.dumps(changed(json.loads(version_2(1)["meta.json"]), path, value)).encode()

    assert is_read_or_located(lambda: parse_sog(text))


@given(paths, values)
def test_sog4d_meta__is_read_or_has_an_issue(path: list[int], value: Any) -> None:
    meta, issues = parse_sog4d(json.dumps(changed(valid_meta(), path, value)).encode())

    assert meta is not None or issues
    assert all(issue.field is not None for issue in issues)


@given(paths, values)
def test_gspk_description__is_read_or_refused(path: list[int], value: Any) -> None:
    description = changed(spark_description(3, 2), path, value)

    assert is_read_or_located(lambda: Description.from_json(description))


@given(st.binary(max_size=60) | st.text(max_size=40).map(str.encode))
def test_json__is_a_value_or_a_value_error(data: bytes) -> None:
    try:
        value = _json.parse(data)
    except ValueError:
        return
    assert len(_json.shown(value)) <= 80


LINES = [
    *(
        b"format ascii 1.0",
        b"format binary_little_endian 1.0",
        b"comment origin 1 nan x",
        b"obj_info",
        b"",
        b"\xff",
        b"end_header",
    ),
    *(b"element vertex 3", b"element face 2", b"element vertex 99999999999999999999", b"property list float int j"),
    *(b"property float x", b"property list uchar int i", b"property float f_rest_0"),
]


@given(st.lists(st.sampled_from(LINES), max_size=12), st.sampled_from([b"\n", b"\r\n", b"\r"]), st.binary(max_size=30))
def test_ply_header__is_read_or_refused(lines: list[bytes], newline: bytes, body: bytes) -> None:
    stream = io.BytesIO(newline.join([b"ply", *lines, b"end_header", b""]) + body)

    def read() -> None:
        header = read_header(stream)
        splat_layout(header)
        element_offsets(header, stream)

    assert is_read_or_located(read)


@given(st.binary(max_size=60))
def test_webp_header__is_read_or_refused(tail: bytes) -> None:
    data = b"RIFF" + (len(tail) + 4).to_bytes(4, "little") + b"WEBP" + tail

    assert is_read_or_located(lambda: parse_header(data, field="x"))


@given(st.binary(max_size=80))
def test_label_delta__is_read_or_has_an_issue(tail: bytes) -> None:
    segment = DeltaSegment(field="x", start_frame=0, frame_count=3, splat_count=4, label_count=2)
    blocks, issues = read_delta(b"SPL4DLB1" + b"".join(n.to_bytes(4, "little") for n in (1, 0, 3, 4, 2)) + tail, segment)

    assert len(blocks) == 2 or issues
