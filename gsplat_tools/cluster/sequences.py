"""A long sequence to a bundle: frames looked at, codebooks fitted and segments encoded as tasks, parts joined in order."""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_tools.cluster import tasks
from gsplat_tools.cluster.assembling import assemble, check_published, folder_of_parts, remove_parts
from gsplat_tools.cluster.checking import Checks, checks_of
from gsplat_tools.cluster.engines import Engine
from gsplat_tools.cluster.outcomes import warn_again
from gsplat_tools.cluster.parts import Part
from gsplat_tools.cluster.runs import ClusterReport, Stages, bundle_target, check_alike, judge, key_of
from gsplat_tools.convert import unique_warnings
from gsplat_tools.errors import CapabilityError, GsplatWarning
from gsplat_tools.formats._limits import max_memory
from gsplat_tools.formats._stores import is_url, local_path, url_of
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.preparing import SaveChoices
from gsplat_tools.formats.preparing_frames import Kept, kept_splats, with_scan
from gsplat_tools.formats.saving import DEFAULT_PRESET, split_options
from gsplat_tools.formats.sequences import frame_files
from gsplat_tools.formats.sog4d.codebooks import Shared
from gsplat_tools.formats.sog4d.encode import choose_layout, choose_times, last_entries, warn_clipped
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.segments import choose_segments, has_deltas
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.verification import DEFAULT_VALIDATION, Validation

_TASKS_A_WORKER = 8
_MOST_FRAMES = 64
"""Of a task that only looks at frames."""


def convert_sequence(
    sources: Sequence[str | Path],
    target: str | Path,
    engine: Engine,
    *,
    overwrite: bool = False,
    preset: str = DEFAULT_PRESET,
    validation: Validation | None = DEFAULT_VALIDATION,
    parts: str | None = None,
    **options: Any,
) -> ClusterReport:
    """Convert frames to a .sog4d bundle; the same bytes as `convert` gives, wherever the tasks run.

    Parameters
    ----------
    sources
        Frames: several files or URLs, a folder, or a pattern. Workers must see them under the same names.
    target
        File or URL to write; this process assembles it.
    engine
        Where the tasks run.
    overwrite
        Replace a target that is there.
    preset
        As `convert` takes it.
    validation
        How every segment is checked before the bundle is published; None checks nothing.
    parts
        Folder or URL for finished segments, which workers and this process see; by default beside the target. A run that
        ended early leaves them, and the next one continues there; they are removed once the bundle is published.
    **options
        Choices of `SaveChoices` and write options of the format; `frame_times` as `convert` takes them.

    Returns
    -------
    ClusterReport
        As of `convert`, and the seconds and bytes of every stage.

    Raises
    ------
    GsplatError
        As `convert`.
    ClusterError
        Workers or the connection to them were lost for good; the same call continues.
    """
    start = time.perf_counter()
    target = bundle_target(target, None, "a cluster makes one .sog4d bundle of a sequence", overwrite=overwrite)
    record = tasks.FORMAT
    frame_times = options.pop("frame_times", None)
    choices, write_options = split_options(record, preset, options)
    files = frame_files([local_path(each) for each in sources])
    first_record, first = inspect_file(files[0])
    if first_record.holds_sequences and first.frames > 1:
        raise CapabilityError("a bundle is converted on one machine; leave out --scheduler", path=files[0])
    names = tuple(url_of(path) if is_url(path) else str(path.absolute()) for path in files)
    source = tasks.FrameSource(files=names, first=first, max_memory=max_memory())
    times = choose_times(_times_of(source, frame_times), len(files), write_options)
    stages = Stages(engine)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        check_alike(engine)
        job = _Job(source, choices, write_options, stages, checks_of(record.model, len(files), validation))
        kept, fit, shared = job.fit()
        looked = time.perf_counter()
        folder = folder_of_parts(target, parts)
        found = job.encode(fit, shared, folder)
        encoded = time.perf_counter()
        busy = [sum(part.seconds.get(name, 0) for part in found) for name in ("validate", "read", "encode", "write")]
        checking = busy[0] / (sum(busy) or 1)
        validated = judge(
            [view for part in found for view in part.views], [part.tally for part in found], validation, record.model
        )
        warn_again(stages.outcomes)
        facts = [part.facts for part in found]
        warn_clipped(facts)
        shared_here: Shared = next(iter(stages.run("collect", "fetching codebooks", [shared], [0])))
        num_splats = int(np.count_nonzero(kept.keeps))
        entries = last_entries(shared_here, num_splats, job.segments, times, facts, uses_deltas=job.uses_deltas)
        assembling = time.perf_counter()
        size, digest = assemble(target, found, entries, shared_here, overwrite=overwrite)
        stages.note("assemble", seconds=time.perf_counter() - assembling, bytes=size)
        if not is_url(target):
            check_published(target, num_splats, len(files), shared_here.bands)
        remove_parts(folder)
    return ClusterReport(
        source=", ".join(map(url_of, sources)),
        source_format=first_record.id,
        path=target,
        format=record.id,
        bytes=size,
        splats=num_splats,
        sh_degree=shared_here.bands,
        frames=len(files),
        dropped=kept.dropped,
        warnings=unique_warnings(caught),
        seconds={
            "read": looked - start,
            "encode": (encoded - looked) * (1 - checking),
            "write": time.perf_counter() - encoded,
            "validate": (encoded - looked) * checking,
        },
        validation=validated,
        options={name: getattr(write_options, name) for name in write_options.__dataclass_fields__},
        cluster={
            "scheduler": engine.name,
            "workers": engine.workers,
            "dashboard": engine.dashboard,
            "segments": len(found),
            "kept_segments": sum(part.kept for part in found),
            "retried": engine.retried,
            "sha256": digest,
            "stages": stages.spent,
        },
    )


class _Job:
    """The tasks of one sequence."""

    def __init__(
        self, source: tasks.FrameSource, choices: SaveChoices, options: Sog4dOptions, stages: Stages, checks: Checks | None
    ) -> None:
        self.source, self.choices, self.options, self.stages, self.checks = source, choices, options, stages, checks
        self.num_frames = len(source.files)
        self.segments = choose_segments(self.num_frames, options.delta_segment_length)
        self.uses_deltas = has_deltas(self.num_frames, options)
        step = min(_MOST_FRAMES, max(1, -(-self.num_frames // (_TASKS_A_WORKER * stages.engine.workers))))
        self.batches = [(start, min(start + step, self.num_frames)) for start in range(0, self.num_frames, step)]

    def fit(self) -> tuple[Kept, Any, Any]:
        """Return which splats stay, and the tasks that fit frames and codebooks."""
        self.identities = self._over_frames("identify", "looking for frames", tasks.identify_frames)
        self.frame_bytes = [int(each.split()[0]) for each in self.identities]
        self.stages.note("look", bytes_read=sum(self.frame_bytes))
        facts = self._over_frames("look", "checking frames", tasks.look_at_frames, self.choices)
        kept = kept_splats(facts, self.source.first.splats, self.choices)
        if not kept.keeps.any():
            raise CapabilityError("a .sog4d bundle needs at least one splat, and none is left to write")
        if not kept.keeps.all():
            self.stages.note("look", bytes_read=sum(self.frame_bytes))
            kept = with_scan(kept, self._over_frames("look", "checking frames", tasks.look_at_frames, self.choices, kept.keeps))
        layout = choose_layout(int(np.count_nonzero(kept.keeps)), self.options)
        self.stages.note("fit", bytes_read=sum(self.frame_bytes))
        submit = self.stages.engine.submit
        fit = submit(tasks.decide, self.source, kept, self.choices)
        # The samples stay where they are drawn until the codebooks are fitted.
        drawn = [submit(tasks.draw_frames, self.source, *batch, fit, self.options.seed) for batch in self.batches]
        shared = submit(tasks.fit_codebooks, self.source, fit, self.options, layout, *drawn)
        for _ in self.stages.run("fit", "fitting codebooks", [fit, shared], [0, self.num_frames]):
            pass
        return kept, fit, shared

    def encode(self, fit: Any, shared: Any, folder: str) -> list[Part]:
        """Encode all segments to parts in a folder."""
        key = self._key()
        if not is_url(folder):
            Path(folder).mkdir(parents=True, exist_ok=True)
        pending, sizes = [], []
        for segment in self.segments:
            own = hashlib.sha256(f"{key} {segment}".encode()).hexdigest()
            path = f"{folder}/{segment[0]:06d}-{own[:16]}.part"
            arguments = (self.source, fit, shared, segment, path, own, self.stages.run_id, self.uses_deltas, self.checks)
            pending.append(self.stages.engine.submit(tasks.encode_segment, *arguments))
            sizes.append(segment[1])
        found: list[Part] = list(self.stages.run("encode", "encoding", pending, sizes))
        passes = 1 if self.checks is None else 2
        for part, (start, count) in zip(found, self.segments, strict=True):
            if not part.kept:
                self.stages.note(
                    "encode",
                    bytes_read=passes * sum(self.frame_bytes[start : start + count]),
                    bytes_written=part.stored_size,
                    **{f"{name}_seconds": spent for name, spent in part.seconds.items()},
                )
        return found

    def _over_frames(self, name: str, label: str, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return what a task returns for every frame."""
        pending = [self.stages.engine.submit(function, self.source, *batch, *arguments) for batch in self.batches]
        sizes = [stop - start for start, stop in self.batches]
        return [each for batch in self.stages.run(name, label, pending, sizes) for each in batch]

    def _key(self) -> str:
        """Return a digest of everything that the bytes of parts, and what was checked, follow from."""
        described = {
            "frames": list(zip(self.source.files, self.identities, strict=True)),
            "choices": repr(self.choices),
            "options": repr(self.options),
            "checks": None if self.checks is None else asdict(self.checks),
        }
        return key_of(described)


def _times_of(source: tasks.FrameSource, frame_times: Any) -> GaussianSequence:
    """Return a sequence that has the right times; its frames are not asked for."""
    count = len(source.files)
    if frame_times is not None and len(frame_times) != count:
        raise CapabilityError(f"frame_times needs one time a frame, {count}, and has {len(frame_times)}")
    return GaussianSequence(
        source.load, num_splats=source.first.splats, sh_degree=source.first.sh_degree, frame_times=frame_times, num_frames=count
    )
