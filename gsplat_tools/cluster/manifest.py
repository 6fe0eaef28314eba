"""Lists of conversions: CSV with a header row, or JSON lines."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats._files import open_source_file
from gsplat_tools.formats._stores import is_url, local_path, url_of
from gsplat_tools.formats.sequences import frame_files

_PLACES = ("{stem}", "{name}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One conversion of a manifest.

    Parameters
    ----------
    line
        Line of the manifest, from 1.
    sources
        One file, or the frames of a sequence.
    target
        What is written.
    options
        By the names of the flags, without dashes before them.
    """

    line: int
    sources: tuple[str, ...]
    target: str
    options: dict[str, Any] = field(default_factory=dict)


def read_manifest(path: str | Path) -> list[Row]:
    """Return the conversions of a manifest.

    Parameters
    ----------
    path
        File or URL. CSV with the columns source, target and names of options; or, where the first character is {, JSON
        lines with "source" (text or a list), "target" and "options" (an object). Relative names are relative to the
        working directory. Where the target holds {stem} or {name}, the source is a pattern and every file that matches is
        a conversion of its own; else several files are the frames of one sequence.

    Raises
    ------
    CorruptDataError
        A line is not as described, or two conversions have one target; the line is named.
    CapabilityError
        A pattern matches nothing.
    """
    place = Path(local_path(path))
    with open_source_file(place) as stream:
        data = stream.read()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorruptDataError(f"expected UTF-8 text: {error}", path=place, offset=error.start) from error
    rows = _json_rows(text, place) if text.lstrip().startswith("{") else _csv_rows(text, place)
    expanded = [each for row in rows for each in _expanded(row)]
    if not expanded:
        raise CorruptDataError("expected at least one conversion, found none", path=place)
    lines: dict[str, int] = {}
    for row in expanded:
        target = str(local_path(row.target))
        if target in lines:
            message = f"{row.target} is the target of line {lines[target]} too; {{stem}} does not hold the folder"
            raise CorruptDataError(message, path=place, field=f"line {row.line}")
        lines[target] = row.line
    return expanded


def _csv_rows(text: str, place: Path) -> Iterator[Row]:
    """Yield the rows of a CSV file."""
    reader = csv.DictReader(text.splitlines(), strict=True)
    try:
        for cells in reader:
            line = reader.line_num
            if None in cells or None in cells.values():
                raise CorruptDataError("expected as many cells as the first line has", path=place, field=f"line {line}")
            given = {name.strip(): value.strip() for name, value in cells.items() if value.strip()}
            if given:
                yield _row(line, given.pop("source", None), given.pop("target", None), given, place)
    except csv.Error as error:
        raise CorruptDataError(f"expected CSV: {error}", path=place, field=f"line {reader.line_num}") from error


def _json_rows(text: str, place: Path) -> Iterator[Row]:
    """Yield the rows of a file of JSON lines."""
    for line, content in enumerate(text.splitlines(), start=1):
        if not content.strip():
            continue
        try:
            given = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise CorruptDataError(f"expected a JSON object: {error}", path=place, field=f"line {line}") from error
        if not isinstance(given, dict) or not isinstance(given.get("options", {}), dict):
            raise CorruptDataError("expected an object with source, target and options", path=place, field=f"line {line}")
        unknown = sorted(set(given) - {"source", "target", "options"})
        if unknown:
            raise CorruptDataError(f"{', '.join(unknown)} belongs into options", path=place, field=f"line {line}")
        yield _row(line, given.get("source"), given.get("target"), given.get("options", {}), place)


def _row(line: int, source: Any, target: Any, options: dict[str, Any], place: Path) -> Row:
    """Return a row after a look at its types."""
    sources = [source] if isinstance(source, str) else source
    is_list = isinstance(sources, list) and sources and all(isinstance(each, str) and each for each in sources)
    if not is_list or not isinstance(target, str) or not target:
        raise CorruptDataError("expected a source and a target", path=place, field=f"line {line}")
    return Row(line=line, sources=tuple(sources), target=target, options=options)


def _expanded(row: Row) -> Iterator[Row]:
    """Yield one row a file where the target has a place for its name."""
    if not any(place in row.target for place in _PLACES):
        yield row
        return
    for file in frame_files(list(row.sources)):
        named = row.target.replace("{stem}", file.stem).replace("{name}", file.name)
        yield Row(line=row.line, sources=(url_of(file) if is_url(file) else str(file),), target=named, options=row.options)
