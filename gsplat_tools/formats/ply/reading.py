"""Rows to clouds: whole, or in chunks."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CHUNK_SIZE, CloudChunks
from gsplat_tools.cloud import GaussianCloud, TimeModel, empty_cloud
from gsplat_tools.errors import LossyConversionWarning
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._motion_repair import MotionRepair
from gsplat_tools.formats._ply_comments import SplatComments, splat_comments
from gsplat_tools.formats._ply_header import PlyHeader, read_header
from gsplat_tools.formats.ply.layout import MEANS, MOTION_DEFAULTS, SplatLayout, splat_layout
from gsplat_tools.formats.ply.rows import Rows, open_rows
from gsplat_tools.parallel import blocks, map_ordered, run_blocks

_PROBES = 64
_PROBE_ROWS = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """Choices of the reader.

    Parameters
    ----------
    time_model
        How `time` and `duration` are read, "window" or "gaussian"; by default what the file says, else "window".
    """

    time_model: TimeModel | None = None


class PlyReader:
    """A PLY whose header has been read and whose counts have been checked."""

    def __init__(self, stream: BinaryIO, options: ReadOptions) -> None:
        header = read_header(stream)
        self.layout: SplatLayout = splat_layout(header)
        self.comments: SplatComments = splat_comments(header, is_flat=self.layout.splat_columns[5] is None)
        self.num_splats = self.layout.vertex.count
        check_splats(
            self.num_splats,
            self.layout.sh_degree,
            None,
            field="vertex",
            offset=self.layout.vertex.line_offset,
            has_motion=bool(self.layout.motion),
        )
        self._rows: Rows = open_rows(stream, header, self.layout.vertex)
        self._time_model: TimeModel = options.time_model or self.comments.time_model or "window"
        self._columns = self.layout.float32_columns(self.layout.splat_columns)
        normal_columns = self.layout.float32_columns(self.layout.normals)
        if normal_columns is None:
            self._columns = None
        self._normal_columns = np.empty(0, np.int64) if normal_columns is None else normal_columns
        self._shift = self._find_shift() if self.layout.has_wide_positions else np.zeros(3)
        self._is_warned = False
        _warn_left_out(header, self.layout)

    def template(self, *, keeps_normals: bool) -> GaussianCloud:
        """Return a cloud without splats that carries all that is the same for every splat."""
        return self._cloud(0, 0, self._make_repair(), keeps_normals=keeps_normals)[0]

    def read(self) -> GaussianCloud:
        """Read everything."""
        repair = self._make_repair()
        cloud, has_normals = self._cloud(0, self.num_splats, repair, keeps_normals=False)
        if has_normals:
            cloud = cloud.replace(extra={**self._normals(0, self.num_splats), **cloud.extra})
        repair.warn()
        return cloud

    def read_chunks(self) -> Iterator[GaussianCloud]:
        """Read chunk by chunk."""
        repair = self._make_repair()
        keeps_normals = self.probe_normals()
        num_lost = 0
        for start, stop in blocks(self.num_splats, CHUNK_SIZE):
            cloud, has_normals = self._cloud(start, stop, repair, keeps_normals=keeps_normals)
            if has_normals and not keeps_normals:
                num_lost += int(np.count_nonzero(np.any([v != 0 for v in self._normals(start, stop).values()], axis=0)))
            yield cloud
        if not self._is_warned:  # chunks may be gone through twice
            self._is_warned = True
            repair.warn()
            if num_lost:
                warnings.warn(
                    LossyConversionWarning(
                        f"dropped the normals of {num_lost} of {self.num_splats} splats: those looked at first were all zero; "
                        "load the file whole to keep them",
                        code="dropped-normals",
                    ),
                    stacklevel=2,
                )

    def probe_normals(self) -> bool:
        """Look at rows all over the file and return whether any normal is not zero."""
        if not self.layout.normals:
            return False
        starts = np.unique(np.linspace(0, max(self.num_splats - _PROBE_ROWS, 0), _PROBES).astype(np.int64))
        ranges = [(int(start), min(int(start) + _PROBE_ROWS, self.num_splats)) for start in starts]
        return any(_any_nonzero(self._rows.block(*part), self.layout.normals) for part in ranges)

    def _make_repair(self) -> MotionRepair:
        return MotionRepair(self._time_model, self.num_splats)

    def _cloud(self, start: int, stop: int, repair: MotionRepair, *, keeps_normals: bool) -> tuple[GaussianCloud, bool]:
        """Read a range of splats; also returns whether any of its normals is not zero."""
        layout = self.layout
        cloud = empty_cloud(stop - start, layout.sh_degree, has_motion=bool(layout.motion))
        names = (*(layout.normals if keeps_normals else ()), *layout.extras)
        extra = {name: np.empty(stop - start, layout.find(name).dtype.newbyteorder("=")) for name in names}
        normals_found = threading.Event()

        def fill(first: int, last: int) -> None:
            records = self._rows.block(start + first, start + last)
            part = cloud.take(slice(first, last))  # views
            # A double beyond float32 becomes infinite, which the filter of invalid splats counts.
            with np.errstate(over="ignore", invalid="ignore"):
                if self._fill_splats(records, part):
                    normals_found.set()
                _fill_motion(records, layout, part)
            for name, values in extra.items():
                values[first:last] = records[name]

        run_blocks(fill, stop - start, self._rows.block_size)
        changes: dict[str, Any] = {"extra": extra}
        if layout.motion:
            changes |= repair.apply(cloud)
        comments = self.comments
        cloud = cloud.replace(
            time_model=self._time_model if layout.motion else "window",
            temporal_cutoff=comments.temporal_cutoff,
            coordinate_system=comments.coordinate_system,
            origin=comments.origin + self._shift,
            splat_model=comments.splat_model,
            source_format=comments.source_format,
            **changes,
        )
        return cloud, normals_found.is_set()

    def _fill_splats(self, records: NDArray[Any], cloud: GaussianCloud) -> bool:
        """Fill the arrays of static attributes; returns whether any normal is not zero."""
        if self._columns is not None:
            from gsplat_tools.kernels.columns import scatter_rows

            rows = records.view(np.float32).reshape(len(records), -1)
            arrays = (cloud.means, cloud.log_scales, cloud.quats, cloud.opacity_logits, cloud.sh0, cloud.shN)
            return bool(scatter_rows(rows, self._columns, self._normal_columns, *arrays))
        names = self.layout.splat_columns
        for axis in range(3):
            values = records[MEANS[axis]]
            cloud.means[:, axis] = values - self._shift[axis] if self.layout.has_wide_positions else values
        for axis in range(3):
            scale = names[3 + axis]
            cloud.log_scales[:, axis] = -np.inf if scale is None else records[scale]
            cloud.sh0[:, axis] = records[names[11 + axis]]
        for axis in range(4):
            cloud.quats[:, axis] = records[names[6 + axis]]
        cloud.opacity_logits[:] = records[names[10]]
        num_rest = cloud.shN.shape[1]
        for column, name in enumerate(names[14:]):
            cloud.shN[:, column % num_rest, column // num_rest] = records[name]
        return _any_nonzero(records, self.layout.normals)

    def _normals(self, start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Read the normals of a range alone."""
        normals = {name: np.empty(stop - start, self.layout.find(name).dtype.newbyteorder("=")) for name in self.layout.normals}

        def fill(first: int, last: int) -> None:
            records = self._rows.block(start + first, start + last)
            for name, values in normals.items():
                values[first:last] = records[name]

        run_blocks(fill, stop - start, self._rows.block_size)
        return normals

    def _find_shift(self) -> NDArray[np.float64]:
        """Return a round origin near the center of the finite positions, or zero where float32 holds them all exactly."""
        from gsplat_tools.ops.recentering import choose_origin

        low, high, is_exact = np.full(3, np.inf), np.full(3, -np.inf), True
        for block in map_ordered(self._box, blocks(self.num_splats, self._rows.block_size)):
            low, high, is_exact = np.minimum(low, block[0]), np.maximum(high, block[1]), is_exact and block[2]
        return np.zeros(3) if is_exact or not np.isfinite([low, high]).all() else choose_origin(low, high)

    def _box(self, part: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
        """Return the box of the finite positions of a block, and whether float32 holds them exactly."""
        records = self._rows.block(*part)
        positions = np.stack([records[name].astype(np.float64) for name in MEANS], axis=1)
        # One splat out at 1e300, which float32 cannot hold anyway, must not carry the origin away.
        positions = positions[(np.abs(positions) <= np.finfo(np.float32).max).all(axis=1)]
        is_exact = bool((positions.astype(np.float32) == positions).all())
        return positions.min(axis=0, initial=np.inf), positions.max(axis=0, initial=-np.inf), is_exact


def _fill_motion(records: NDArray[Any], layout: SplatLayout, cloud: GaussianCloud) -> None:
    """Fill velocities, times and durations, with defaults for what the file lacks."""
    for attribute, names in layout.motion.items():
        values = getattr(cloud, attribute).reshape(len(cloud), len(names))
        for axis, name in enumerate(names):
            values[:, axis] = MOTION_DEFAULTS[attribute] if name is None else records[name]


def _any_nonzero(records: NDArray[Any], names: tuple[str, ...]) -> bool:
    """Whether any of these properties is not zero; NaN is not."""
    return any(bool((records[name] != 0).any()) for name in names)


def _warn_left_out(header: PlyHeader, layout: SplatLayout) -> None:
    """Warn about elements and properties that a cloud has no place for."""
    others = [f"{element.name} ({element.count} rows)" for element in header.elements if element.name != "vertex"]
    lists = [f"vertex property {name} (lists)" for name in layout.lists]
    if others or lists:
        warnings.warn(
            LossyConversionWarning(f"left out: {', '.join(others + lists)}", code="left-out-elements"),
            stacklevel=4,
        )


def read(stream: BinaryIO, options: ReadOptions | None = None) -> GaussianCloud:
    """Read a 3DGS PLY of any dialect.

    Parameters
    ----------
    stream
        Can seek; plain files are read by all threads at once.
    options
        Choices of the reader.

    Returns
    -------
    GaussianCloud
        Values as stored, invalid splats included. Positions wider than float32 are made relative to an origin near
        the center of their box, subtracted in float64, unless float32 holds them exactly.

    Raises
    ------
    FormatError
        This is no PLY, or no splat file.
    TruncatedDataError, CorruptDataError
        The header promises more or less than the file holds.

    Warns
    -----
    LossyConversionWarning
        Elements were left out, or times were clamped, with counts.
    """
    return PlyReader(stream, options or ReadOptions()).read()


def read_chunks(stream: BinaryIO, options: ReadOptions | None = None) -> CloudChunks:
    """Read a 3DGS PLY in chunks; text and lists in the vertex element are parsed whole first.

    Parameters
    ----------
    stream
        Stays open while chunks are read.
    options
        Choices of the reader.

    Returns
    -------
    CloudChunks
        As `read`, except that normals are kept where they are not zero in some of 64 places all over the file.

    Raises
    ------
    FormatError, TruncatedDataError, CorruptDataError
        As `read`.

    Warns
    -----
    LossyConversionWarning
        As `read`, at the end of the chunks; and normals that were dropped after all, with the count.
    """
    reader = PlyReader(stream, options or ReadOptions())
    return CloudChunks(reader.num_splats, reader.template(keeps_normals=reader.probe_normals()), reader.read_chunks)
