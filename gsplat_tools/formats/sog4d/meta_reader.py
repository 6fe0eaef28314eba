"""meta.json read field by field: every rule that it breaks becomes an issue that names the field."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats import _json
from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats._webp import MAX_SIDE
from gsplat_tools.formats._zip import is_relative_name
from gsplat_tools.formats.sog4d.meta import AXES, FRAME_TOKEN, Float32, Meta, PaletteMeta, Segment
from gsplat_tools.formats.sog4d.rules import BAND_COEFFICIENTS, MAX_PALETTE, SH0_ENTRIES
from gsplat_tools.ops.visibility import tolerance_from_json


def parse_meta(data: bytes, available: int = 0) -> tuple[Meta | None, list[Issue]]:
    """Return what meta.json says, or None where an error forbids it, and everything that is wrong with it.

    Parameters
    ----------
    data
        The file.
    available
        Bytes of its archive, which bound the memory that it may take.
    """
    issues: list[Issue] = []
    try:
        root = _json.parse(data, available=available)
    except UnicodeDecodeError as error:
        issue = Issue(
            code="meta-encoding", message=f"expected UTF-8, found {error.reason}", field="meta.json", offset=error.start
        )
        return None, [issue]
    except ValueError as error:
        return None, [Issue(code="meta-json", message=f"expected a JSON object ({error})", field="meta.json")]
    if not isinstance(root, dict):
        message = f"expected a JSON object, found {type(root).__name__}"
        return None, [Issue(code="meta-json", message=message, field="meta.json")]
    reader = _Reader(issues)
    try:
        meta = reader.meta(root)
    except _MissingError:
        meta = None
    issues.extend(_nulls(root))
    return meta if meta is not None and not reader.failed else None, issues


class _MissingError(Exception):
    """A field that everything else needs is not there; the issue has been noted."""


class _Reader:
    """Takes fields out of JSON values and notes what is wrong with them."""

    def __init__(self, issues: list[Issue]) -> None:
        self.issues = issues
        self.failed = False

    def fail(self, code: str, field: str, message: str, **where: Any) -> None:
        self.failed = True
        self.issues.append(Issue(code=code, field=f"meta.json {field}", message=message, **where))

    def get(self, parent: dict[str, Any], path: str, name: str, kind: type | tuple[type, ...], what: str) -> Any:
        """Return a required field of a type, or raise `_MissingError`."""
        field = f"{path}.{name}" if path else name
        if parent.get(name) is None:
            self.fail("missing-field", field, f"expected {what}, found nothing; every bundle needs this field")
            raise _MissingError
        value = parent[name]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            self.fail("wrong-type", field, f"expected {what}, found {_brief(value)}")
            raise _MissingError
        return value

    def optional(self, read: Any, *arguments: Any) -> Any:
        """Return what `read` gives, or None where a field is missing, so that the rest is still checked."""
        try:
            return read(*arguments)
        except _MissingError:
            return None

    def meta(self, root: dict[str, Any]) -> Meta:
        if self.get(root, "", "format", str, '"sog4d"') != "sog4d":
            self.fail("format", "format", f'expected "sog4d", found {_brief(root["format"])}')
            raise _MissingError
        version = self.get(root, "", "version", int, "1 or 2")
        if version not in {1, 2}:
            self.fail("version", "version", f"expected 1 or 2, found {version}", value=version)
            raise _MissingError
        counts = [self.get(root, "", name, int, "a count") for name in ("splatCount", "frameCount")]
        for name, count in zip(("splatCount", "frameCount"), counts, strict=True):
            if count <= 0:
                self.fail("count", name, f"expected at least 1, found {count}", value=count)
        if self.failed:
            raise _MissingError
        splats, frames = counts
        times = self.optional(self._times, root, frames)
        layout = self.optional(self._layout, root, splats)
        streams = self.get(root, "", "streams", dict, "an object of streams")
        position = self.optional(self._position, streams, frames)
        scale = self.optional(self._scale, streams)
        rotation = self.optional(self._rotation, streams)
        sh = self.optional(self._sh, streams, version, frames)
        generator = root.get("generator")
        if layout is None or position is None or scale is None or rotation is None or sh is None or self.failed:
            raise _MissingError
        return Meta(
            version=version,
            splat_count=splats,
            frame_count=frames,
            frame_times=times,
            width=layout[0],
            height=layout[1],
            range_min=position[0],
            range_max=position[1],
            position_hi_path=position[2],
            position_lo_path=position[3],
            scale_codebook=scale[0],
            scale_indices_path=scale[1],
            rotation_path=rotation,
            bands=sh[0],
            sh0_path=sh[1],
            sh0_codebook=sh[2],
            palettes=sh[3],
            generator=generator if isinstance(generator, str) else None,
            tolerance=tolerance_from_json(root.get("visualTolerance")),
        )

    def _times(self, root: dict[str, Any], frames: int) -> NDArray[np.float64] | None:
        mapping = self.get(root, "", "timeMapping", dict, "an object")
        kind = self.get(mapping, "timeMapping", "type", str, '"uniform" or "explicit"')
        if kind == "uniform":
            return None
        if kind != "explicit":
            self.fail("time-type", "timeMapping.type", f'expected "uniform" or "explicit", found {_brief(kind)}')
            return None
        field = "timeMapping.frameTimesNormalized"
        times = self.numbers(self.get(mapping, "timeMapping", "frameTimesNormalized", list, "a list of times"), field)
        if len(times) != frames:
            self.fail("time-length", field, f"expected {frames} times, one a frame, found {len(times)}", value=len(times))
            return None
        outside = ~(np.isfinite(times) & (times >= 0) & (times <= 1))
        falls = np.concatenate([[False], np.diff(times) < 0])
        for is_bad, rule in (
            (outside, "a finite time in [0, 1]"),
            (falls & ~outside, "a time not before that of the last frame"),
        ):
            if is_bad.any():
                frame = int(np.argmax(is_bad))
                self.fail(
                    "time-value", field, f"expected {rule}, found {times[frame]}",
                    frame=frame, value=float(times[frame]), count=int(is_bad.sum()),
                )  # fmt: skip
        return times

    def _layout(self, root: dict[str, Any], splats: int) -> tuple[int, int] | None:
        layout = self.get(root, "", "layout", dict, "an object")
        kind = self.get(layout, "layout", "type", str, '"row-major"')
        if kind != "row-major":
            self.fail("layout-type", "layout.type", f'expected "row-major", found {_brief(kind)}')
        width = self.get(layout, "layout", "width", int, "a number of pixels")
        height = self.get(layout, "layout", "height", int, "a number of pixels")
        if width <= 0 or height <= 0:
            self.fail("layout-type", "layout", f"expected positive sides, found {width} x {height}")
        elif width > MAX_SIDE or height > MAX_SIDE:
            self.fail("layout-limit", "layout", f"expected sides of at most {MAX_SIDE} pixels, found {width} x {height}")
        elif width * height < splats:
            self.fail("layout-small", "layout", f"expected at least {splats} pixels, found {width} x {height}")
        return width, height

    def _position(self, streams: dict[str, Any], frames: int) -> tuple[Float32, Float32, str, str] | None:
        stream = self.get(streams, "streams", "position", dict, "an object")
        path = "streams.position"
        ranges = []
        for name in ("rangeMin", "rangeMax"):
            values = self.vectors(self.get(stream, path, name, list, "a list of vectors"), f"{path}.{name}")
            if len(values) != frames:
                message = f"expected {frames} vectors, one a frame, found {len(values)}"
                self.fail("range-length", f"{path}.{name}", message, value=len(values))
                raise _MissingError
            ranges.append(values)
        low, high = ranges
        is_bad = ~(np.isfinite(low) & np.isfinite(high) & (low <= high))
        if is_bad.any():
            frame, axis = (int(i) for i in np.argwhere(is_bad)[0])
            self.fail(
                "range-value", f"{path}.rangeMin[{frame}].{AXES[axis]}",
                f"expected a finite range with min <= max, found {low[frame, axis]} to {high[frame, axis]}",
                frame=frame, value=float(low[frame, axis]), count=int(is_bad.any(axis=1).sum()),
            )  # fmt: skip
        return low, high, self.template(stream, path, "hiPath"), self.template(stream, path, "loPath")

    def _scale(self, streams: dict[str, Any]) -> tuple[Float32, str] | None:
        stream = self.get(streams, "streams", "scale", dict, "an object")
        path = "streams.scale"
        codebook = self.vectors(self.get(stream, path, "codebook", list, "a list of vectors"), f"{path}.codebook")
        if len(codebook) == 0:
            self.fail("codebook-empty", f"{path}.codebook", "expected at least one vector, found none")
        is_bad = ~(np.isfinite(codebook) & (codebook >= 0))
        if is_bad.any():
            entry, axis = (int(i) for i in np.argwhere(is_bad)[0])
            self.fail(
                "codebook-value", f"{path}.codebook[{entry}].{AXES[axis]}",
                f"expected a finite scale of at least 0, found {codebook[entry, axis]}",
                value=float(codebook[entry, axis]), count=int(is_bad.sum()),
            )  # fmt: skip
        return codebook, self.template(stream, path, "indicesPath")

    def _rotation(self, streams: dict[str, Any]) -> str:
        return self.template(self.get(streams, "streams", "rotation", dict, "an object"), "streams.rotation", "path")

    def _sh(self, streams: dict[str, Any], version: int, frames: int) -> tuple[int, str, Float32, tuple[PaletteMeta, ...]]:
        stream = self.get(streams, "streams", "sh", dict, "an object")
        path = "streams.sh"
        bands = self.get(stream, path, "bands", int, "0 to 3")
        if not 0 <= bands <= 3:
            self.fail("bands", f"{path}.bands", f"expected 0 to 3, found {bands}", value=bands)
            raise _MissingError
        sh0_path = self.template(stream, path, "sh0Path")
        field = f"{path}.sh0Codebook"
        with np.errstate(over="ignore"):  # refused below
            codebook = self.numbers(self.get(stream, path, "sh0Codebook", list, "256 numbers"), field).astype(np.float32)
        if len(codebook) != SH0_ENTRIES:
            self.fail(
                "sh0-codebook-length", field, f"expected {SH0_ENTRIES} numbers, found {len(codebook)}", value=len(codebook)
            )
        elif not np.isfinite(codebook).all():
            entry = int(np.argmin(np.isfinite(codebook)))
            self.fail("sh0-codebook-value", f"{field}[{entry}]", f"expected a finite number, found {codebook[entry]}")
        palettes = []
        if bands > 0 and version == 1:
            palettes.append(self._palette(stream, path, "shN", (bands + 1) ** 2 - 1, frames, prefix="shN"))
        elif bands > 0:
            for band in range(1, bands + 1):
                name = f"sh{band}"
                part = self.get(stream, path, name, dict, "an object, one a band")
                palettes.append(self._palette(part, f"{path}.{name}", name, BAND_COEFFICIENTS[band - 1], frames))
        return bands, sh0_path, codebook, tuple(palettes)

    def _palette(
        self, source: dict[str, Any], path: str, name: str, coefficients: int, frames: int, prefix: str = ""
    ) -> PaletteMeta:
        """Read a palette; version 1 writes its fields into the stream itself, with a prefix."""

        def spelled(field: str) -> str:
            return prefix + field[0].upper() + field[1:] if prefix else field

        count = self.get(source, path, spelled("count"), int, "a count")
        if not 1 <= count <= MAX_PALETTE:
            self.fail("palette-count", f"{path}.{spelled('count')}", f"expected 1 to {MAX_PALETTE}, found {count}", value=count)
        kind = self.get(source, path, spelled("centroidsType"), str, '"f16" or "f32"')
        if kind not in {"f16", "f32"}:
            message = f'expected "f16" or "f32", found {_brief(kind)}'
            self.fail("centroids-type", f"{path}.{spelled('centroidsType')}", message)
        centroids_path = self.path(source, path, spelled("centroidsPath"))
        encoding = source.get(spelled("labelsEncoding")) or "full"
        labels_path = None
        segments: tuple[Segment, ...] = ()
        if encoding == "full":
            labels_path = self.template(source, path, spelled("labelsPath"))
        elif encoding == "delta-v1":
            segments = self._segments(source, path, spelled("deltaSegments"), frames)
        else:
            message = f'expected "full" or "delta-v1", found {_brief(encoding)}'
            self.fail("labels-encoding", f"{path}.{spelled('labelsEncoding')}", message)
        return PaletteMeta(
            name=name,
            coefficients=coefficients,
            count=count,
            centroids_type=kind,
            centroids_path=centroids_path,
            labels_path=labels_path,
            segments=segments,
        )

    def _segments(self, source: dict[str, Any], path: str, name: str, frames: int) -> tuple[Segment, ...]:
        field = f"{path}.{name}"
        segments = []
        expected = 0
        for i, item in enumerate(self.get(source, path, name, list, "a list of segments")):
            place = f"{field}[{i}]"
            if not isinstance(item, dict):
                self.fail("wrong-type", place, f"expected an object, found {_brief(item)}")
                raise _MissingError
            start = self.get(item, place, "startFrame", int, "a frame")
            count = self.get(item, place, "frameCount", int, "a count")
            if start != expected or count <= 0 or start + count > frames:
                self.fail(
                    "segments", place,
                    f"expected a segment that starts at frame {expected} and ends by {frames}, "
                    f"found {count} frames from {start}", frame=expected, value=start,
                )  # fmt: skip
                return ()
            segments.append(
                Segment(start, count, self.path(item, place, "baseLabelsPath"), self.path(item, place, "deltaPath"))
            )
            expected = start + count
        if expected != frames:
            self.fail("segments", field, f"expected segments for {frames} frames, found them for {expected}", frame=expected)
        return tuple(segments)

    def path(self, parent: dict[str, Any], path: str, name: str) -> str:
        """Return a path inside the archive."""
        value = self.get(parent, path, name, str, "a path")
        if not is_relative_name(value):
            self.fail("path", f"{path}.{name}", f"expected a relative path with / between parts, found {value!r}")
        return str(value)

    def template(self, parent: dict[str, Any], path: str, name: str) -> str:
        """Return a path that contains {frame}."""
        value = self.path(parent, path, name)
        if FRAME_TOKEN not in value:
            self.fail("path-template", f"{path}.{name}", f"expected a path that contains {FRAME_TOKEN}, found {value!r}")
        return value

    def numbers(self, values: list[Any], field: str) -> NDArray[np.float64]:
        """Return a list of numbers as an array."""
        for i, value in enumerate(values):
            if isinstance(value, bool) or not isinstance(value, int | float):
                self.fail("wrong-type", f"{field}[{i}]", f"expected a number, found {_brief(value)}")
                raise _MissingError
        return np.array([_to_float(value) for value in values], np.float64)

    def vectors(self, values: list[Any], field: str) -> Float32:
        """Return a list of vectors as an (n, 3) array; legacy bundles write lists."""
        rows: list[tuple[Any, ...]] = []
        num_lists = 0
        for i, value in enumerate(values):
            if isinstance(value, dict) and all(value.get(axis) is not None for axis in AXES):
                row: tuple[Any, ...] = (value["x"], value["y"], value["z"])
            elif isinstance(value, list) and len(value) == 3:
                row = tuple(value)
                num_lists += 1
            else:
                self.fail("wrong-type", f"{field}[{i}]", f"expected a vector with x, y and z, found {_brief(value)}")
                raise _MissingError
            for axis, number in zip(AXES, row, strict=True):
                if isinstance(number, bool) or not isinstance(number, int | float):
                    self.fail("wrong-type", f"{field}[{i}].{axis}", f"expected a number, found {_brief(number)}")
                    raise _MissingError
            rows.append(row)
        if num_lists:
            self.issues.append(
                Issue(
                    code="vector-list",
                    message=f"{num_lists} vectors are lists, which Unity does not read; repair with gsplat-inspect normalize",
                    field=f"meta.json {field}",
                    count=num_lists,
                )
            )
        wide = np.array([[_to_float(number) for number in row] for row in rows], np.float64).reshape(-1, 3)
        with np.errstate(over="ignore"):
            return wide.astype(np.float32)  # the precision of Unity's vectors


def _to_float(value: float) -> float:
    """Return a JSON number as a float; integers beyond its range become infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _brief(value: Any) -> str:
    """Return a short form of a JSON value for messages."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _nulls(root: dict[str, Any]) -> list[Issue]:
    """Return an issue if any field is null."""
    count, first = 0, ""
    for path in _null_paths(root, ""):
        first = path if count == 0 else min(first, path)
        count += 1
    if count == 0:
        return []
    message = f"{count} values are null, which Unity does not read; leave the fields out"
    return [Issue(code="json-null", message=message, field=f"meta.json {first}", count=count)]


def _null_paths(node: Any, path: str) -> Iterator[str]:
    """Yield where nulls are, one path at a time: there may be millions; `_json.parse` bounds the depth."""
    is_list = isinstance(node, list)
    for key, part in enumerate(node) if is_list else node.items():
        if part is None or isinstance(part, dict | list):
            place = f"{path}[{key}]" if is_list else f"{path}.{key}" if path else str(key)
            if part is None:
                yield place
            else:
                yield from _null_paths(part, place)
