"""Every rule of a file's format, held against the whole file; findings gathered per code, so that a page is enough."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import VISIBLE_OPACITY
from gsplat_tools.errors import (
    CapabilityError,
    FormatError,
    GsplatWarning,
    LimitExceededError,
    TruncatedDataError,
    UnsupportedVersionError,
    counts_in_words,
)
from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats._issues import Issue, Rule
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.loading import located, open_source, read_options
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

T = TypeVar("T")

FIRST_OFFENDERS = 5
"""Offenders of each code that a report names."""

GENERAL_RULES = {
    "truncated": Rule(severity="error", meaning="fewer bytes than the header promises", error=TruncatedDataError),
    "corrupt": Rule(severity="error", meaning="bytes contradict themselves, or do not decompress"),
    "unsupported-version": Rule(severity="error", meaning="a version that is not read", error=UnsupportedVersionError),
    "limit-exceeded": Rule(severity="error", meaning="more is claimed than the file can hold", error=LimitExceededError),
    "unreadable": Rule(severity="error", meaning="the file cannot be read to its end", error=FormatError),
    "reader-warning": Rule(severity="warning", meaning="the reader warns, and reads on"),
    "invalid-splats": Rule(severity="warning", meaning="values that are not numbers, or rotations of length zero"),
    "no-splats": Rule(severity="warning", meaning="there is nothing to draw"),
    "invisible": Rule(severity="hint", meaning="splats with an opacity below 1/255, which no 8-bit target shows"),
    "axes-unknown": Rule(severity="info", meaning="the file does not say what its axes are"),
}
"""Codes that any format may give, besides its own."""

_SEVERITIES = ("error", "warning", "info", "hint")


def rules_of(record: Format) -> dict[str, Rule]:
    """Return every code that validating a file of this format may give."""
    return {**GENERAL_RULES, **record.rules}


def validate(path: str | Path, *, max_issues: int = 100) -> dict[str, Any]:
    """Validate a file and return what `gsplat-inspect validate --json` prints.

    Parameters
    ----------
    path
        File to check to its last value.
    max_issues
        Most codes to list, errors first; the count of each is exact all the same.

    Returns
    -------
    dict
        file, format, valid, and issues: code, severity, count, message of the first, and the first offenders with
        frame, splat, path and value.

    Raises
    ------
    UnknownFormatError
        No format claims the file.
    """
    path = Path(path)
    with located(path):
        stream, record = open_source(path)
    rules = rules_of(record)
    gathered: dict[str, dict[str, Any]] = {}
    with located(path), stream, stage("validating", unit="findings") as progress:
        for issue in _issues(stream, record):
            progress.advance(1)
            entry = gathered.setdefault(
                issue.code,
                {
                    "code": issue.code,
                    "severity": rules[issue.code].severity,
                    "count": 0,
                    "message": issue.message,
                    "first": [],
                },
            )
            entry["count"] += issue.count
            if len(entry["first"]) < FIRST_OFFENDERS:
                entry["first"].append(
                    {"frame": issue.frame, "splat": issue.splat, "path": issue.field, "value": _plain(issue.value)}
                )
    issues = sorted(gathered.values(), key=lambda entry: _SEVERITIES.index(entry["severity"]))
    return {
        "file": str(path),
        "format": record.id,
        "valid": not any(entry["severity"] == "error" for entry in issues),
        "issues": issues[:max_issues],
        "omitted": max(0, len(issues) - max_issues),
    }


def _plain(value: Any) -> Any:
    """Return a value that JSON can hold."""
    if isinstance(value, np.generic):
        value = value.item()
    return value if isinstance(value, int | float | str | bool | None) else str(value)


def _issues(stream: BinaryIO, record: Format) -> Iterator[Issue]:
    """Yield what the format's own check finds, and what shows in the decoded splats."""
    found: dict[str, bool] = {}
    if record.check is not None:
        for issue in record.check(stream):
            found[issue.code] = record.rules[issue.code].severity == "error"
            yield issue
    if any(found.values()) or record.read is None:
        return
    stream.seek(0)
    try:
        read = partial(record.read, stream, read_options(record, {}))
        scene, issues = _heard(read, record, found)
        yield from issues
        frames = len(scene) if isinstance(scene, GaussianSequence) else 1
        for frame_id in range(frames):
            if isinstance(scene, GaussianSequence):
                cloud, issues = _heard(partial(scene.frame, frame_id), record, found)
                yield from issues
            else:
                cloud = scene
            yield from _remarks(cloud, frame_id if frames > 1 else None)
    except FormatError as error:
        yield Issue(
            code=_code_of(error, record),
            message=error.message,
            field=error.field,
            frame=error.frame,
            offset=error.offset,
            value=error.offset,
        )


def _code_of(error: FormatError, record: Format) -> str:
    """Return the rule that a reader says was broken, or else what kind of error it raised."""
    code = str(getattr(error, "code", ""))
    if code in record.rules:
        return code
    kinds = {rule.error: code for code, rule in GENERAL_RULES.items() if rule.severity == "error"}
    return kinds.get(type(error), "unreadable")


def _heard(function: Callable[[], T], record: Format, known: Collection[str]) -> tuple[T, list[Issue]]:
    """Call a reader; return what it gives, and its warnings as issues but for codes that are known already."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        result = function()
    issues = []
    for warning in caught:
        if not isinstance(warning.message, GsplatWarning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        elif warning.message.code not in known:
            code = warning.message.code if warning.message.code in record.rules else "reader-warning"
            issues.append(Issue(code=code, message=str(warning.message), value=warning.message.code))
    return result, issues


def _remarks(cloud: GaussianCloud, frame: int | None) -> Iterator[Issue]:
    """Yield what any scene may suffer from, whatever its format."""
    from gsplat_tools.attributes.activations import sigmoid
    from gsplat_tools.ops.filtering import locate_invalid

    if len(cloud) == 0:
        yield Issue(code="no-splats", message="the file holds no splats", frame=frame)
        return
    invalid = locate_invalid(cloud)
    causes = counts_in_words({cause: count for cause, (count, _) in invalid.items()})
    where = "" if frame is None else f" in frame {frame}"
    for cause, (count, first) in invalid.items():
        yield Issue(
            code="invalid-splats",
            message=f"splats{where} are invalid and dropped by converting: {causes}",
            field=cause,
            frame=frame,
            splat=first,
            count=count,
        )
    hidden = sigmoid(cloud.opacity_logits) < VISIBLE_OPACITY
    if hidden.any() and frame is None:
        yield Issue(
            code="invisible",
            message=f"{int(hidden.sum())} splats have an opacity below 1/255; --prune-opacity 0.0039 drops them",
            splat=int(np.argmax(hidden)),
            count=int(hidden.sum()),
        )
    if cloud.coordinate_system == "unknown" and not frame:
        yield Issue(
            code="axes-unknown", message="the file does not say what its axes are; give --source-coordinates when converting"
        )


def normalize(path: str | Path, target: str | Path | None = None, *, overwrite: bool = False) -> list[str]:
    """Repair what old tools wrote into today's spelling, into a new file or in place.

    Parameters
    ----------
    path
        File to repair.
    target
        File to write; by default the file itself, replaced as a whole.
    overwrite
        Replace a target that is there.

    Returns
    -------
    list of str
        What was repaired; empty where nothing had to be.

    Raises
    ------
    FormatError
        The file cannot be repaired.
    """
    path = Path(path)
    destination = path if target is None else Path(target)
    with located(path):
        source, record = open_source(path)
        with source:
            if record.repair is None:
                raise CapabilityError(f"there is nothing to repair in {record.title}")
            with replacing(destination, overwrite=overwrite or target is None) as stream:
                return record.repair(source, stream)
