"""What workers do for a still scene in blocks: fit codebooks, encode a block, compress an image, draw what is checked."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CHUNK_SIZE
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.cluster.arranging import Arrangement
from gsplat_tools.cluster.checking import Checks
from gsplat_tools.cluster.parts import (
    Part,
    part_bytes,
    read_part,
    read_sealed,
    sealed,
    tally_from_json,
    tally_to_json,
    temporary_data,
    write_part,
)
from gsplat_tools.comparison.attributes import AttributeTally
from gsplat_tools.comparison.rendered import ViewReport, compare_rendered
from gsplat_tools.errors import ClusterError, ValidationError
from gsplat_tools.formats import _webp
from gsplat_tools.formats._files import checksum
from gsplat_tools.formats._webp import Image
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.sog4d.bounds import bounds_in
from gsplat_tools.formats.sog4d.codebooks import Shared, fit_codebooks, for_splats
from gsplat_tools.formats.sog4d.decode import FrameDecoder
from gsplat_tools.formats.sog4d.encode import last_entries
from gsplat_tools.formats.sog4d.frame import encode_frame
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.piece import Piece, meta_in
from gsplat_tools.formats.sog4d.sampling import Sample
from gsplat_tools.formats.sog4d.segments import SegmentFacts, compress_image, image_compression, image_path
from gsplat_tools.formats.sog4d.textures import blank
from gsplat_tools.ops.importance import log_weights, weights_of

Columns = Mapping[str, NDArray[np.uint8]]

_COMPARED_ROWS = 64
"""Rows of an image that are compared at a time."""


@dataclass(slots=True, kw_only=True)
class CodePart:
    """The codes of a block, and how far they are from the splats.

    Parameters
    ----------
    path, key
        Where they lie, and the digest of everything that they follow from.
    count
        Splats.
    columns
        (offset, bytes a splat, checksum) of the codes of every image, by stream name.
    clipped
        Splats that a codebook could not reach, by the codebook.
    tally
        Errors against the source, where they were checked.
    seconds
        What it took to make.
    run
        The run that made it.
    kept
        Whether it was there from an earlier run.
    """

    path: str
    key: str
    count: int
    columns: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    clipped: dict[str, int] = field(default_factory=dict)
    tally: AttributeTally | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    run: str = ""
    kept: bool = False

    def column_bytes(self, name: str) -> int:
        """Return the bytes of the codes of one image."""
        return self.count * self.columns[name][1]

    def column(self, name: str) -> NDArray[np.uint8]:
        """Return the codes of one image, (count, bytes a splat).

        Raises
        ------
        ClusterError
            They went missing, or are not those that were written.
        """
        offset, width, expected = self.columns[name]
        data = b"".join(part_bytes(self.path, offset, self.column_bytes(name)))
        if checksum(data) != expected:
            raise ClusterError("a finished block was changed; the same command makes it anew", path=self.path)
        return np.frombuffer(data, np.uint8).reshape(self.count, width)


def fit_scene(arrangement: Arrangement, options: Sog4dOptions, layout: tuple[int, int]) -> Shared:
    """Return what all blocks share, from the splats that were drawn of the whole scene."""
    drawn = arrangement.cloud(arrangement.drawn_rows("sample"))
    sample = Sample(
        log_scales=drawn.log_scales,
        sh0=drawn.sh0,
        shN=drawn.shN,
        weights=weights_of(log_weights(drawn), arrangement.top_weight),
        sh0_range=arrangement.sh0_range,
    )
    shared = fit_codebooks(sample, arrangement.num_splats, options, layout)
    return replace(shared, pilot=np.ascontiguousarray(arrangement.drawn_rows("pilot")["shN"]))


def encode_block(
    arrangement: Arrangement, shared: Shared, index: int, path: str, key: str, run: str, is_checked: bool
) -> CodePart:
    """Encode a block to a part, unless an earlier run or try left it; if checked, hold it against its source first."""
    said = read_sealed(path, key)
    if said is not None:
        columns = {name: (start, width, found) for name, (start, width, found) in said["columns"].items()}
        own = {"columns": columns, "tally": tally_from_json(said["tally"]), "path": path, "kept": said.get("run") != run}
        return CodePart(**said | own)
    start = time.perf_counter()
    cloud, is_long = arrangement.block(index)
    read = time.perf_counter()
    own_shared = for_splats(shared, cloud, is_long if shared.options.rotation == "small" else None)
    planes = encode_frame(cloud, own_shared, ends=arrangement.ends)
    encoded = time.perf_counter()
    tally = _checked(cloud, planes.columns, entries_of(arrangement, shared)) if is_checked else None
    checked = time.perf_counter()
    part = CodePart(
        path=path,
        key=key,
        count=len(cloud),
        clipped=planes.clipped,
        tally=tally,
        seconds={"read": read - start, "encode": encoded - read, "validate": checked - encoded},
        run=run,
    )
    offset = 0
    for name, column in planes.columns.items():
        part.columns[name] = (offset, column.shape[1], checksum(column.reshape(-1).data))
        offset += column.size
    with temporary_data(), sealed(path, {**asdict(part), "tally": tally_to_json(tally)}) as body:
        for column in planes.columns.values():
            body.write(column.reshape(-1).data)
    part.seconds["write"] = time.perf_counter() - checked
    return part


def facts_of(arrangement: Arrangement, clipped: Sequence[Mapping[str, int]]) -> SegmentFacts:
    """Return what encoding leaves of a scene besides its images."""
    facts = SegmentFacts(ranges=[arrangement.ends], sources={arrangement.facts["source_format"]})
    for each in clipped:
        for name, count in each.items():
            facts.clipped[name] = facts.clipped.get(name, 0) + count
    return facts


def entries_of(arrangement: Arrangement, shared: Shared) -> dict[str, bytes]:
    """Return meta.json and the palettes, with labels as images."""
    return last_entries(shared, arrangement.num_splats, [(0, 1)], None, [facts_of(arrangement, [])], uses_deltas=False)


def _checked(cloud: GaussianCloud, columns: Columns, entries: Mapping[str, bytes]) -> AttributeTally:
    """Decode codes as a reader will, and hold every value against its bound."""
    meta, tally = meta_in(entries), AttributeTally()
    for start in range(0, len(cloud), CHUNK_SIZE):
        part = slice(start, start + CHUNK_SIZE)
        source = cloud.take(part)
        piece = Piece(meta, entries, {name: column[part] for name, column in columns.items()})
        tally.add(source, FrameDecoder(piece).frame(0), bounds_in(piece, source, 0))
    exceeded = tally.exceeded()
    if exceeded:
        raise ValidationError(f"what was written leaves its derived bounds: {'; '.join(exceeded)}")
    return tally


def compress_plane(
    name: str,
    blocks: Sequence[CodePart],
    layout: tuple[int, int],
    options: Sog4dOptions,
    path: str,
    key: str,
    run: str,
    is_checked: bool,
) -> Part:
    """Join the codes of all blocks to one image and compress it to a part, unless an earlier run or try left it.

    Raises
    ------
    ValidationError
        The image does not decompress to the codes.
    """
    found = read_part(path, key, run)
    if found is not None:
        return found
    start = time.perf_counter()
    image = blank(*layout)
    pixels, first = image.reshape(-1, 4), 0
    for block in blocks:
        column = block.column(name)
        pixels[first : first + block.count, : column.shape[1]] = column
        first += block.count
    entry, data = compress_image((image_path(name, 0), image), effort=options.webp_effort)
    encoded = time.perf_counter()
    if is_checked and not _is_same(image, _webp.decode_rgba(data, *layout, field=entry)):
        raise ValidationError(f"{entry} does not decompress to what was compressed; try again, on another machine if it stays")
    checked = time.perf_counter()
    with temporary_data(), tempfile.TemporaryFile() as body:
        archive = ZipWriter(body)
        archive.add(entry, data, image_compression(options))
        seconds = {"encode": encoded - start, "validate": checked - encoded}
        part = Part(
            path=path,
            key=key,
            entries=archive.entries,
            images=archive.size,
            deltas={},
            facts=SegmentFacts(),
            seconds=seconds,
            run=run,
        )
        write_part(part, body)
    return part


def _is_same(image: Image, other: Image) -> bool:
    """Whether two images are equal, compared without a third."""
    steps = range(0, len(image), _COMPARED_ROWS)
    return all(np.array_equal(image[i : i + _COMPARED_ROWS], other[i : i + _COMPARED_ROWS]) for i in steps)


def draw_scene(
    arrangement: Arrangement, shared: Shared, blocks: Sequence[CodePart], checks: Checks
) -> tuple[list[ViewReport], int]:
    """Draw splats of the whole scene and what their codes stand for; return the views and how many splats were drawn."""
    from gsplat_tools.reference.auto_cameras import auto_cameras

    before = arrangement.cloud(arrangement.drawn_rows("pictures"))
    step = -(-arrangement.num_splats // len(before))
    entries = entries_of(arrangement, shared)
    columns = {name: np.concatenate(list(_every(step, name, blocks))) for name in blocks[0].columns}
    after = FrameDecoder(Piece(meta_in(entries), entries, columns)).frame(0)
    cameras = auto_cameras(before, views=checks.views, size=checks.size)
    return list(compare_rendered([("", before, after)], cameras, checks.model).views), len(before)


def _every(step: int, name: str, blocks: Sequence[CodePart]) -> Iterator[NDArray[np.uint8]]:
    """Yield the codes of every `step`-th splat of the scene."""
    start = 0
    for block in blocks:
        yield block.column(name)[-start % step :: step]
        start += block.count
