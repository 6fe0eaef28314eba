"""A segment as a bundle of its own, read back and held against its source before the whole bundle is there."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison.attributes import AttributeTally
from gsplat_tools.comparison.rendered import ViewReport, compare_rendered
from gsplat_tools.errors import ValidationError
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.sog4d.codebooks import Shared
from gsplat_tools.formats.sog4d.encode import last_entries
from gsplat_tools.formats.sog4d.labels import moved_delta
from gsplat_tools.formats.sog4d.options import Sog4dReadOptions
from gsplat_tools.formats.sog4d.segments import SegmentFacts, delta_path
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.verification import VALIDATED_FRAMES, Validation


@dataclass(frozen=True, slots=True, kw_only=True)
class Checks:
    """How segments are checked.

    Parameters
    ----------
    frames
        Frames whose pictures are compared.
    views, size, model
        Automatic views around the first frame, their size in px, rendering model and variant.
    """

    frames: tuple[int, ...]
    views: int
    size: tuple[int, int]
    model: tuple[str, str | None]


def checks_of(model: tuple[str, str | None], num_frames: int, validation: Validation | None) -> Checks | None:
    """Return how segments are checked."""
    if validation is None:
        return None
    rendered = np.linspace(0, num_frames - 1, VALIDATED_FRAMES).round().astype(int).tolist()
    chosen = model if validation.model is None else (validation.model, None)
    return Checks(frames=tuple(sorted(set(rendered))), views=validation.views, size=validation.size, model=chosen)


class CheckedSegment:
    """Gathers a copy of a segment's images, and checks them; without checks it does nothing.

    Parameters
    ----------
    shared
        What all frames share.
    segment
        (start, number of frames).
    checks
        How, or None.
    """

    def __init__(self, shared: Shared, segment: tuple[int, int], checks: Checks | None) -> None:
        self.tally: AttributeTally | None = None
        self.views: list[ViewReport] = []
        self._shared, self._segment, self._checks = shared, segment, checks

    def __enter__(self) -> CheckedSegment:
        if self._checks is not None:
            self._file = tempfile.NamedTemporaryFile(suffix=".sog4d")
            self._archive = ZipWriter(self._file)  # type: ignore[arg-type] # a file in all but its type
        return self

    def __exit__(self, _type: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None) -> None:
        if self._checks is not None:
            self._file.close()

    def add(self, name: str, data: bytes) -> None:
        """Take an image, as if the segment began at frame 0."""
        if self._checks is not None:
            folder, frame, stream = name.split("/")
            self._archive.add(f"{folder}/{int(frame) - self._segment[0]:05d}/{stream}", data, "stored")

    def check(self, source: GaussianSequence, facts: SegmentFacts, *, uses_deltas: bool) -> None:
        """Hold every value against its bound, and draw both sides of some frames.

        Parameters
        ----------
        source
            All frames as they were given to the encoder.
        facts
            What encoding left of the segment.
        uses_deltas
            Whether labels are stored as changes.

        Raises
        ------
        ValidationError
            A bound is exceeded.
        """
        if self._checks is None:
            return
        start, count = self._segment
        entries = last_entries(self._shared, source.num_splats, [(0, count)], None, [facts], uses_deltas=uses_deltas)
        for palette in self._shared.palettes if uses_deltas else ():
            entries[delta_path(palette.name, 0)] = moved_delta(facts.deltas[delta_path(palette.name, start)], 0)
        for name, data in entries.items():
            self._archive.add(name, data, "stored")
        self._archive.close()
        self._file.flush()
        record = FORMATS["sog4d"]
        assert record.read is not None
        assert record.bounds is not None
        tally, pairs = AttributeTally(), []
        with Path(self._file.name).open("rb") as stream:
            decoded: Any = record.read(stream, Sog4dReadOptions())
            for index in range(count):
                before, after = source.frame(start + index), decoded.frame(index)
                tally.add(before, after, record.bounds(before, stream, index))
                if start + index in self._checks.frames:
                    pairs.append((f"frame {start + index} " if len(source) > 1 else "", before, after))
        exceeded = tally.exceeded()
        if exceeded:
            raise ValidationError(f"what was written leaves its derived bounds: {'; '.join(exceeded)}", frame=start)
        self.tally = tally
        if pairs and self._checks.views > 0:
            self.views = _compare(pairs, source.frame(0), self._checks)


def _compare(pairs: list[tuple[str, GaussianCloud, GaussianCloud]], first: GaussianCloud, checks: Checks) -> list[ViewReport]:
    """Draw both sides from the views around the first frame."""
    from gsplat_tools.reference.auto_cameras import auto_cameras

    cameras = auto_cameras(first, views=checks.views, size=checks.size)
    return list(compare_rendered(pairs, cameras, checks.model, num_pairs=len(pairs)).views)


def merged_tally(tallies: list[AttributeTally]) -> AttributeTally:
    """Return the errors of all segments, in their order."""
    merged = AttributeTally()
    for tally in tallies:
        for name, each in tally.attributes.items():
            whole = merged.attributes.setdefault(name, type(each)())
            whole.count += each.count
            whole.max = max(whole.max, each.max)
            whole.sum += each.sum
            whole.sum_squares += each.sum_squares
            bounds = [bound for bound in (whole.bound, each.bound) if bound is not None]
            whole.bound = max(bounds, default=None)
            whole.exceeded += each.exceeded
    return merged
