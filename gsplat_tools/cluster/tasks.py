"""What workers do for a sequence: functions of frames and of what was found before, the same wherever they run."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.cluster.checking import CheckedSegment, Checks
from gsplat_tools.cluster.parts import Part, read_part, temporary_data, write_part
from gsplat_tools.formats._limits import use_max_memory
from gsplat_tools.formats._stores import identity
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.base import FileInfo
from gsplat_tools.formats.loading import inspect_file, open_scene
from gsplat_tools.formats.preparing import SaveChoices
from gsplat_tools.formats.preparing_frames import FrameFacts, FrameFit, Kept, decide_fit, fitted_sequence, look_at_frame
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.sequences import check_frame, load_frame
from gsplat_tools.formats.sog4d.codebooks import Shared, fit_shared
from gsplat_tools.formats.sog4d.encode import Frames
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.sampling import Sample, draw_frame, merge_samples
from gsplat_tools.formats.sog4d.segments import (
    SegmentFacts,
    compress_image,
    data_compression,
    image_compression,
    segment_images,
)
from gsplat_tools.parallel import map_ordered
from gsplat_tools.sequence import GaussianSequence

FORMAT = FORMATS["sog4d"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSource:
    """Where the frames are; a still scene is one.

    Parameters
    ----------
    files
        One a frame, in order.
    first
        What the header of the first says.
    max_memory
        As `use_max_memory` takes it.
    """

    files: tuple[str, ...]
    first: FileInfo
    max_memory: int | None = None

    def load(self, frame_id: int) -> GaussianCloud:
        """Return a frame as its file holds it."""
        with use_max_memory(self.max_memory):
            return load_frame(Path(self.files[frame_id]), frame_id, self.first)

    @contextmanager
    def chunks(self) -> Iterator[CloudChunks]:
        """Open the first file in chunks, invalid splats included."""
        with use_max_memory(self.max_memory), open_scene(Path(self.files[0]), in_chunks=True) as scene:
            assert isinstance(scene, CloudChunks)
            yield scene

    def fitted(self, fit: FrameFit) -> GaussianSequence:
        """Return the frames as they are to be written."""
        found = GaussianSequence(
            self.load, num_splats=self.first.splats, sh_degree=self.first.sh_degree, num_frames=len(self.files)
        )
        return fitted_sequence(found, fit)


def identify_frames(source: FrameSource, start: int, stop: int) -> list[str]:
    """Return what tells each file from a later one of the same name; refuse headers unlike the first."""
    found = []
    for frame_id in range(start, stop):
        path = Path(source.files[frame_id])
        found.append(identity(path))
        if frame_id:
            with use_max_memory(source.max_memory):
                record, info = inspect_file(path)
            check_frame(source.first, record, info, Path(source.files[0]), path, frame_id)
    return found


def look_at_frames(source: FrameSource, start: int, stop: int, choices: SaveChoices, keeps: Any = None) -> list[FrameFacts]:
    """Return what each frame tells about splats that may stay, or with `keeps` about those that do."""
    return [look_at_frame(source.load(frame_id), choices, keeps) for frame_id in range(start, stop)]


def decide(source: FrameSource, kept: Kept, choices: SaveChoices) -> FrameFit:
    """Return how all frames are fitted."""
    return decide_fit(source.load(0), kept, FORMAT, choices)


def draw_frames(source: FrameSource, start: int, stop: int, fit: FrameFit, seed: int) -> list[Sample]:
    """Return the splats that codebooks are fitted on, frame by frame."""
    frames = Frames(source.fitted(fit))
    return [draw_frame(frames[frame_id], frame_id, len(source.files), seed) for frame_id in range(start, stop)]


def fit_codebooks(
    source: FrameSource, fit: FrameFit, options: Sog4dOptions, layout: tuple[int, int], *parts: list[Sample]
) -> Shared:
    """Return what all frames share, from the samples of all frames in their order."""
    sample = merge_samples([each for part in parts for each in part])
    return fit_shared(sample, Frames(source.fitted(fit))[0], options, layout)


def encode_segment(
    source: FrameSource,
    fit: FrameFit,
    shared: Shared,
    segment: tuple[int, int],
    path: str,
    key: str,
    run: str,
    uses_deltas: bool,
    checks: Checks | None,
) -> Part:
    """Encode a segment to a part, unless an earlier run or try left it; with `checks`, hold it against its source first."""
    found = read_part(path, key, run)
    if found is not None:
        return found
    start, options = time.perf_counter(), shared.options
    frames = _Timed(Frames(source.fitted(fit)))
    facts = SegmentFacts()
    with temporary_data(), tempfile.TemporaryFile() as body, CheckedSegment(shared, segment, checks) as alone:
        archive = ZipWriter(body)
        images = segment_images(frames.load, segment, shared, facts, uses_deltas=uses_deltas)
        for name, data in map_ordered(partial(compress_image, effort=options.webp_effort), images):
            archive.add(name, data, image_compression(options))
            alone.add(name, data)
        num_images = archive.size
        deltas = {}
        for name, data in facts.deltas.items():
            offset = archive.size
            archive.add(name, data, data_compression(options))
            deltas[name] = (offset, archive.size - offset)
        encoded = time.perf_counter()
        reading = frames.seconds
        alone.check(source.fitted(fit), facts, uses_deltas=uses_deltas)
        checked = time.perf_counter()
        part = Part(
            path=path,
            key=key,
            entries=archive.entries,
            images=num_images,
            deltas=deltas,
            facts=facts,
            tally=alone.tally,
            views=alone.views,
            seconds={"read": reading, "encode": encoded - start - reading, "validate": checked - encoded},
            run=run,
        )
        write_part(part, body)
    part.seconds["write"] = time.perf_counter() - checked
    part.facts.deltas = {}  # they are in the file, and need not travel
    return part


class _Timed:
    """Frames, and the seconds that it took to load them."""

    def __init__(self, frames: Frames) -> None:
        self._frames = frames
        self.seconds = 0.0

    def load(self, frame_id: int) -> GaussianCloud:
        start = time.perf_counter()
        cloud = self._frames[frame_id]
        self.seconds += time.perf_counter() - start
        return cloud
