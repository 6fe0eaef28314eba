"""The part of a bundle that one segment makes, as a file of its own between a worker and the assembly.

Layout: the entries as they will stand in the archive, then JSON that describes them, then its length (8 bytes, little
endian), the SHA-256 of everything before, and a magic number. A file that was cut off or changed is no part.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsplat_tools.comparison.attributes import AttributeStatistics, AttributeTally
from gsplat_tools.comparison.rendered import ViewReport
from gsplat_tools.errors import CorruptDataError
from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats._files import open_source_file
from gsplat_tools.formats._stores import exists, is_url, replacing_object
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats._zip import Entry
from gsplat_tools.formats.sog4d.segments import SegmentFacts

MAGIC = b"GSPART01"
_TAIL = 8 + 32 + len(MAGIC)
_BLOCK = 4 << 20


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
    kept: bool = False

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
            "tally": None if self.tally is None else {name: asdict(each) for name, each in self.tally.attributes.items()},
            "views": [asdict(view) for view in self.views],
            "seconds": self.seconds,
        }


def part_from_json(path: str, said: dict[str, Any]) -> Part:
    """Return what `Part.to_json` gave."""
    tally = None
    if said["tally"] is not None:
        tally = AttributeTally()
        tally.attributes = {name: AttributeStatistics(**each) for name, each in said["tally"].items()}
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
        tally=tally,
        views=[ViewReport(**view) for view in said["views"]],
        seconds=said["seconds"],
        kept=True,
    )


def write_part(part: Part, body: BinaryIO) -> None:
    """Write a part whose entries are in `body`; it appears whole or not at all."""
    opened = replacing_object(part.path, overwrite=True) if is_url(part.path) else replacing(Path(part.path), overwrite=True)
    digest = hashlib.sha256()
    body.seek(0)
    with opened as stream:
        while block := body.read(_BLOCK):
            digest.update(block)
            stream.write(block)
        text = json.dumps(part.to_json()).encode()
        said = text + len(text).to_bytes(8, "little")
        digest.update(said)
        stream.write(said + digest.digest() + MAGIC)


def read_part(path: str, key: str) -> Part | None:
    """Return the part that an earlier run left, after reading all its bytes; None where there is none that can be used."""
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
            part = part_from_json(path, json.loads(read_exactly(stream, length, field="part")))
    except (CorruptDataError, FileNotFoundError, ValueError, KeyError, TypeError):
        return None
    return part if part.key == key else None


def part_bytes(path: str, start: int, size: int) -> Iterator[bytes]:
    """Yield bytes of a part in blocks, read by range."""
    with closing(open_source_file(Path(path))) as stream:
        stream.seek(start)
        while size:
            block = read_exactly(stream, min(size, _BLOCK), field="part")
            size -= len(block)
            yield block
