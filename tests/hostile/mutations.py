"""Changes to bytes, numbers in text, and JSON values, each a pure function of its arguments."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator
from random import Random
from typing import Any

from tests.hostile.seed import Seed, Span

U32 = (0, 1, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)
NUMBERS = (
    b"0", b"1", b"-1", b"2147483647", b"2147483648", b"4294967295", b"9007199254740993", b"18446744073709551616", b"1e308",
    b"1e400", b"-0", b"0.5", b"1e-400", b"9" * 300, b"9" * 5000, b"NaN", b"nan", b"inf", b"-Infinity", b"0x10", b"", b"1_0",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3, 4, 5, 255, 256, 65535, 65536, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 53, 1 << 63,
    10**400, 0.5, -0.0, 1e308, -1e308, 1e-320, float("nan"), float("inf"), -float("inf"), "", "x", "5", "\0", "\ud800", "é" * 9,
    "a" * 5000, "../x", "/etc/passwd", "C:\\x", "{frame}", "meta.json", "\x1b[31m", [], {}, [[]], [None], [0] * 3, [0.0] * 256,
    [1, 2, 3, 4], ["a"], [{}] * 3, {"x": 0, "y": 0, "z": 0}, {"x": None}, {"": ""},
)  # fmt: skip


def systematic(seed: Seed, *, prefix_limit: int = 20_000) -> Iterator[tuple[str, bytes]]:
    """Yield (what was done, unsealed bytes): every prefix, every bit of the meta bytes, every u32 and number in them."""
    data = seed.data
    if len(data) <= prefix_limit:
        for length in range(len(data)):
            yield f"prefix {length}", data[:length]
    for span in seed.spans:
        for position in range(span.start, span.stop):
            for bit in range(8):
                changed = bytearray(data)
                changed[position] ^= 1 << bit
                yield f"bit {bit} of byte {position}", bytes(changed)
        if span.kind == "binary":
            yield from _words(data, span)
        else:
            yield from _numbers(data, span)


def count_systematic(seed: Seed) -> int:
    """Return how many cases `systematic` yields."""
    return sum(1 for _ in systematic(seed))


def _words(data: bytes, span: Span) -> Iterator[tuple[str, bytes]]:
    """Every four bytes as each of the numbers that break things, and as what they are, plus and minus 1."""
    for position in range(span.start, span.stop - 3):
        (declared,) = struct.unpack_from("<I", data, position)
        for value in (*U32, (declared + 1) & 0xFFFFFFFF, (declared - 1) & 0xFFFFFFFF):
            if value != declared:
                yield f"u32 {value} at {position}", data[:position] + struct.pack("<I", value) + data[position + 4 :]


def _numbers(data: bytes, span: Span) -> Iterator[tuple[str, bytes]]:
    """Every number in a text as each of those that break things."""
    for match in _NUMBER.finditer(data, span.start, span.stop):
        near = [str(int(match[0]) + step).encode() for step in (-1, 1)] if match[0].lstrip(b"-").isdigit() else []
        for value in (*NUMBERS, *near):
            yield f"number {value[:20]!r} at {match.start()}", data[: match.start()] + value + data[match.end() :]


def mutant(seed: Seed, rng: Random) -> bytes:
    """Return unsealed bytes with one to four changes, mostly in the meta bytes."""
    data = seed.data
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        data = _change(data, seed.spans, rng)
    return data


def _change(data: bytes, spans: tuple[Span, ...], rng: Random) -> bytes:
    if not data:
        return rng.randbytes(rng.randrange(64))
    span = rng.choice(spans) if spans and rng.random() < 0.8 else Span(0, len(data))
    stop = max(1, min(span.stop, len(data)))
    position = rng.randrange(min(span.start, stop - 1), stop)
    kind = rng.randrange(10)
    if kind <= 1:
        return data[:position] + bytes([data[position] ^ 1 << rng.randrange(8)]) + data[position + 1 :]
    if kind == 2:
        return data[:position] + rng.randbytes(rng.randint(1, 8)) + data[position + rng.randint(0, 8) :]
    if kind == 3:
        width, code = rng.choice(((2, "<H"), (4, "<I"), (8, "<Q"), (4, "<f")))
        value: Any = rng.choice((*U32, rng.getrandbits(64), len(data), len(data) + 1)) & ((1 << 8 * width) - 1)
        if code == "<f":
            value = rng.choice((float("nan"), float("inf"), -float("inf"), 3e38, 1e-40, -0.0))
        return data[:position] + struct.pack(code, value) + data[position + width :]
    if kind == 4:
        return data[:position]
    if kind == 5:
        return data[:position] + data[position + rng.randint(1, 64) :]
    if kind == 6:
        other = rng.randrange(len(data))
        return data[:position] + data[other : other + rng.randint(1, 200)] + data[position:]
    if kind == 7:
        return data + rng.choice((b"\0", rng.randbytes(40), data[position:]))
    if kind == 8 and span.kind == "text":
        return line_change(data, span, rng)
    return number_change(data, span, rng)


def number_change(data: bytes, span: Span, rng: Random) -> bytes:
    """Replace a number in a text."""
    found = list(_NUMBER.finditer(data, span.start, min(span.stop, len(data))))
    if not found:
        return data
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(NUMBERS) + data[match.end() :]


def line_change(data: bytes, span: Span, rng: Random) -> bytes:
    """Repeat, drop, swap, lengthen or break lines of a text."""
    lines = data[span.start : span.stop].split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(8)
    if kind == 0:
        lines.insert(b, lines[a])
    elif kind == 1:
        del lines[a]
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 3:
        lines[a] += b" " + rng.choice((b"x" * 5000, b"\xff\xfe", b"\0", b"list uchar int", b"\t \t"))
    elif kind == 4:
        words = lines[a].split(b" ")
        words[rng.randrange(len(words))] = rng.choice(
            (b"", b"vertex", b"list", b"float", b"double", b"uchar", b"int", b"\xff", b"x")
        )
        lines[a] = b" ".join(words)
    elif kind == 5:
        lines.insert(a, b"comment " + bytes(rng.randrange(1, 256) for _ in range(rng.randrange(40))).replace(b"\n", b""))
    elif kind == 6:
        lines.insert(a, b"element extra%d %d" % (rng.randrange(3), rng.choice((0, 1, 2, 1 << 31, 10**17))))
    else:
        lines[a] += b"\r"
    return data[: span.start] + b"\n".join(lines) + data[span.stop :]


def json_change(text: bytes, rng: Random) -> bytes:
    """Change one to three values of a JSON text, or its spelling."""
    kind = rng.randrange(24)
    if kind == 0:
        depth = rng.choice((10, 200, 300, 900, 980, 995, 1100, 100_000))
        return rng.choice((b"[" * depth, b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth))
    if kind == 1:
        return rng.choice(
            (
                b"",
                b"\xef\xbb\xbf" + text,
                b"\xff" + text,
                text + b"{}",
                b"null",
                b"[]",
                b"1",
                b'"x"',
                text.decode().encode("utf-16"),
            )
        )
    if kind == 2:
        return number_change(text, Span(0, len(text)), rng)
    root = json.loads(text)
    try:
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            _change_value(root, rng)
        return json.dumps(root).encode()
    except RecursionError:  # lists put into lists twice are too many for the encoder
        return b'{"a":' * 1500 + b"1" + b"}" * 1500


def _change_value(root: Any, rng: Random) -> None:
    """Replace, remove, repeat or add one value, anywhere below `root`."""
    places = list(_places(root))
    if not places:
        return
    parent, key = rng.choice(places)
    kind = rng.randrange(12)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, list):
        parent.insert(key, rng.choice(VALUES))
    elif kind == 1:
        parent[rng.choice(("extra", "", "count", "version", "files", str(key).upper()))] = rng.choice(VALUES)
    elif kind == 2 and isinstance(parent[key], list):
        parent[key] = parent[key] * rng.choice((0, 2, 3))
    elif kind == 3:
        parent[key] = nested(rng.choice((5, 60, 300, 700)))
    elif kind == 4:
        other, other_key = rng.choice(places)
        parent[key] = json.loads(json.dumps(other[other_key]))
    elif kind == 5 and isinstance(parent[key], int | float):
        parent[key] = parent[key] + rng.choice((-1, 1, 0.5, 1 << 32))
    else:
        parent[key] = json.loads(json.dumps(rng.choice(VALUES)))


def json_fields(text: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield every value of a JSON text removed, and as each of a few others."""
    for index, (holder, key) in enumerate(_places(json.loads(text))):
        if isinstance(holder, list) and len(holder) > 8 and key not in {0, len(holder) - 1}:
            continue  # the ends stand for the others
        for value in (..., None, True, -1, 1 << 40, 10**400, 0.5, 1e308, "x", [], {}, [1, 2, 3, 4], ["a/b", "c"], {"x": 1}):
            root = json.loads(text)
            parent = list(_places(root))[index][0]
            if value is ...:
                del parent[key]
            else:
                parent[key] = value
            yield f"{key!r} as {str(value)[:20]}", json.dumps(root).encode()


def nested(depth: int) -> Any:
    """Return lists in lists."""
    value: Any = []
    for _ in range(depth):
        value = [value]
    return value


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (container, key) of everything below a value."""
    pending = [value]
    while pending:
        node = pending.pop()
        items = list(node.items()) if isinstance(node, dict) else list(enumerate(node)) if isinstance(node, list) else []
        for key, item in items:
            yield node, key
            pending.append(item)
