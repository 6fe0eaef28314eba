"""What a batch has begun and done, in a file that outlives the command."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsplat_tools.formats._stores import is_url, local_path, url_of

STATE_SUFFIX = ".state.jsonl"
"""Added to the manifest's name."""


def place_of(name: str | Path) -> str:
    """Return one spelling for all names of a target: absolute, without ``..``, links and file://."""
    if is_url(name):
        return url_of(name)
    path = Path(local_path(name)).absolute()
    return str(Path(os.path.realpath(path.parent)) / path.name)


@dataclass(slots=True, kw_only=True)
class Done:
    """What is remembered of a finished conversion.

    Parameters
    ----------
    target
        `place_of` the target.
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


class State:
    """What was begun and done, by `place_of` the target, in JSON lines that are only added to.

    Of several lines about a target the last counts, and a line that was cut off counts as not written.

    Parameters
    ----------
    path
        The file; made where it is missing.

    Raises
    ------
    OSError
        It cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._done: dict[str, Done] = {}
        self._begun: dict[str, str | None] = {}
        path.touch()
        data = path.read_bytes()
        for line in data.split(b"\n"):
            try:
                self._take(json.loads(line))
            except (ValueError, KeyError, TypeError):
                continue
        if data and not data.endswith(b"\n"):
            self._append("\n")

    def find(self, target: str) -> Done | None:
        """Return what is remembered of a target that was finished."""
        return self._done.get(target)

    def owns(self, target: str, standing: str | None) -> bool:
        """Whether what stands at a target may be replaced, because this batch wrote it.

        Parameters
        ----------
        target
            `place_of` the target.
        standing
            Identity of what stands there, None for nothing.
        """
        if target in self._done:
            return True
        return target in self._begun and (standing is None or standing != self._begun[target])

    def begin(self, standing: Mapping[str, str | None]) -> None:
        """Note what is about to be converted, also if the power fails now.

        Parameters
        ----------
        standing
            Identity of what stands at each target before the first try, None for nothing. What stands there later, and is
            something else, was written by this batch.
        """
        new = {target: found for target, found in standing.items() if not self.owns(target, found)}
        if new:
            self._begun |= new
            self._append("".join(json.dumps({"begun": target, "before": found}) + "\n" for target, found in new.items()))

    def give_up(self, target: str, standing: str | None, *, is_foreign: bool = False) -> None:
        """Forget that a target was begun, if nothing came of it: what stands there later is not of this batch.

        Parameters
        ----------
        target, standing
            As of `owns`, after the last try.
        is_foreign
            Whether it is known that something else stands there.
        """
        if target in self._begun and (is_foreign or standing is None or standing == self._begun[target]):
            del self._begun[target]
            self._append(json.dumps({"given_up": target}) + "\n")

    def keep(self, done: Done) -> None:
        """Remember a finished conversion, also if the power fails now."""
        self._done[done.target] = done
        self._begun.pop(done.target, None)
        self._append(json.dumps(asdict(done)) + "\n")

    def _take(self, said: dict[str, Any]) -> None:
        """Take in a line."""
        if "begun" in said:
            self._begun[said["begun"]] = said["before"]
        elif "given_up" in said:
            self._begun.pop(said["given_up"], None)
        else:
            said["sources"] = [tuple(each) for each in said["sources"]]
            done = Done(**said)
            self._done[done.target] = done
            self._begun.pop(done.target, None)

    def _append(self, text: str) -> None:
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
