"""Rows for the synthetic sweeps and for a scene, in every format that reads and writes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.loading import load
from gsplat_tools.formats.registry import FORMATS, find_format
from gsplat_tools.numerics import halves, timelines
from gsplat_tools.numerics.conditions import conditions
from gsplat_tools.numerics.measuring import Row, measure_cloud
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

MAX_SPLATS = 100_000
"""Splats of a scene that are measured; of larger ones every k-th."""


def measured_formats(names: Iterable[str] | None = None) -> list[Format]:
    """Return the formats of these ids, by default all, that read and write.

    Raises
    ------
    CapabilityError
        A format is unknown.
    """
    chosen = list(FORMATS.values()) if names is None else [find_format(name) for name in names]
    return [record for record in chosen if record.read is not None and record.write is not None]


def synthetic_rows(names: Iterable[str] | None = None, sweeps: Iterable[str] | None = None) -> list[Row]:
    """Return the rows of all synthetic sweeps.

    Parameters
    ----------
    names
        Format ids; by default every format that reads and writes.
    sweeps
        Names of sweeps; by default all.
    """
    wanted = None if sweeps is None else set(sweeps)
    points = [point for point in conditions() if wanted is None or point.sweep in wanted]
    rows: list[Row] = []
    formats = measured_formats(names)
    with stage("measuring", len(formats) * len(points), "clouds") as progress:
        for record in formats:
            for point in points:
                if point.cloud.has_motion and not record.holds_motion:
                    progress.advance(1)
                    continue
                rows += measure_cloud(
                    point.cloud, record, watched=point.watched, sweep=point.sweep, label=point.label, x=point.x
                )
                progress.advance(1)
            if record.holds_sequences and (wanted is None or timelines.SWEEP in wanted):
                rows += timelines.sequence_rows(record)
    if halves.FORMAT in {record.id for record in formats}:
        rows += [halves.vanishing_row(point) for point in points if point.sweep == "needle"]
    return rows


def scene_rows(path: str | Path, names: Iterable[str] | None = None, *, max_splats: int = MAX_SPLATS) -> list[Row]:
    """Return the rows of a scene, one for each attribute and format.

    Parameters
    ----------
    path
        File to read; of a sequence, its first frame.
    names
        Format ids; by default every format that reads and writes.
    max_splats
        Of larger scenes every k-th splat is taken, so that no more are left.

    Raises
    ------
    FormatError
        The bytes are at fault.

    Warns
    -----
    NonFiniteWarning
        Invalid splats were left out, with counts.
    """
    scene = load(path)
    cloud = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
    step = max(1, -(-len(cloud) // max_splats))
    cloud = cloud.take(slice(None, None, step))
    label = "" if step == 1 else f"every {step}th splat"
    rows: list[Row] = []
    formats = measured_formats(names)
    with stage("measuring", len(formats), "formats") as progress:
        for record in formats:
            rows += measure_cloud(_fitting(cloud, record), record, label=label)
            progress.advance(1)
    if halves.FORMAT in {record.id for record in formats}:
        rows.append(halves.half_row(cloud, "scene", label))
    return rows


def _fitting(cloud: GaussianCloud, record: Format) -> GaussianCloud:
    """Leave out the motion that a format does not hold."""
    if cloud.has_motion and not record.holds_motion:
        return cloud.replace(velocities=None, times=None, durations=None)
    return cloud


def exceeded_rows(rows: Iterable[Row]) -> list[Row]:
    """Return the rows with a value beyond its bound."""
    return [row for row in rows if row.within is False]


def summarize(rows: Iterable[Row]) -> Iterator[tuple[Row, int, int]]:
    """Yield (row nearest its bound, rows, refused rows) for each format, attribute and sweep."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.sweep, row.attribute, row.format), []).append(row)
    for group in groups.values():
        refused = sum(row.note.startswith("refused") for row in group)
        yield max(group, key=_severity), len(group), refused


def _severity(row: Row) -> tuple[bool, float, float]:
    """Order rows: beyond the bound, then nearest to it, then the largest error."""
    measured = -1.0 if row.measured_max is None else row.measured_max
    return row.within is False, -1.0 if row.tightness is None else row.tightness, -1.0 if np.isnan(measured) else measured
