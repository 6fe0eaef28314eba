"""Many conversions, each for itself: one that fails stops no other, and what is done and verified is not done again."""

from __future__ import annotations

import glob
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsplat_tools.cluster.engines import Engine
from gsplat_tools.cluster.runs import check_alike, fingerprint
from gsplat_tools.cluster.state import Done, State, place_of
from gsplat_tools.errors import ClusterError, GsplatError, ReadError, TargetExistsError
from gsplat_tools.formats._companion import path_of
from gsplat_tools.formats._files import open_source_file
from gsplat_tools.formats._limits import max_memory, use_max_memory
from gsplat_tools.formats._stores import identity, is_url, local_path, url_of
from gsplat_tools.formats.saving import find_target
from gsplat_tools.formats.sequences import frame_files
from gsplat_tools.progress import stage

_BLOCK = 4 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One conversion of a batch.

    Parameters
    ----------
    line
        Line of the manifest.
    sources, target
        As `convert` takes them.
    arguments
        Everything else that `convert` takes.
    error
        Why it cannot be done, if that is known; then it is not tried.
    """

    line: int
    sources: tuple[str, ...]
    target: str
    arguments: dict[str, Any] = field(default_factory=dict)
    error: GsplatError | None = None

    def located(self) -> Item:
        """Return the item with absolute names, because workers may have other working directories than this process."""
        arguments = dict(self.arguments)
        motion = arguments.get("motion")
        if motion is not None and motion.fit_report is not None:
            arguments["motion"] = replace(motion, fit_report=motion.fit_report.absolute())
        sources = tuple(map(_absolute, self.sources))
        target = url_of(self.target) if is_url(self.target) else str(Path(local_path(self.target)).absolute())
        return replace(self, sources=sources, target=target, arguments=arguments)

    def digest(self, versions: dict[str, str]) -> str:
        """Return what changes with the sources' names, the options and the versions of this package and what it uses."""
        said = {name: repr(value) for name, value in sorted(self.arguments.items()) if name != "overwrite"}
        described = [self.sources, self.target, said, versions]
        return hashlib.sha256(json.dumps(described).encode()).hexdigest()

    def named(self, report: dict[str, Any]) -> dict[str, Any]:
        """Return the report of the located item under the names that this one has."""
        source = ", ".join(str(url_of(local_path(each))) for each in self.sources)
        return {**report, "source": source, "target": {**report["target"], "path": str(url_of(local_path(self.target)))}}


def _absolute(source: str) -> str:
    """Return the absolute name of a source; a pattern stays one, and nothing else becomes one."""
    if is_url(source):
        return url_of(source)
    path = Path(local_path(source))
    if path.is_absolute():
        return str(path)
    is_pattern = glob.has_magic(str(path)) and not path.exists()
    return str(Path(glob.escape(str(Path.cwd())) if is_pattern else Path.cwd()) / path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What there is of an item before it is converted.

    Parameters
    ----------
    is_done
        Whether it was done before and nothing has changed.
    standing
        As `standing_at` returns it.
    """

    is_done: bool
    standing: str | None


def look_at(item: Item, options: str, memory: Done | None) -> Look:
    """Return what there is of a located item; `options` is its digest where the command runs."""
    standing = standing_at(item)
    return Look(is_done=standing is not None and is_done(item, options, memory), standing=standing)


def standing_at(item: Item) -> str | None:
    """Return what changes when the target, or what belongs beside it, is written again; None where nothing is there."""
    path = Path(local_path(item.target))
    places = [path]
    if not is_url(path):
        if path.is_dir():
            return None  # the conversion says what is wrong
        if find_target(path, item.arguments.get("to")).claims is not None:
            places.append(path_of(path))
    tags = []
    for place in places:
        try:
            tags.append(identity(place))
        except (FileNotFoundError, NotADirectoryError):
            tags.append("")
    return " and ".join(tags) if any(tags) else None


def convert_once(item: Item, memory: int | None) -> dict[str, Any]:
    """Convert an item at whose target nothing stood, or what may be replaced; return the report.

    What stands there now is of an earlier try, which may have ended after its target appeared.
    """
    from gsplat_tools.convert import convert

    overwrite = item.arguments.get("overwrite", False) or standing_at(item) is not None
    with use_max_memory(memory):
        return convert(item.sources, item.target, **{**item.arguments, "overwrite": overwrite}).to_json()


def convert_item(item: Item, options: str, memory: int | None) -> tuple[dict[str, Any], Done, int]:
    """Convert, and return the report, what to remember, and the bytes of the sources."""
    # Before it is read: a source that changes meanwhile is not taken for done.
    before = [(name, identity(name)) for name in _files(item)]
    report = convert_once(item, memory)
    hashed = [(name, tag, *_hash(name)) for name, tag in before]
    size, digest = _hash(item.target)[::-1]
    sources = [(name, tag, sha256) for name, tag, sha256, _ in hashed]
    done = Done(target=place_of(item.target), options=options, sources=sources, bytes=size, sha256=digest)
    return report, done, sum(count for *_, count in hashed)


def is_done(item: Item, options: str, memory: Done | None) -> bool:
    """Whether a conversion was done with these options, from these sources, and its target is what was written then.

    A source is the same where size and time, or the tag of its store, are; or else where its bytes are.
    """
    if memory is None or memory.options != options:
        return False
    try:
        files = _files(item)
        if files != [name for name, _, _ in memory.sources]:
            return False
        for name, tag, sha256 in memory.sources:
            found = identity(name)
            if found != tag and (found.split()[0] != tag.split()[0] or _hash(name)[0] != sha256):
                return False
        if identity(item.target).split()[0] != str(memory.bytes):
            return False
        return _hash(item.target)[0] == memory.sha256
    except (FileNotFoundError, ReadError, GsplatError):
        return False


def _files(item: Item) -> list[str]:
    """Return the names of all source files."""
    return [url_of(path) if is_url(path) else str(path) for path in frame_files([local_path(each) for each in item.sources])]


def _hash(name: str) -> tuple[str, int]:
    """Return the SHA-256 and the number of bytes of a file or an object."""
    digest, count = hashlib.sha256(), 0
    with open_source_file(Path(local_path(name))) as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
            count += len(block)
    return digest.hexdigest(), count


Tell = Callable[[dict[str, Any]], None]


def run_batch(
    items: Sequence[Item], engine: Engine, *, state: State | None = None, resume: bool = False, tell: Tell | None = None
) -> dict[str, Any]:
    """Run conversions and report on each.

    Parameters
    ----------
    items
        The conversions. Relative names are relative to the working directory of this process.
    engine
        Where they run, one task each.
    state
        What was begun and done before; what is now is added.
    resume
        Whether to leave out what is done and verified, and to replace what an earlier run has left.
    tell
        Called with the report of every item when it is known.

    Returns
    -------
    dict
        items, in the order of the manifest: line, source, target, status ("done", "kept" or "failed"), seconds, report or
        error · summary: counts, bytes and seconds · cluster: scheduler, workers, dashboard, retried.

    Raises
    ------
    ClusterError
        A worker has other versions, or the connection to the workers was lost for good.
    """
    start = time.perf_counter()
    check_alike(engine)
    batch = _Batch(items, engine, state, tell)
    batch.convert(batch.look(resume=resume))
    counts = {status: sum(each["status"] == status for each in batch.reports) for status in ("done", "kept", "failed")}
    return {
        "items": batch.reports,
        "summary": {
            **counts,
            "source_bytes": batch.bytes_read,
            "target_bytes": batch.bytes_written,
            "seconds": round(time.perf_counter() - start, 4),
            "task_seconds": round(sum(each["seconds"] for each in batch.reports), 4),
        },
        "cluster": {
            "scheduler": engine.name,
            "workers": engine.workers,
            "dashboard": engine.dashboard,
            "retried": engine.retried,
        },
    }


class _Batch:
    """The items of a batch and what became of them."""

    def __init__(self, items: Sequence[Item], engine: Engine, state: State | None, tell: Tell | None) -> None:
        self.reports: list[dict[str, Any]] = [{} for _ in items]
        self.bytes_read = self.bytes_written = 0
        self._items, self._engine, self._state, self._tell = items, engine, state, tell
        self._located = [item.located() for item in items]
        self._targets = [place_of(item.target) for item in items]
        versions, _ = fingerprint()
        self._options = [item.digest(versions) for item in self._located]

    def look(self, *, resume: bool) -> list[int]:
        """Return which items are to be converted, after that was noted; report on the others."""
        for index, item in enumerate(self._items):
            if item.error is not None:
                self._fail(index, item.error)
        known = [index for index, item in enumerate(self._items) if item.error is None]
        # Workers look: the bytes of targets are read for their hash.
        pending = [self._engine.submit(look_at, *self._remembered(index, resume=resume)) for index in known]
        standing: dict[int, str | None] = {}
        with stage("looking at targets", len(known), "scenes") as progress:
            for position, outcome in self._engine.completed(pending):
                index = known[position]
                progress.advance(1)
                if isinstance(outcome, Exception):
                    self._fail(index, outcome)
                elif outcome.error is not None:
                    self._fail(index, outcome.error, outcome.seconds)
                elif outcome.value.is_done:
                    self._say(index, "kept", outcome.seconds)
                else:
                    standing[index] = outcome.value.standing
        waiting = [index for index in sorted(standing) if self._may_write(index, standing[index], resume=resume)]
        if self._state is not None:
            self._state.begin({self._targets[index]: standing[index] for index in waiting})
        return waiting

    def convert(self, waiting: Sequence[int]) -> None:
        """Convert items and report on them."""
        limit = max_memory()
        with stage("converting", len(waiting), "scenes") as progress:
            pending = [
                self._engine.submit(convert_item, self._located[index], self._options[index], limit) for index in waiting
            ]
            for position, outcome in self._engine.completed(pending):
                index = waiting[position]
                if isinstance(outcome, Exception):
                    self._give_up(index, outcome)
                    self._fail(index, outcome)
                elif outcome.error is not None:
                    self._give_up(index, outcome.error)
                    self._fail(index, outcome.error, outcome.seconds)
                else:
                    report, done, count = outcome.value
                    self.bytes_read, self.bytes_written = self.bytes_read + count, self.bytes_written + done.bytes
                    if self._state is not None:
                        self._state.keep(done)
                    named = self._items[index].named(report)
                    self._say(index, "done", outcome.seconds, sha256=done.sha256, report=named)
                progress.advance(1)

    def _remembered(self, index: int, *, resume: bool) -> tuple[Item, str, Done | None]:
        """Return what `look_at` takes."""
        memory = self._state.find(self._targets[index]) if self._state is not None and resume else None
        return self._located[index], self._options[index], memory

    def _may_write(self, index: int, standing: str | None, *, resume: bool) -> bool:
        """Whether the target of an item may be written; where it may not, the item has failed."""
        item = self._located[index]
        overwrite = item.arguments.get("overwrite", False)
        if resume and self._state is not None and self._state.owns(self._targets[index], standing):
            overwrite = True
        if standing is not None and not overwrite:
            known = ", and this batch has not written it; " if resume else "; --resume leaves out what this batch has done, "
            message = f"the target exists{known}--overwrite (library: overwrite=True) replaces it"
            self._fail(index, TargetExistsError(message, path=self._items[index].target))
            return False
        self._located[index] = replace(item, arguments={**item.arguments, "overwrite": overwrite})
        return True

    def _give_up(self, index: int, error: Exception) -> None:
        """Forget that an item was begun, if its tasks have ended and left nothing."""
        if self._state is None or isinstance(error, ClusterError):
            return  # a task whose worker was lost may go on there
        try:
            standing = standing_at(self._located[index])
        except (GsplatError, OSError):
            return
        self._state.give_up(self._targets[index], standing, is_foreign=isinstance(error, TargetExistsError))

    def _fail(self, index: int, error: Exception, seconds: float = 0.0) -> None:
        self._say(index, "failed", seconds, error=_in_words(error))

    def _say(self, index: int, status: str, seconds: float, **more: Any) -> None:
        item = self._items[index]
        self.reports[index] = {
            "line": item.line,
            "source": ", ".join(item.sources),
            "target": item.target,
            "status": status,
            "seconds": round(seconds, 4),
            **more,
        }
        if self._tell is not None:
            self._tell(self.reports[index])


def _in_words(error: Exception) -> dict[str, str]:
    """Return an error as its kind and message."""
    text = str(error)
    if isinstance(error, FileNotFoundError) and error.filename:
        text = f"{error.filename}: {error.strerror}"
    return {"kind": type(error).__name__, "message": text or type(error).__name__}
