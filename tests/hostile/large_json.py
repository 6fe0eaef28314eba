"""Descriptions of few kB in an archive that take far more memory once they are parsed: just below the limit, and far above."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from random import Random
from typing import Any

from tests.hostile.archives import Entry, zip_file


def large_texts() -> Iterator[tuple[str, str]]:
    """Yield values of JSON that are large, and what they are."""
    # What does not compress keeps the rest within 1,024 times its size.
    start = Random(1).randbytes(40_000).hex()
    for what, head in {"one byte": "", "four bytes": "\U0001f600"}.items():
        for size in (5, 12, 61):
            yield f"{size} MiB in a string, {what} a character", f'"{head}{start}{"a" * (size << 20)}"'
    yield "an escaped character after 5 MiB", f'"{start}{"a" * (5 << 20)}\\ud83d\\ude00"'
    yield "560,000 objects", "[" + ",".join(['{"a":1}'] * 560_000) + "]"
    for number in (200_000, 1_300_000):
        yield f"{number} names", "{" + ",".join(f'"{i:x}":1' for i in range(number)) + "}"
    yield "1,300,000 strings", "[" + ",".join(f'"{i:x}"' for i in range(1_300_000)) + "]"
    yield "300,000 nulls in lists", "[" + ",".join(["[null]"] * 300_000) + "]"
    yield "700,000 numbers", "[" + ",".join(["1.5"] * 700_000) + "]"


def in_archives(meta: Mapping[str, Any], files: Mapping[str, bytes]) -> list[tuple[str, bytes]]:
    """Return archives whose meta.json holds such a value in a field that nobody reads."""
    described = json.dumps(meta).removesuffix("}")
    others = [Entry(name.encode(), data) for name, data in files.items() if name != "meta.json"]
    return [
        (
            f"meta.json with {what}",
            zip_file([Entry(b"meta.json", f'{described}, "unknown": {text}}}'.encode(), method=8), *others]),
        )
        for what, text in large_texts()
    ]


@cache
def large_bundles(format_id: str) -> list[tuple[str, bytes]]:
    """Return the archives of SOG or .sog4d; packing them takes seconds."""
    from tests import sog4d_bundles
    from tests.formats.sog_files import version_2

    sources: dict[str, Callable[[], list[tuple[str, bytes]]]] = {
        "sog": lambda: in_archives(json.loads(version_2(0)["meta.json"]), version_2(0)),
        "sog4d": lambda: in_archives(sog4d_bundles.valid_meta(), sog4d_bundles.valid_files()),
    }
    return sources[format_id]()
