"""Descriptions that take far more memory than their bytes: estimated before they are parsed, and refused."""

from __future__ import annotations

import io
import json
from functools import partial

import pytest

from gsplat_tools.errors import FormatError
from gsplat_tools.formats import FORMATS, _json, use_max_memory
from tests.formats.test_hostile_archives import peak
from tests.hostile.large_json import large_bundles


def test_json__is_taken_up_to_its_limits() -> None:
    deep = b"[" * _json.MAX_DEPTH + b"]" * _json.MAX_DEPTH
    assert _json.parse(deep)
    assert _json.parse(b"\xef\xbb\xbf[1]") == [1]
    for text in (b"[" + deep + b"]", b"[" * 100_000, b"[" + b"[]," * 2_000_000 + b"[]]", b'"' + b" " * (65 << 20) + b'"'):
        with pytest.raises(ValueError, match=r"inside each other|too many"):
            _json.parse(text)


def test_json_of_100_000_frames__is_taken() -> None:
    vector = {"x": -1.2345678901, "y": 0.123456789, "z": 1e-9}
    text = json.dumps({"rangeMin": [vector] * 100_000, "rangeMax": [vector] * 100_000, "times": [0.12345] * 100_000})

    # The frames themselves take at least a kB each.
    assert len(_json.parse(text.encode(), available=100_000 << 10)["rangeMin"]) == 100_000
    with pytest.raises(ValueError, match="--max-memory"):
        _json.parse(text.encode())
    with use_max_memory(1 << 30):
        assert _json.parse(text.encode())


def test_json_of_20_000_frames__is_taken_whatever_the_frames_take() -> None:
    vector = {"x": -1.2345678901, "y": 0.123456789, "z": 1e-9}
    text = json.dumps({"rangeMin": [vector] * 20_000, "rangeMax": [vector] * 20_000, "times": [0.12345] * 20_000})

    assert _json.parse(text.encode())


LARGE = {
    "string": '"' + "a" * (1 << 20) + '"',
    "wide string": '"\U0001f600' + "a" * (1 << 20) + '"',
    "string of two bytes a character": '"\u4e00' + "a" * (1 << 20) + '"',
    "late wide string": '"' + "a" * (1 << 20) + '\U0001f600"',
    "escaped": '"' + "a" * (1 << 20) + '\\ud83d\\ude00"',
    "escapes": '"' + "aa\\n" * (1 << 18) + '\\u4e00"',
    "objects": "[" + ",".join(['{"a":1}'] * 100_000) + "]",
    "empty objects": "[" + ",".join(["{}"] * 100_000) + "]",
    "lists": "[" + ",".join(["[0]"] * 100_000) + "]",
    "names": "{" + ",".join(f'"{i:x}":1' for i in range(175_000)) + "}",  # just after an object has grown
    "objects with names of their own": "[" + ",".join(f'{{"{i:x}":1}}' for i in range(100_000)) + "]",
    "objects of six": "[" + ",".join(['{"a":1,"b":1,"c":1,"d":1,"e":1,"f":1}'] * 50_000) + "]",
    "strings": "[" + ",".join(f'"{i:x}"' for i in range(100_000)) + "]",
    "numbers": "[" + ",".join(["1.5"] * 100_000) + "]",
}


@pytest.mark.parametrize("text", LARGE.values(), ids=LARGE.keys())
def test_memory_of_json__is_not_underestimated(text: str) -> None:
    data = text.encode()

    allocated = peak(lambda: json.loads(data.decode()))

    assert len(data) + allocated <= _json.memory_of(data) * 1.01


@pytest.mark.parametrize("format_id", ["sog", "sog4d"])
def test_large_description__is_refused_before_it_takes_memory(format_id: str) -> None:
    outcomes = set()

    def inspect(data: bytes) -> None:
        try:
            FORMATS[format_id].inspect(io.BytesIO(data))
        except FormatError as error:
            outcomes.add("--max-memory" in str(error))
        else:
            outcomes.add("read")

    for _, data in large_bundles(format_id):
        assert peak(partial(inspect, data)) < _json.ALWAYS_READ + (8 << 20)
    assert outcomes == {"read", True}
