"""A still scene in blocks: where every splat stands in the bundle, and rows on the disk that can be taken block by block.

The scene is gone through chunk by chunk. In memory stay some 35 bytes a splat while the order is found (its cell in
space, and what global thresholds need), five while rows are written, and a few hundred thousand splats that are drawn.
A block is a run of the order, which for a Morton order is a piece of space.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CHUNK_SIZE, CloudChunks
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, empty_cloud
from gsplat_tools.cluster.parts import part_bytes, read_sealed, sealed, temporary_data
from gsplat_tools.cluster.tasks import FORMAT, FrameSource
from gsplat_tools.codecs.vector_search import pilot_rows
from gsplat_tools.comparison.rendered import MAX_RENDERED
from gsplat_tools.errors import ClusterError, FormatError, ReadError
from gsplat_tools.formats._atomic import replacing_in_any_order
from gsplat_tools.formats._stores import LARGE_BLOCK_BYTES, exists, is_url, replacing_object
from gsplat_tools.formats.preparing import Fit, SaveChoices
from gsplat_tools.formats.scanning import Scan, scan_chunks
from gsplat_tools.formats.sog4d.codebooks import check_finite, longest, visible_lengths
from gsplat_tools.formats.sog4d.options import Sog4dOptions
from gsplat_tools.formats.sog4d.sampling import drawn_rows
from gsplat_tools.ops.importance import log_weights, top_weight
from gsplat_tools.ops.ordering import OrderMethod, cell_codes, order_of_codes

Float32 = NDArray[np.float32]
Rows = NDArray[Any]
"""Of `row_type`."""


def row_type(sh_degree: int) -> np.dtype[Any]:
    """Return how a splat lies in the file of rows: little endian, 4 bytes a number, in the space of `GaussianCloud`."""
    return np.dtype(
        [
            ("place", "<u4"),  # in its block
            ("is_long", "<u4"),  # 1 or 0, of `long_splats`
            ("means", "<f4", (3,)),
            ("log_scales", "<f4", (3,)),
            ("quats", "<f4", (4,)),
            ("opacity_logits", "<f4"),
            ("sh0", "<f4", (3,)),
            ("shN", "<f4", (REST_COEFFICIENTS[sh_degree], 3)),
        ]
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What one pass over a scene decides: which splats stay, and how they are fitted to the target.

    Parameters
    ----------
    scan
        Counts, bounds and highest band.
    fit
        The decisions.
    box
        Ends of the positions as they will be written; None where no splat stays.
    source_degree
        Highest band of the source.
    """

    scan: Scan
    fit: Fit
    box: tuple[Float32, Float32] | None
    source_degree: int


def look_at_scene(source: FrameSource, choices: SaveChoices) -> Look:
    """Go through a scene once."""
    with source.chunks() as chunks:
        scan = scan_chunks(chunks, choices)
        fit = Fit(chunks.template, FORMAT, choices, scan)
        box = fit.box(chunks.template, scan) if scan.num_kept else None
        return Look(scan=scan, fit=fit, box=box, source_degree=chunks.sh_degree)


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrangement:
    """Where the rows of a scene lie, and what was found out about all of them.

    Parameters
    ----------
    path, rows
        The part that says this and holds splats that were drawn; the file of rows.
    key
        Digest of everything that it follows from.
    num_splats, sh_degree, block_splats
        Of the scene as it is written; splats of a block, the last of which may have fewer.
    digests
        SHA-256 of the rows of every block.
    drawn
        (offset, rows) in the part: "sample" for codebooks, "pilot" for searches, "pictures" to be drawn.
    low, high
        (3,) ends of the positions.
    sh0_range
        Least and largest color.
    top_weight
        `importance.top_weight` of the scene.
    facts
        What a `GaussianCloud` says besides its arrays.
    kept
        Whether the rows were there from an earlier run.
    """

    path: str
    rows: str
    key: str
    num_splats: int
    sh_degree: int
    block_splats: int
    digests: list[str]
    drawn: dict[str, tuple[int, int]]
    low: list[float]
    high: list[float]
    sh0_range: tuple[float, float]
    top_weight: float
    facts: dict[str, str]
    kept: bool = False

    @property
    def row_bytes(self) -> int:
        """Bytes of a row."""
        return row_type(self.sh_degree).itemsize

    @property
    def ends(self) -> tuple[Float32, Float32]:
        """Least and largest position, (3,) each."""
        return np.array(self.low, np.float32), np.array(self.high, np.float32)

    def size_of(self, block: int) -> int:
        """Return the splats of a block."""
        return min(self.block_splats, self.num_splats - block * self.block_splats)

    def cloud(self, rows: Rows) -> GaussianCloud:
        """Return splats that were drawn."""
        return GaussianCloud(**{name: rows[name] for name in _attributes(rows.dtype)}, **self.facts)  # type: ignore[arg-type]

    def drawn_rows(self, name: str) -> Rows:
        """Return splats that were drawn, in the order of the bundle."""
        offset, count = self.drawn[name]
        dtype = row_type(self.sh_degree)
        return np.frombuffer(b"".join(part_bytes(self.path, offset, count * dtype.itemsize)), dtype)

    def block(self, index: int) -> tuple[GaussianCloud, NDArray[np.bool_]]:
        """Return the splats of a block in the order of the bundle, and which of them are long.

        Raises
        ------
        ClusterError
            The rows went missing, or are not those that were written.
        """
        count = self.size_of(index)
        cloud, is_long = empty_cloud(count, self.sh_degree), np.empty(count, np.bool_)
        arrays, digest = cloud.arrays(), hashlib.sha256()
        for rows in self._rows_of(index, digest):
            places = rows["place"]
            if len(places) and places.max() >= count:
                break
            for name, values in arrays.items():
                values[places] = rows[name]
            is_long[places] = rows["is_long"] != 0
        if digest.hexdigest() != self.digests[index]:
            raise ClusterError("rows of the scene were changed; the same command makes them anew", path=self.rows)
        return cloud.replace(**self.facts), is_long

    def is_whole(self) -> bool:
        """Whether all rows are there as they were written."""
        if not exists(self.rows):
            return False
        for index, expected in enumerate(self.digests):
            digest = hashlib.sha256()
            try:
                for _ in self._rows_of(index, digest):
                    pass
            except (ClusterError, FormatError):
                return False
            if digest.hexdigest() != expected:
                return False
        return True

    def _rows_of(self, index: int, digest: Any) -> Iterator[Rows]:
        """Yield the rows of a block in the order in which they were written."""
        dtype = row_type(self.sh_degree)
        start, size = index * self.block_splats * dtype.itemsize, self.size_of(index) * dtype.itemsize
        for data in part_bytes(self.rows, start, size, CHUNK_SIZE * dtype.itemsize):
            digest.update(data)
            yield np.frombuffer(data, dtype)


def _attributes(dtype: np.dtype[Any]) -> list[str]:
    return [name for name in dtype.names or () if name not in ("place", "is_long")]


@dataclass(slots=True)
class _Order:
    """Where splats stand: `ranks` by source, `is_long` by rank, and what was found on the way."""

    ranks: NDArray[np.uint32]
    is_long: NDArray[np.bool_]
    ends: tuple[Float32, Float32]
    sh0_range: tuple[float, float]
    top_weight: float


def arrange(
    source: FrameSource, look: Look, choices: SaveChoices, options: Sog4dOptions, folder: str, key: str, block_splats: int
) -> Arrangement:
    """Write the rows of a scene, unless an earlier run left them.

    Parameters
    ----------
    source, look
        The scene, and what `look_at_scene` returned.
    choices, options
        As they were given.
    folder
        Folder or URL of the parts.
    key
        Digest of everything that rows follow from.
    block_splats
        Splats of a block.

    Raises
    ------
    ReadError
        The source is not what it was when it was looked at.
    """
    path, rows = f"{folder}/scene-{key[:16]}.part", f"{folder}/rows-{key[:16]}.part"
    found = _found(path, rows, key)
    if found is not None:
        return found
    with temporary_data(), source.chunks() as chunks:
        fitted = chunks.map(look.fit, num_splats=look.scan.num_kept)
        order = _find_order(fitted, look, choices.order or FORMAT.order, options, source)
        count, dtype = len(fitted), row_type(fitted.sh_degree)
        step = -(-count // MAX_RENDERED)
        draws = {
            "sample": _Draw(drawn_rows(count, 0, 1, options.seed), dtype),
            "pilot": _Draw(np.arange(count)[pilot_rows(count)], dtype),
            "pictures": _Draw(np.arange(0, count, step), dtype),
        }
        template = fitted.template
        digests = _write_rows(rows, fitted, order, block_splats, draws, source)
    starts = np.cumsum([0, *(draw.rows.nbytes for draw in draws.values())])
    said = Arrangement(
        path=path,
        rows=rows,
        key=key,
        num_splats=count,
        sh_degree=fitted.sh_degree,
        block_splats=block_splats,
        digests=digests,
        drawn={name: (int(start), len(draw.rows)) for start, (name, draw) in zip(starts, draws.items(), strict=False)},
        low=order.ends[0].tolist(),
        high=order.ends[1].tolist(),
        sh0_range=order.sh0_range,
        top_weight=order.top_weight,
        facts={name: getattr(template, name) for name in ("coordinate_system", "splat_model", "source_format")},
    )
    with sealed(path, asdict(said)) as body:
        for draw in draws.values():
            body.write(draw.rows.view(np.uint8).data)
    return said


def _found(path: str, rows: str, key: str) -> Arrangement | None:
    """Return what an earlier run left, if all of it is there."""
    said = read_sealed(path, key)
    if said is None:
        return None
    drawn = {name: (start, count) for name, (start, count) in said["drawn"].items()}
    low, high = said["sh0_range"]
    found = Arrangement(**said | {"drawn": drawn, "sh0_range": (low, high), "path": path, "rows": rows, "kept": True})
    return found if found.is_whole() else None


def _find_order(fitted: CloudChunks, look: Look, method: OrderMethod, options: Sog4dOptions, source: FrameSource) -> _Order:
    """Go through a scene for numbers of every splat, and find where each stands."""
    assert look.box is not None
    count = len(fitted)
    codes, weights = np.empty(count, np.uint64), np.empty(count, np.float64)
    lengths = np.empty(count, np.float64) if options.rotation == "small" else None
    ends = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    colors = np.inf, -np.inf
    for start, chunk in _placed(fitted, source):
        check_finite(chunk, 0)
        part = slice(start, start + len(chunk))
        if method != "none":
            codes[part] = cell_codes(chunk.means, *look.box)
        weights[part] = log_weights(chunk)
        if lengths is not None:
            lengths[part] = visible_lengths(chunk)
        ends = np.minimum(ends[0], chunk.means.min(axis=0)), np.maximum(ends[1], chunk.means.max(axis=0))
        colors = min(colors[0], float(chunk.sh0.min())), max(colors[1], float(chunk.sh0.max()))
    if not np.array_equal(ends, look.box):
        raise ReadError("the source changed while it was read; convert again", path=source.files[0])
    top = top_weight(weights)
    del weights
    order = order_of_codes(codes, method)
    del codes
    ranks = np.empty(count, np.uint32)
    ranks[order] = np.arange(count, dtype=np.uint32)
    is_long = np.zeros(count, np.bool_) if lengths is None else longest(lengths[order])
    return _Order(ranks, is_long, ends, colors, top)


def _placed(fitted: CloudChunks, source: FrameSource) -> Iterator[tuple[int, GaussianCloud]]:
    """Yield chunks that are not empty with the number of splats before them; there must be as many as expected."""
    start = 0
    for chunk in fitted:
        if start + len(chunk) > len(fitted):
            break
        if len(chunk):
            yield start, chunk
        start += len(chunk)
    if start != len(fitted):
        raise ReadError("the source changed while it was read; convert again", path=source.files[0])


class _Draw:
    """Keeps the rows of some ranks as they come by."""

    def __init__(self, ranks: NDArray[np.int64], dtype: np.dtype[Any]) -> None:
        self._ranks = ranks
        self.rows = np.zeros(len(ranks), dtype)

    def take(self, ranks: NDArray[np.uint32], rows: Rows) -> None:
        """Keep those that are wanted."""
        places = np.searchsorted(self._ranks, ranks)
        places[places == len(self._ranks)] = 0
        is_wanted = self._ranks[places] == ranks
        self.rows[places[is_wanted]] = rows[is_wanted]


def _write_rows(
    path: str, fitted: CloudChunks, order: _Order, block_splats: int, draws: dict[str, _Draw], source: FrameSource
) -> list[str]:
    """Write every row to its block, in the order in which they come, and return the SHA-256 of every block."""
    dtype = row_type(fitted.sh_degree)
    num_blocks = -(-len(fitted) // block_splats)
    digests = [hashlib.sha256() for _ in range(num_blocks)]
    filled = np.arange(num_blocks, dtype=np.int64) * block_splats
    with _opened(path) as stream:
        for start, chunk in _placed(fitted, source):
            ranks = order.ranks[start : start + len(chunk)]
            rows = np.empty(len(chunk), dtype)
            rows["place"], rows["is_long"] = ranks % block_splats, order.is_long[ranks]
            for name in _attributes(dtype):
                rows[name] = getattr(chunk, name)
            for draw in draws.values():
                draw.take(ranks, rows)
            blocks = ranks // block_splats
            rows = rows[np.argsort(blocks, kind="stable")]
            counts = np.bincount(blocks, minlength=num_blocks)
            stops = np.cumsum(counts)
            for block in np.flatnonzero(counts):
                piece = rows[stops[block] - counts[block] : stops[block]].view(np.uint8).data
                stream.seek(int(filled[block]) * dtype.itemsize)
                stream.write(piece)
                digests[block].update(piece)
                filled[block] += counts[block]
    return [digest.hexdigest() for digest in digests]


@contextmanager
def _opened(path: str) -> Iterator[BinaryIO]:
    """Open a file that is written in any order and appears when it is finished; for a store it waits on this machine."""
    if is_url(path):
        with tempfile.TemporaryFile() as waiting:
            yield waiting
            waiting.seek(0)
            with replacing_object(path, overwrite=True, block_bytes=LARGE_BLOCK_BYTES) as target:
                shutil.copyfileobj(waiting, target, 4 << 20)
        return
    with replacing_in_any_order(Path(path)) as stream:
        yield stream
