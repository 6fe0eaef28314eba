"""A still scene larger than memory to a bundle: arranged on the disk, encoded block by block as tasks, joined in order."""

from __future__ import annotations

import hashlib
import time
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsplat_tools.cloud import empty_cloud
from gsplat_tools.cluster import block_tasks, tasks
from gsplat_tools.cluster.arranging import Arrangement, Look, arrange, look_at_scene
from gsplat_tools.cluster.assembling import assemble, check_published, folder_of_parts, remove_parts
from gsplat_tools.cluster.block_tasks import CodePart
from gsplat_tools.cluster.checking import Checks, checks_of
from gsplat_tools.cluster.engines import Engine
from gsplat_tools.cluster.outcomes import warn_again
from gsplat_tools.cluster.parts import Part
from gsplat_tools.cluster.runs import ClusterReport, Stages, bundle_target, check_alike, judge, key_of
from gsplat_tools.convert import unique_warnings
from gsplat_tools.errors import CapabilityError, GsplatWarning, ReadError
from gsplat_tools.formats._limits import max_memory
from gsplat_tools.formats._stores import identity, is_url, local_path, url_of
from gsplat_tools.formats.base import FileInfo, Format
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.preparing import SaveChoices
from gsplat_tools.formats.saving import DEFAULT_PRESET, split_options
from gsplat_tools.formats.sog4d import labels as label_files
from gsplat_tools.formats.sog4d.codebooks import Shared
from gsplat_tools.formats.sog4d.encode import choose_layout, choose_times, last_entries, warn_clipped
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.segments import delta_path, has_deltas
from gsplat_tools.parallel import BLOCK_SIZE
from gsplat_tools.tuning.auto import zero_bands
from gsplat_tools.verification import DEFAULT_VALIDATION, Validation

DEFAULT_BLOCK_SPLATS = 1 << 20
"""Splats of a block: 250 MB of rows at SH degree 3."""


class WholeSceneError(CapabilityError):
    """A conversion needs the whole scene in memory, and cannot be done in blocks."""

    def __init__(self, reason: str, path: Path | None = None) -> None:
        super().__init__(f"this conversion cannot be done in blocks: {reason}; leave out --block-splats", path=path)


def convert_blocks(
    source: str | Path,
    target: str | Path,
    engine: Engine,
    *,
    to: str | None = None,
    overwrite: bool = False,
    preset: str = DEFAULT_PRESET,
    validation: Validation | None = DEFAULT_VALIDATION,
    parts: str | None = None,
    block_splats: int = DEFAULT_BLOCK_SPLATS,
    **options: Any,
) -> ClusterReport:
    """Convert a still scene to a .sog4d bundle; the same bytes as `convert` gives, in as much memory as a block needs.

    Parameters
    ----------
    source
        A file or URL that is read in chunks. Workers must see it under the same name.
    target
        File or URL to write; this process assembles it.
    engine
        Where the tasks run.
    to
        "sog4d", where the target's name does not say so.
    overwrite
        Replace a target that is there.
    preset
        As `convert` takes it.
    validation
        How codes, images and pictures are checked before the bundle is published; None checks nothing. Pictures show at most
        `comparison.rendered.MAX_RENDERED` splats.
    parts
        Folder or URL for rows, finished blocks and images, which workers and this process see; by default beside the target.
        A run that ended early leaves them, and the next one continues there; they are removed once the bundle is published.
    block_splats
        Splats of a block, rounded up to a multiple of 16,384; has no effect on the bytes.
    **options
        Choices of `SaveChoices` and write options of the format.

    Returns
    -------
    ClusterReport
        As of `convert`, and the seconds and bytes of every stage.

    Raises
    ------
    GsplatError
        As `convert`.
    WholeSceneError
        The source is not read in chunks, or options look at all splats at once: outliers, a visual tolerance, times.
    ClusterError
        Workers or the connection to them were lost for good; the same call continues.
    """
    start = time.perf_counter()
    target = bundle_target(target, to, "a scene in blocks becomes a .sog4d bundle", overwrite=overwrite)
    record = tasks.FORMAT
    if block_splats < 1:
        raise CapabilityError(f"a block needs at least one splat, got {block_splats}")
    path = Path(local_path(source))
    choices, write_options = split_options(record, preset, options)
    source_record, first = _inspected(path, choices, write_options)
    name = url_of(path) if is_url(path) else str(path.absolute())
    stages = Stages(engine)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        check_alike(engine)
        job = _Job(
            tasks.FrameSource(files=(name,), first=first, max_memory=max_memory()),
            choices,
            write_options,
            stages,
            checks_of(record.model, 1, validation),
            folder_of_parts(target, parts),
            -(-block_splats // BLOCK_SIZE) * BLOCK_SIZE,
        )
        look, arrangement = job.arrange()
        arranged = time.perf_counter()
        blocks, shared = job.encode(arrangement)
        images = job.compress(arrangement, blocks)
        encoded = time.perf_counter()
        spent = [part.seconds for part in blocks] + [part.seconds for part in images]
        busy = [sum(each.get(what, 0) for each in spent) for what in ("validate", "read", "encode")]
        checking = busy[0] / (sum(busy) or 1) * (encoded - arranged)
        validated = job.judge(arrangement, blocks, validation, record.model)
        drawn = time.perf_counter()
        warn_again(stages.outcomes)
        facts = block_tasks.facts_of(arrangement, [block.clipped for block in blocks])
        warn_clipped([facts])
        uses_deltas = has_deltas(1, write_options)
        times = choose_times(empty_cloud(0, 0), 1, write_options)  # of a still scene, whichever
        entries = last_entries(shared, arrangement.num_splats, [(0, 1)], times, [facts], uses_deltas=uses_deltas)
        for palette in shared.palettes if uses_deltas else ():
            entries[delta_path(palette.name, 0)] = label_files.write_delta(
                (0, 1), arrangement.num_splats, len(palette.centroids), []
            )
        size, digest = assemble(target, images, entries, shared, overwrite=overwrite)
        stages.note("assemble", seconds=time.perf_counter() - drawn, bytes=size)
        if not is_url(target):
            check_published(target, arrangement.num_splats, 1, shared.bands)
        remove_parts(job.folder)
    lowers = options.get("sh_degree") in (None, "auto") and look.source_degree <= record.max_sh_degree
    return ClusterReport(
        source=url_of(source),
        source_format=source_record.id,
        path=target,
        format=record.id,
        bytes=size,
        splats=arrangement.num_splats,
        sh_degree=shared.bands,
        frames=1,
        dropped=dict(look.scan.dropped),
        warnings=unique_warnings(caught),
        seconds={
            "read": arranged - start,
            "encode": encoded - arranged - checking,
            "write": time.perf_counter() - drawn,
            "validate": checking + drawn - encoded,
        },
        validation=validated,
        options={each: getattr(write_options, each) for each in write_options.__dataclass_fields__},
        decisions=[zero_bands(look.source_degree, shared.bands)] if lowers and shared.bands < look.source_degree else [],
        cluster={
            "scheduler": engine.name,
            "workers": engine.workers,
            "dashboard": engine.dashboard,
            "blocks": len(blocks),
            "kept_blocks": sum(block.kept for block in blocks),
            "retried": engine.retried,
            "sha256": digest,
            "stages": stages.spent,
        },
    )


def _inspected(path: Path, choices: SaveChoices, options: Sog4dOptions) -> tuple[Format, FileInfo]:
    """Return what the header of the source says, if blocks will do."""
    if not is_url(path) and path.is_fifo():
        raise WholeSceneError("a pipe can be read once", path)
    record, info = inspect_file(path)
    if record.read_chunks is None:
        raise WholeSceneError(f"{record.title} is read whole", path)
    if options.frame_times is not None:
        raise WholeSceneError("times may bake the motion of the whole scene", path)
    if options.visual_tolerance > 0:
        raise WholeSceneError("a visual tolerance weighs the images of the whole scene", path)
    if choices.outliers == "drop":
        raise WholeSceneError("outliers are told from all splats", path)
    return record, info


class _Job:
    """The tasks of one scene."""

    def __init__(
        self,
        source: tasks.FrameSource,
        choices: SaveChoices,
        options: Sog4dOptions,
        stages: Stages,
        checks: Checks | None,
        folder: str,
        block_splats: int,
    ) -> None:
        self.source, self.choices, self.options, self.stages, self.checks = source, choices, options, stages, checks
        self.folder, self.block_splats = folder, block_splats
        self._shared: Any = None

    def arrange(self) -> tuple[Look, Arrangement]:
        """Look at the scene, and write its rows block by block."""
        name = self.source.files[0]
        before = identity(name)
        self._key = key_of(
            {
                "source": [name, before],
                "choices": repr(self.choices),
                "options": repr(self.options),
                "checks": None if self.checks is None else asdict(self.checks),
                "block_splats": self.block_splats,
            }
        )
        submit, count = self.stages.engine.submit, self.source.first.splats
        looking = submit(look_at_scene, self.source, self.choices)
        look: Look = self._only("look", "reading", looking, count)
        source_bytes = int(before.split()[0])
        self.stages.note("look", bytes_read=(1 if look.scan.view is None else 2) * source_bytes)
        if look.scan.num_kept < tasks.FORMAT.min_splats:
            raise CapabilityError(
                f"{tasks.FORMAT.title} holds at least {tasks.FORMAT.min_splats} splat, and none is left to write"
            )
        self.layout = choose_layout(look.scan.num_kept, self.options)
        if not is_url(self.folder):
            Path(self.folder).mkdir(parents=True, exist_ok=True)
        key = self._own("scene")
        arranging = submit(arrange, self.source, looking, self.choices, self.options, self.folder, key, self.block_splats)
        arrangement: Arrangement = self._only("arrange", "arranging", arranging, look.scan.num_kept)
        if not arrangement.kept:
            rows = arrangement.num_splats + sum(count for _, count in arrangement.drawn.values())
            self.stages.note("arrange", bytes_read=2 * source_bytes, bytes_written=rows * arrangement.row_bytes)
        if identity(name) != before:
            raise ReadError("the source changed while it was read; convert again", path=name)
        return look, arrangement

    def encode(self, arrangement: Arrangement) -> tuple[list[CodePart], Shared]:
        """Fit codebooks and encode all blocks; return their codes in order."""
        submit = self.stages.engine.submit
        self._shared = submit(block_tasks.fit_scene, arrangement, self.options, self.layout)
        shared: Shared = self._only("fit", "fitting codebooks", self._shared, 0)
        drawn = arrangement.drawn["sample"][1] + arrangement.drawn["pilot"][1]
        self.stages.note("fit", bytes_read=drawn * arrangement.row_bytes)
        pending, sizes = [], []
        for index in range(len(arrangement.digests)):
            own = self._own(f"block {index}")
            path = f"{self.folder}/{index:06d}-{own[:16]}.part"
            arguments = (arrangement, self._shared, index, path, own, self.stages.run_id, self.checks is not None)
            pending.append(submit(block_tasks.encode_block, *arguments))
            sizes.append(arrangement.size_of(index))
        found: list[CodePart] = list(self.stages.run("encode", "encoding", pending, sizes, "splats"))
        for block in found:
            written = sum(map(block.column_bytes, block.columns))
            self._note("encode", block, bytes_read=block.count * arrangement.row_bytes, bytes_written=written)
        return found, shared

    def compress(self, arrangement: Arrangement, blocks: list[CodePart]) -> list[Part]:
        """Compress the images, in the order of the bundle."""
        pending, names = [], sorted(blocks[0].columns)
        for name in names:
            own = self._own(f"image {name}")
            path = f"{self.folder}/{name}-{own[:16]}.part"
            arguments = (name, blocks, self.layout, self.options, path, own, self.stages.run_id, self.checks is not None)
            pending.append(self.stages.engine.submit(block_tasks.compress_plane, *arguments))
        found: list[Part] = list(
            self.stages.run("compress", "compressing", pending, [arrangement.num_splats] * len(names), "pixels")
        )
        for name, image in zip(names, found, strict=True):
            read = sum(block.column_bytes(name) for block in blocks)
            self._note("compress", image, bytes_read=read, bytes_written=image.stored_size)
        return found

    def judge(
        self, arrangement: Arrangement, blocks: list[CodePart], validation: Validation | None, model: tuple[str, str | None]
    ) -> dict[str, Any] | None:
        """Return what all checks say together, after pictures were drawn."""
        views, rendered = [], {}
        if self.checks is not None and self.checks.views > 0:
            drawing = self.stages.engine.submit(block_tasks.draw_scene, arrangement, self._shared, blocks, self.checks)
            views, count = self._only("draw", "rendering", drawing, 0)
            read = sum(block.column_bytes(each) for block in blocks for each in block.columns)
            self.stages.note("draw", bytes_read=count * arrangement.row_bytes + read)
            rendered = {"rendered_splats": count}
        result = judge(views, [block.tally for block in blocks], validation, model)
        return None if result is None else {**result, **rendered}

    def _only(self, name: str, label: str, pending: Any, size: int) -> Any:
        """Return what the one task of a stage returns."""
        (found,) = self.stages.run(name, label, [pending], [size], "splats")
        return found

    def _own(self, what: str) -> str:
        """Return the key of a part."""
        return hashlib.sha256(f"{self._key} {what}".encode()).hexdigest()

    def _note(self, name: str, part: CodePart | Part, **moved: int) -> None:
        """Add up what a task says about itself, and the bytes that it moved, unless an earlier run did it."""
        if not part.kept:
            self.stages.note(name, **moved, **{f"{what}_seconds": spent for what, spent in part.seconds.items()})
