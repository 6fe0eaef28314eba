"""Everything that is wrong with a .splat4d, or odd about it, under a code each."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.motion import MIN_SIGMA
from gsplat_tools.errors import FormatError, GsplatWarning
from gsplat_tools.formats import _label_delta
from gsplat_tools.formats._issues import Issue, Rule
from gsplat_tools.formats._label_delta import DeltaSegment, read_delta
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.splat4d.container import RECORD_BYTES, Band, Contents, parse
from gsplat_tools.formats.splat4d.reading import record_blocks, version_of
from gsplat_tools.formats.splat4d.records import is_gaussian

RULES: dict[str, Rule] = {
    "container": Rule(severity="error", meaning="header, section table, META and all lengths fit together and the file"),
    "label-range": Rule(severity="error", meaning="labels name entries of the codebook"),
    **_label_delta.RULES,
    "assumed-gaussian": Rule(severity="warning", meaning="version 1 with times outside [0, 1]: readers take it as gaussian"),
    "temporal-cutoff": Rule(severity="warning", meaning="the cutoff of a gaussian file lies between 0 and 1"),
    "times-range": Rule(severity="warning", meaning="times suit the time model: in [0, 1] for windows, finite for gaussians"),
    "durations-range": Rule(severity="warning", meaning="durations lie in [0, 1] for windows, from 1e-6 up for gaussians"),
    "zero-rotation": Rule(severity="warning", meaning="rotations are not all 128, which stands for no rotation"),
    "sh-over-time": Rule(severity="info", meaning="SH labels change over time, which only players of deltas show"),
}


def check(stream: BinaryIO) -> Iterator[Issue]:
    """Yield everything that is wrong with a file of either version, data decoded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GsplatWarning)
            contents = parse(stream) if version_of(stream) == 2 else None
    except FormatError as error:
        yield Issue(code="container", message=error.message, field=error.field, offset=error.offset, value=error.offset)
        return
    if contents is None:
        yield from _check_records(stream, 0, stream_size(stream) // RECORD_BYTES, None)
        return
    if contents.has_odd_cutoff:
        yield Issue(code="temporal-cutoff", message="expected a cutoff between 0 and 1; 0.01 is used", field="META")
    for band in contents.bands:
        yield from _check_labels(stream, contents, band)
    yield from _check_records(stream, contents.records.offset, contents.splat_count, contents.time_model == "gaussian")


def _check_labels(stream: BinaryIO, contents: Contents, band: Band) -> Iterator[Issue]:
    """Yield what is wrong with the labels of a band, and whether they change."""
    changed: set[int] = set()
    for index, section in enumerate(band.labels):
        stream.seek(section.offset)
        labels = np.frombuffer(read_exactly(stream, section.length, field=section.name), "<u2")
        yield from _offenders("label-range", labels >= band.count, labels, f"a label below {band.count}", section.name)
        if not band.deltas:
            continue
        delta = band.deltas[index]
        stream.seek(delta.offset)
        told = DeltaSegment(
            field=delta.name,
            start_frame=delta.start_frame,
            frame_count=delta.frame_count,
            splat_count=contents.splat_count,
            label_count=band.count,
        )
        blocks, issues = read_delta(read_exactly(stream, delta.length, field=delta.name), told)
        yield from issues
        changed.update(int(splat) for block in blocks for splat in block["splat"])
    if changed:
        message = f"the labels of {len(changed)} splats change over {contents.frame_count} frames"
        yield Issue(code="sh-over-time", message=message, field=f"SHDL band {band.number}", count=len(changed))


def _check_records(stream: BinaryIO, offset: int, count: int, gaussian: bool | None) -> Iterator[Issue]:
    """Yield what readers repair; `gaussian` is None where the times have to tell."""
    times, durations = np.empty(count, np.float32), np.empty(count, np.float32)
    is_null = np.empty(count, np.bool_)
    for start, block in record_blocks(stream, offset, count):
        part = slice(start, start + len(block))
        times[part], durations[part] = block["time"], block["duration"]
        is_null[part] = (block["quat"] == 128).all(axis=1)
    if gaussian is None:
        gaussian = is_gaussian(times, durations)
        if gaussian:
            message = "over 1 % of the times or durations lie outside [0, 1]: taken as the gaussian time model"
            yield Issue(code="assumed-gaussian", message=message, field="RECS")
    if gaussian:
        yield from _offenders("times-range", ~np.isfinite(times), times, "a finite time", "time")
        yield from _offenders("durations-range", ~(durations >= MIN_SIGMA), durations, f"at least {MIN_SIGMA:g}", "duration")
    else:
        for code, values, field in (("times-range", times, "time"), ("durations-range", durations, "duration")):
            yield from _offenders(code, ~((values >= 0) & (values <= 1)), values, "a number in [0, 1]", field)
    yield from _offenders("zero-rotation", is_null, np.full(count, 128), "a rotation", "rw rx ry rz")


def _offenders(code: str, is_bad: NDArray[np.bool_], values: NDArray[np.generic], rule: str, field: str) -> Iterator[Issue]:
    """Yield one issue for all that break a rule, naming the first."""
    if is_bad.any():
        splat = int(np.argmax(is_bad))
        message = f"expected {rule}, found {values[splat]}"
        count = int(np.count_nonzero(is_bad))
        yield Issue(code=code, message=message, field=field, splat=splat, value=values[splat], count=count)
