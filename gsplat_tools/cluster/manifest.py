"""Lists of conversions: CSV with a header row, or JSON lines."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsplat_tools.cluster.state import place_of
from gsplat_tools.errors import CorruptDataError, GsplatError
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
    error
        Why its files cannot be listed, if they cannot; the target then has places for names still.
    """

    line: int
    sources: tuple[str, ...]
    target: str
    options: dict[str, Any] = field(default_factory=dict)
    error: GsplatError | None = None


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
    FileNotFoundError, ReadError
        There is no manifest, or it cannot be read.
    """
    place = Path(local_path(path))
    with open_source_file(place) as stream:
        data = stream.read()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise CorruptDataError(f"expected UTF-8 text: {error}", path=place, field=f"line {line}") from error
    first = text.lstrip()[:1]
    if first == "[":
        raise CorruptDataError(
            "expected JSON lines, one object a line, and found a list; leave out the brackets and the commas between objects",
            path=place,
            field=f"line {text[: text.index('[')].count(chr(10)) + 1}",
        )
    rows = _json_rows(text, place) if first == "{" else _csv_rows(text, place)
    expanded = [each for row in rows for each in _expanded(row)]
    if not expanded:
        raise CorruptDataError("expected at least one conversion, found none", path=place)
    lines: dict[str, int] = {}
    for row in expanded:
        target = place_of(row.target)
        if row.error is None and target in lines:
            message = f"{row.target} is the target of line {lines[target]} too; {{stem}} does not hold the folder"
            raise CorruptDataError(message, path=place, field=f"line {row.line}")
        lines[target] = row.line
    return expanded


def _csv_rows(text: str, place: Path) -> Iterator[Row]:
    """Yield the rows of a CSV file."""
    columns: list[str] | None = None
    for line, cells in _csv_cells(text, place):
        if columns is None:
            columns = [name.strip() for name in cells]
            _check_columns(columns, line, place)
            continue
        if len(cells) != len(columns):
            message = f"expected as many cells as the first line has, {len(columns)}, found {len(cells)}"
            raise CorruptDataError(message, path=place, field=f"line {line}")
        given = {name: cell.strip() for name, cell in zip(columns, cells, strict=True) if cell.strip()}
        yield _row(line, given.pop("source", None), given.pop("target", None), given, place)


def _csv_cells(text: str, place: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the line at which a row begins, and its cells; empty rows are left out."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    while True:
        line = reader.line_num + 1
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise CorruptDataError(f"expected CSV: {error}", path=place, field=f"line {line}") from error
        if any(map(str.strip, cells)):
            yield line, cells


def _check_columns(columns: list[str], line: int, place: Path) -> None:
    """Refuse a first line that does not name what is needed, each once."""
    missing = [name for name in ("source", "target") if name not in columns]
    if missing:
        message = (
            f"expected a first line with the columns source, target and names of options; {' and '.join(missing)} is missing"
        )
        raise CorruptDataError(message, path=place, field=f"line {line}")
    twice = sorted({name or "(no name)" for name in columns if columns.count(name) > 1})
    if twice:
        raise CorruptDataError(f"column {', '.join(twice)} stands there twice", path=place, field=f"line {line}")


def _json_rows(text: str, place: Path) -> Iterator[Row]:
    """Yield the rows of a file of JSON lines."""
    for line, content in enumerate(io.StringIO(text), start=1):  # not `splitlines`, which splits inside of texts too
        if not content.strip():
            continue
        try:
            given = json.loads(content)
        except (ValueError, RecursionError) as error:
            message = f"expected a JSON object on a line of its own: {error}"
            raise CorruptDataError(message, path=place, field=f"line {line}") from error
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
    if any("\0" in each for each in (*sources, target)):
        raise CorruptDataError("a name holds a zero byte", path=place, field=f"line {line}")
    return Row(line=line, sources=tuple(sources), target=target, options=options)


def _expanded(row: Row) -> Iterator[Row]:
    """Yield one row a file where the target has a place for its name; one that fails where there are no files."""
    if not any(place in row.target for place in _PLACES):
        yield row
        return
    try:
        files = frame_files(list(row.sources))
    except GsplatError as error:
        error.field = f"line {row.line} of the manifest"
        yield replace(row, error=error)
        return
    for file in files:
        named = row.target.replace("{stem}", file.stem).replace("{name}", file.name)
        yield replace(row, sources=(url_of(file) if is_url(file) else str(file),), target=named)
