"""Parts: what a worker leaves for later tasks, the assembly and the next run, each a file of its own.

Layout: the bytes, then JSON that describes them, then its length (8 bytes, little endian), the SHA-256 of everything before,
and a magic number. A file that was cut off or changed is no part. The part of a segment holds entries as they will stand
in the archive.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsplat_tools.comparison.attributes import AttributeStatistics, AttributeTally
from gsplat_tools.comparison.rendered import ViewReport
from gsplat_tools.errors import ClusterError, CorruptDataError, ReadError, WriteError
from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats._files import open_source_file, reason
from gsplat_tools.formats._stores import exists, is_url, replacing_object
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats._zip import Entry
from gsplat_tools.formats.sog4d.segments import SegmentFacts

MAGIC = b"GSPART01"
_TAIL = 8 + 32 + len(MAGIC)
_BLOCK = 4 << 20


class Hashed:
    """A stream that is written from start to end, and its SHA-256."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.digest = hashlib.sha256()
        self.size = 0

    def seekable(self) -> bool:
        """Return False: nothing is written again."""
        return False

    def tell(self) -> int:
        """Return the number of bytes so far."""
        return self.size

    def write(self, data: Any) -> int:
        """Append bytes."""
        view = memoryview(data).cast("B")
        self._stream.write(view)
        self.digest.update(view)
        self.size += len(view)
        return len(view)

    def flush(self) -> None:
        """Do nothing: the stream below knows when."""


@contextmanager
def sealed(path: str, said: dict[str, Any]) -> Iterator[Hashed]:
    """Open a part that appears, whole, when the block ends; it says `said` about itself."""
    opened = replacing_object(path, overwrite=True) if is_url(path) else replacing(Path(path), overwrite=True)
    with opened as stream:
        body = Hashed(stream)
        yield body
        text = json.dumps(said).encode()
        body.write(text + len(text).to_bytes(8, "little"))
        stream.write(body.digest.digest() + MAGIC)


def read_sealed(path: str, key: str) -> dict[str, Any] | None:
    """Return what a part says about itself, after reading all its bytes; None where there is none of that key."""
    if not exists(path):
        return None
    try:
        with closing(open_source_file(Path(path))) as stream:
            size = stream_size(stream)
            if size < _TAIL:
                return None
            digest = hashlib.sha256()
            left = size - _TAIL + 8
            while left:
                block = read_exactly(stream, min(left, _BLOCK), field="part")
                digest.update(block)
                left -= len(block)
            if read_exactly(stream, _TAIL - 8, field="part") != digest.digest() + MAGIC:
                return None
            stream.seek(size - _TAIL)
            length = int.from_bytes(read_exactly(stream, 8, field="part"), "little")
            stream.seek(size - _TAIL - length)
            said: dict[str, Any] = json.loads(read_exactly(stream, length, field="part"))
    except (CorruptDataError, FileNotFoundError, ValueError):
        return None
    return said if said.get("key") == key else None


@dataclass(slots=True, kw_only=True)
class Part:
    """What is known of a part.

    Parameters
    ----------
    path
        Where it lies.
    key
        Digest of everything that its bytes follow from.
    entries
        Records of all entries; delta files stand behind the images.
    images
        Bytes of the images with their headers, from the start.
    deltas
        (offset, bytes) of each delta file with its header, by entry name.
    facts
        Ranges and counts for meta.json.
    tally, views
        Errors against the source and pictures of its frames, where it was checked.
    seconds
        What it took to make.
    run
        The run that made it.
    kept
        Whether it was there from an earlier run.
    """

    path: str
    key: str
    entries: list[Entry]
    images: int
    deltas: dict[str, tuple[int, int]]
    facts: SegmentFacts
    tally: AttributeTally | None = None
    views: list[ViewReport] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    run: str = ""
    kept: bool = False

    @property
    def stored_size(self) -> int:
        """Bytes of all entries."""
        return max(entry.offset + entry.stored_size for entry in self.entries)

    def to_json(self) -> dict[str, Any]:
        """Return what the file says about itself."""
        facts = self.facts
        return {
            "key": self.key,
            "entries": [list(asdict(entry).values()) for entry in self.entries],
            "images": self.images,
            "deltas": self.deltas,
            "ranges": [[low.tolist(), high.tolist()] for low, high in facts.ranges],
            "sources": sorted(facts.sources),
            "clipped": facts.clipped,
            "tally": tally_to_json(self.tally),
            "views": [asdict(view) for view in self.views],
            "seconds": self.seconds,
            "run": self.run,
        }


def tally_to_json(tally: AttributeTally | None) -> dict[str, Any] | None:
    """Return errors so that they can be added up later."""
    return None if tally is None else {name: asdict(each) for name, each in tally.attributes.items()}


def tally_from_json(said: dict[str, Any] | None) -> AttributeTally | None:
    """Return what `tally_to_json` gave."""
    if said is None:
        return None
    tally = AttributeTally()
    tally.attributes = {name: AttributeStatistics(**each) for name, each in said.items()}
    return tally


def part_from_json(path: str, said: dict[str, Any], run: str) -> Part:
    """Return what `Part.to_json` gave; of the same run it is not kept: its worker died after it was made."""
    facts = SegmentFacts(
        ranges=[(np.array(low, np.float32), np.array(high, np.float32)) for low, high in said["ranges"]],
        sources=set(said["sources"]),
        clipped=said["clipped"],
    )
    return Part(
        path=path,
        key=said["key"],
        entries=[Entry(*each) for each in said["entries"]],
        images=said["images"],
        deltas={name: (start, size) for name, (start, size) in said["deltas"].items()},
        facts=facts,
        tally=tally_from_json(said["tally"]),
        views=[ViewReport(**view) for view in said["views"]],
        seconds=said["seconds"],
        run=said.get("run", ""),
        kept=said.get("run") != run,
    )


def write_part(part: Part, body: BinaryIO) -> None:
    """Write a part whose entries are in `body`; it appears whole or not at all."""
    body.seek(0)
    with sealed(part.path, part.to_json()) as stream:
        while block := body.read(_BLOCK):
            stream.write(block)


def read_part(path: str, key: str, run: str) -> Part | None:
    """Return the part that an earlier run or try left, after reading all its bytes; None where none can be used."""
    said = read_sealed(path, key)
    try:
        return None if said is None else part_from_json(path, said, run)
    except (ValueError, KeyError, TypeError):
        return None


def part_bytes(path: str, start: int, size: int, step: int = _BLOCK) -> Iterator[bytes]:
    """Yield bytes of a part in blocks of `step`, read by range.

    Raises
    ------
    ClusterError
        It went missing.
    """
    try:
        stream = open_source_file(Path(path))
    except FileNotFoundError as error:
        message = "a finished part is gone; is the folder of parts one that all workers and this machine share? See --parts"
        raise ClusterError(message, path=path) from error
    with closing(stream):
        stream.seek(start)
        while size:
            block = read_exactly(stream, min(size, step), field="part")
            size -= len(block)
            yield block


@contextmanager
def temporary_data() -> Iterator[None]:
    """Turn what the operating system refuses a worker into an error that says where."""
    try:
        yield
    except OSError as error:
        if isinstance(error, ReadError | WriteError | FileNotFoundError):
            raise
        raise WriteError(f"cannot write temporary data: {reason(error)}", path=tempfile.gettempdir()) from error
