"""Many conversions, each for itself: one that fails stops no other, and what is done and verified is not done again."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsplat_tools.cluster.engines import Engine
from gsplat_tools.cluster.outcomes import Outcome
from gsplat_tools.errors import GsplatError, ReadError
from gsplat_tools.formats._files import open_source_file
from gsplat_tools.formats._limits import max_memory, use_max_memory
from gsplat_tools.formats._stores import identity, is_url, local_path, url_of
from gsplat_tools.formats.sequences import frame_files
from gsplat_tools.progress import stage

STATE_SUFFIX = ".state.jsonl"
"""Added to the manifest's name: what was done, a JSON object a line."""

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
    """

    line: int
    sources: tuple[str, ...]
    target: str
    arguments: dict[str, Any] = field(default_factory=dict)

    def digest(self) -> str:
        """Return what changes with the options and with the version of this package."""
        from gsplat_tools.cluster.runs import fingerprint

        said = {name: repr(value) for name, value in sorted(self.arguments.items()) if name != "overwrite"}
        described = [self.sources, self.target, said, fingerprint()[0]]
        return hashlib.sha256(json.dumps(described).encode()).hexdigest()


@dataclass(slots=True, kw_only=True)
class Done:
    """What is remembered of a finished conversion.

    Parameters
    ----------
    options
        `Item.digest`.
    sources
        (name, identity, SHA-256) of every source; the identity is size and time, or the tag of a store.
    bytes, sha256
        Of the target.
    """

    target: str
    options: str
    sources: list[tuple[str, str, str]]
    bytes: int
    sha256: str


def convert_item(item: Item, memory: int | None) -> tuple[dict[str, Any], Done, int]:
    """Convert, and return the report, what to remember, and the bytes of the sources."""
    from gsplat_tools.convert import convert

    with use_max_memory(memory):
        # Before it is read: a source that changes meanwhile is not taken for done.
        before = [(name, identity(name)) for name in _files(item)]
        report = convert(item.sources, item.target, **item.arguments).to_json()
    hashed = [(name, tag, *_hash(name)) for name, tag in before]
    size, digest = _hash(item.target)[::-1]
    sources = [(name, tag, sha256) for name, tag, sha256, _ in hashed]
    done = Done(target=item.target, options=item.digest(), sources=sources, bytes=size, sha256=digest)
    return report, done, sum(count for *_, count in hashed)


def is_done(item: Item, memory: Done | None) -> bool:
    """Whether a conversion was done with these options, from these sources, and its target is what was written then.

    A source is the same where size and time, or the tag of its store, are; or else where its bytes are.
    """
    if memory is None or memory.options != item.digest():
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


class State:
    """What was done, by target, in a file that only grows; a line that was cut off counts as not written.

    Parameters
    ----------
    path
        JSON lines; made where it is missing.
    resume
        Whether to go by what is there; else it is begun anew.
    """

    def __init__(self, path: Path, *, resume: bool) -> None:
        self._path = path
        self._done: dict[str, Done] = {}
        if resume and path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    said = json.loads(line)
                    said["sources"] = [tuple(each) for each in said["sources"]]
                    done = Done(**said)
                except (ValueError, KeyError, TypeError):
                    continue
                self._done[done.target] = done
            if not path.read_bytes().endswith(b"\n"):
                self._append("\n")
        else:
            path.write_text("", encoding="utf-8")

    def find(self, target: str) -> Done | None:
        """Return what is remembered of a target."""
        return self._done.get(target)

    def keep(self, done: Done) -> None:
        """Remember a finished conversion, also if the power fails now."""
        self._done[done.target] = done
        said = {name: getattr(done, name) for name in Done.__dataclass_fields__}
        self._append(json.dumps(said) + "\n")

    def _append(self, text: str) -> None:
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())


Tell = Callable[[dict[str, Any]], None]


def run_batch(
    items: Sequence[Item], engine: Engine, *, state: State | None = None, resume: bool = False, tell: Tell | None = None
) -> dict[str, Any]:
    """Run conversions and report on each.

    Parameters
    ----------
    items
        The conversions.
    engine
        Where they run, one task each.
    state
        What was done before; what is done now is added.
    resume
        Whether to leave out what is done and verified.
    tell
        Called with the report of every item when it is known.

    Returns
    -------
    dict
        items, in the order of the manifest: source, target, status ("done", "kept" or "failed"), seconds, report or
        error · summary: counts, bytes and seconds · cluster: scheduler, workers, dashboard, retried.
    """
    start = time.perf_counter()
    reports: list[dict[str, Any]] = [{} for _ in items]
    bytes_read = bytes_written = 0

    def say(index: int, status: str, seconds: float, **more: Any) -> None:
        item = items[index]
        source = ", ".join(item.sources)
        reports[index] = {
            "line": item.line, "source": source, "target": item.target, "status": status, "seconds": round(seconds, 4), **more,
        }  # fmt: skip
        if tell is not None:
            tell(reports[index])

    # What was done is looked at by the workers too: a target's bytes are read for its hash.
    memories = [state.find(item.target) if state is not None and resume else None for item in items]
    waiting = list(range(len(items)))
    looked = [engine.submit(is_done, items[index], memories[index]) for index in waiting if memories[index] is not None]
    remembered = [index for index in waiting if memories[index] is not None]
    for position, outcome in engine.completed(looked):
        if isinstance(outcome, Outcome) and outcome.error is None and outcome.value:
            say(remembered[position], "kept", outcome.seconds)
            waiting.remove(remembered[position])
    limit = max_memory()
    with stage("converting", len(waiting), "scenes") as progress:
        pending = [engine.submit(convert_item, _again(items[index], memories[index]), limit) for index in waiting]
        for position, outcome in engine.completed(pending):
            index = waiting[position]
            if isinstance(outcome, BaseException):
                say(index, "failed", 0.0, error=_named(outcome))
            elif outcome.error is not None:
                say(index, "failed", outcome.seconds, error=_named(outcome.error))
            else:
                report, done, count = outcome.value
                bytes_read, bytes_written = bytes_read + count, bytes_written + done.bytes
                if state is not None:
                    state.keep(done)
                say(index, "done", outcome.seconds, sha256=done.sha256, report=report)
            progress.advance(1)
    counts = {status: sum(each["status"] == status for each in reports) for status in ("done", "kept", "failed")}
    return {
        "items": reports,
        "summary": {
            **counts,
            "source_bytes": bytes_read,
            "target_bytes": bytes_written,
            "seconds": round(time.perf_counter() - start, 4),
            "task_seconds": round(sum(each["seconds"] for each in reports), 4),
        },
        "cluster": {
            "scheduler": engine.name,
            "workers": engine.workers,
            "dashboard": engine.dashboard,
            "retried": engine.retried,
        },
    }


def _again(item: Item, memory: Done | None) -> Item:
    """Return the item; a target that an earlier run of this batch wrote, and that is out of date, may be replaced."""
    if memory is None:
        return item
    return Item(line=item.line, sources=item.sources, target=item.target, arguments={**item.arguments, "overwrite": True})


def _named(error: BaseException) -> dict[str, str]:
    """Return an error as its kind and message."""
    text = str(error)
    if isinstance(error, FileNotFoundError) and error.filename:
        text = f"{error.filename}: {error.strerror}"
    return {"kind": type(error).__name__, "message": text or type(error).__name__}
