"""Old spellings of meta.json into today's: what the fork's `normalize-meta` is for, without a second meta.json."""

from __future__ import annotations

import json
from typing import Any, BinaryIO

from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats import _json
from gsplat_tools.formats._issues import raise_errors
from gsplat_tools.formats._zip import ZipReader, ZipWriter
from gsplat_tools.formats.sog4d.bundle import REPEATABLE
from gsplat_tools.formats.sog4d.meta_reader import parse_meta
from gsplat_tools.formats.sog4d.rules import RULES

_VECTORS = (("position", "rangeMin"), ("position", "rangeMax"), ("scale", "codebook"))


def repair(source: BinaryIO, target: BinaryIO) -> list[str]:
    """Write a bundle again with a meta.json that every reader takes; all other entries keep their bytes.

    Parameters
    ----------
    source
        The bundle; can seek.
    target
        The repaired bundle.

    Returns
    -------
    list of str
        What was repaired.

    Raises
    ------
    CorruptDataError
        There is no meta.json that could be repaired, or more is wrong with it than its spelling.
    """
    archive = ZipReader(source, repeatable=REPEATABLE)
    if "meta.json" not in archive:
        raise CorruptDataError("there is no meta.json to repair", field="meta.json")
    data, changes = _respelled(archive)
    raise_errors(parse_meta(data, archive.length)[1], RULES)
    num_doubles = len(archive.issues)
    if num_doubles:
        changes.append(f"entries that occurred more than once kept as the last one ({num_doubles} remarks on the archive)")
    with ZipWriter(target) as writer:
        for name in sorted(archive.names):
            if name == "meta.json":
                writer.add(name, data, "deflated")
            else:
                writer.add(name, archive.read(name), "stored" if archive.method(name) == "stored" else "deflated")
    return changes


def _respelled(archive: ZipReader) -> tuple[bytes, list[str]]:
    """Return today's meta.json and what was changed; the values are gone once there is a text of them."""
    try:
        root = _json.parse(archive.description("meta.json"), available=archive.length)
    except ValueError as error:
        raise CorruptDataError(f"expected a JSON object ({error})", field="meta.json") from error
    if not isinstance(root, dict):
        raise CorruptDataError(f"expected a JSON object, found {type(root).__name__}", field="meta.json")
    changes = _respell(root)
    return json.dumps(root, separators=(",", ":")).encode(), changes  # escaped: halves of surrogate pairs have no UTF-8


def _respell(root: dict[str, Any]) -> list[str]:
    """Change an old meta.json in place; return what was changed."""
    changes = []
    if root.get("format") is None:
        root["format"] = "sog4d"
        changes.append("added the missing field format")
    num_nulls = _drop_nulls(root)
    if num_nulls:
        changes.append(f"removed {num_nulls} fields that are null")
    streams = root.get("streams")
    for stream, name in _VECTORS:
        parent = streams.get(stream) if isinstance(streams, dict) else None
        values = parent.get(name) if isinstance(parent, dict) else None
        if not isinstance(values, list):
            continue
        lists = [i for i, value in enumerate(values) if isinstance(value, list) and len(value) == 3]
        for i in lists:
            values[i] = dict(zip("xyz", values[i], strict=True))
        if lists:
            changes.append(f"{len(lists)} vectors of {stream}.{name} turned from lists into objects")
    return changes


def _drop_nulls(value: Any) -> int:
    """Remove fields that are null, at any depth; return how many."""
    if isinstance(value, list):
        return sum(map(_drop_nulls, value))
    if not isinstance(value, dict):
        return 0
    nulls = [name for name, item in value.items() if item is None]
    for name in nulls:
        del value[name]
    return len(nulls) + sum(map(_drop_nulls, value.values()))
