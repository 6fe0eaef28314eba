"""What a reader may do with a hostile file: read it, or refuse it with one of our errors that says where."""

from __future__ import annotations

import contextlib
import io
import json
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.errors import CapabilityError, GsplatError, GsplatWarning, UnknownFormatError
from gsplat_tools.formats import load
from gsplat_tools.formats._json import finite
from gsplat_tools.formats._limits import use_max_memory
from gsplat_tools.formats.base import FileInfo, Format
from gsplat_tools.formats.loading import located, open_as, open_scene
from gsplat_tools.formats.sog4d import planes
from gsplat_tools.inspection import describe
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.validation import rules_of, validate

SECONDS = 5.0
"""Processor time of one step; the clock of the wall would blame readers for what else the machine does."""

BASE_BYTES = 64 << 20
DECODED_FACTOR = 3

_OPTIONS: dict[str, tuple[dict[str, Any], ...]] = {
    "ply": ({"time_model": "gaussian"},),
    "splat4d": ({"time_model": "gaussian"}, {"frame": 1}),
    "sog": ({"lod": 1},),
    "sog4d": ({"shn_order": "channel-major"},),
}
"""Choices that a reader leaves to its caller."""

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Flaw:
    """A promise that was broken: by what, and how."""

    step: str
    kind: str
    detail: str


class _TookTooLongError(BaseException):
    """Raised by the alarm; not an Exception, so that nobody catches it."""


def judge(record: Format, path: Path, *, thorough: bool = False, seconds: float | None = None) -> tuple[str, list[Flaw]]:
    """Read a file in every way that there is.

    Returns ("read" or the class of the error that `read` gave, flaws). Memory is the peak of the resident set during a step,
    less what was resident before, on Linux; `thorough` adds the paths that a user takes: detection, validation and repair.
    """
    limit = SECONDS if seconds is None else seconds
    flaws: list[Flaw] = []
    declared = 0
    info = _watched("inspect", lambda: _inspect(record, path), declared, flaws, limit)
    if isinstance(info, FileInfo):
        declared = declared_bytes(info)
    outcome = _watched("read", lambda: _read(record, path, in_chunks=False, again=thorough), declared, flaws, limit)
    if record.read_chunks is not None:
        _watched("chunks", lambda: _read(record, path, in_chunks=True, again=thorough), declared, flaws, limit)
    if record.check is not None:
        _watched("check", lambda: _check(record, path), declared, flaws, limit)
    if thorough:
        _watched("load", lambda: load(path), declared, flaws, limit)
        _watched("stream", lambda: _read_stream(record, path), declared, flaws, limit)
        for options in _OPTIONS.get(record.id, ()):
            _watched(f"read {options}", lambda options=options: _read_stream(record, path, **options), declared, flaws, limit)
        _watched("little memory", lambda: _read_little(record, path), declared, flaws, limit)
        if record.id == "sog4d":
            _watched("planes", lambda: planes(path, 1), declared, flaws, limit)
        _watched("validate", lambda: json.dumps(finite(validate(path)), allow_nan=False), declared, flaws, limit)
        if record.repair is not None:
            _watched("repair", lambda: _repair(record, path), declared, flaws, limit)
    return (type(outcome).__name__ if isinstance(outcome, GsplatError) else "read"), flaws


def declared_bytes(info: FileInfo) -> int:
    """Return what a file says that it takes in memory: its splats as float32, and the images that they come from."""
    splat = 4 * (14 + 3 * ((info.sh_degree + 1) ** 2 - 1) + 5)
    layout = info.encoding.get("layout")
    pixels = layout[0] * layout[1] * 4 * 6 if isinstance(layout, list) else 0
    return info.splats * splat + pixels


def _watched(name: str, run: Callable[[], Any], declared: int, flaws: list[Flaw], limit: float) -> Any:
    """Run one way of reading and note what it should not have done; returns its result or its error."""
    before = _resident()
    start = time.process_time()
    result: Any = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", ResourceWarning)  # told when the collector runs, not where they arise
        try:
            with _alarm(limit):
                result = run()
        except GsplatError as error:
            result = error
            has_place = error.field is not None or error.offset is not None or error.frame is not None
            is_about_more = isinstance(error, UnknownFormatError | CapabilityError)
            if error.path is None or not (has_place or is_about_more):
                flaws.append(Flaw(name, "no place", f"{type(error).__name__}: {error}"[:300]))
            if len(str(error)) > 4000:
                flaws.append(Flaw(name, "long message", f"{type(error).__name__}: {len(str(error))} characters"))
        except _TookTooLongError:
            flaws.append(Flaw(name, "hang", f"over {limit:g} s"))
        except BaseException as error:
            flaws.append(Flaw(name, "exception", f"{type(error).__name__}: {error}{_where(error)}"[:300]))
            if isinstance(error, KeyboardInterrupt | SystemExit):
                raise
    seconds = time.process_time() - start
    if seconds > limit and not any(flaw.kind == "hang" for flaw in flaws):
        flaws.append(Flaw(name, "hang", f"{seconds:.1f} s"))
    flaws += [
        Flaw(name, "warning", f"{warning.category.__name__}: {warning.message}"[:300])
        for warning in caught
        if not issubclass(warning.category, GsplatWarning)
    ]
    peak = _peak() - before
    allowed = BASE_BYTES + DECODED_FACTOR * declared
    if before and peak > allowed:
        flaws.append(Flaw(name, "memory", f"{peak >> 20} MiB where {declared} bytes are declared"))
    return result


def _where(error: BaseException) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return f" ({Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno})" if trace is not None else ""


@contextlib.contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    """Raise when the time is over; code outside Python is left to the watch over the worker."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(_number: int, _frame: object) -> None:
        raise _TookTooLongError

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _resident() -> int:
    """Forget the peak of the resident set and return its size, or 0 where the system does not tell."""
    try:
        _CLEAR.write_bytes(b"5")
    except OSError:
        return 0
    return _status(b"VmRSS:")


def _peak() -> int:
    try:
        return _status(b"VmHWM:")
    except OSError:
        return 0


def _status(key: bytes) -> int:
    text = _STATUS.read_bytes()
    start = text.find(key)
    return int(text[start + len(key) : text.find(b"kB", start)]) << 10


def _inspect(record: Format, path: Path) -> FileInfo:
    with located(path), open_as(path, record) as stream:
        info = record.inspect(stream)
    json.dumps(finite(describe(path, record, info)), allow_nan=False)
    return info


def _read(record: Format, path: Path, *, in_chunks: bool, again: bool = False) -> None:
    with open_scene(path, in_chunks=in_chunks, as_format=record.id) as scene:
        if isinstance(scene, CloudChunks):
            for _ in range(1 + again):
                count = sum(len(chunk) for chunk in scene)
                assert count == scene.num_splats, f"{count} splats in chunks, {scene.num_splats} announced"
        elif isinstance(scene, GaussianSequence):
            frames = range(min(len(scene), 6 if again else 3))
            for frame in (*frames, *([0] if again else [])):
                scene.frame(frame)


def _read_stream(record: Format, path: Path, **options: Any) -> None:
    """Read from memory, where nothing lies beside the file; or with options, from where it is."""
    assert record.read is not None
    with located(path), open_as(path, record) if options else io.BytesIO(path.read_bytes()) as stream:
        scene = record.read(stream, record.read_options(**options))
        if isinstance(scene, GaussianSequence):
            scene.frame(0)


def _read_little(record: Format, path: Path) -> None:
    """Read while hardly anything is allowed to be decoded."""
    with use_max_memory(100):
        _read(record, path, in_chunks=False)


def _check(record: Format, path: Path) -> None:
    assert record.check is not None
    rules = rules_of(record)
    with located(path), open_as(path, record) as stream:
        for issue in record.check(stream):
            assert issue.code in rules, f"the code {issue.code!r} is none of the format's"


def _repair(record: Format, path: Path) -> None:
    assert record.repair is not None
    with path.open("rb") as stream, located(path):
        record.repair(stream, io.BytesIO())
