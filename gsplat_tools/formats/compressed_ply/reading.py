"""Elements to clouds: whole, or in chunks."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CHUNK_SIZE, CloudChunks
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, empty_cloud
from gsplat_tools.errors import CorruptDataError, FormatError, GsplatWarning, LossyConversionWarning, UnsupportedVersionError
from gsplat_tools.formats._issues import Issue, naming_rules
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._ply_comments import SplatComments, splat_comments
from gsplat_tools.formats._ply_header import PlyElement, PlyHeader, element_offsets, read_header
from gsplat_tools.formats._stream import read_exactly
from gsplat_tools.formats.compressed_ply.rules import CODES
from gsplat_tools.parallel import blocks, run_blocks

BLOCK = 256
"""Splats that share a box."""

BOUNDS = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
COLOR_BOUNDS = BOUNDS[12:]
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

assert CHUNK_SIZE % BLOCK == 0


@dataclass(frozen=True, slots=True)
class PackedPly:
    """A file whose header has been read and whose counts have been checked.

    Parameters
    ----------
    header, comments
        As found.
    chunk, vertex, sh
        The elements; sh is None without.
    offsets
        Where the rows of each element start.
    sh_degree
        Highest band.
    """

    header: PlyHeader
    comments: SplatComments
    chunk: PlyElement
    vertex: PlyElement
    sh: PlyElement | None
    offsets: dict[str, int]
    sh_degree: int

    @property
    def has_color_bounds(self) -> bool:
        """Whether colors are relative to boxes; in older files they are in 0..1."""
        return set(COLOR_BOUNDS) <= set(self.chunk.property_names())

    def left_out(self) -> list[str]:
        """Return elements and properties that a cloud has no place for."""
        used = {"chunk", "vertex", "sh"}
        others = [f"{element.name} ({element.count} rows)" for element in self.header.elements if element.name not in used]
        return others + [f"vertex property {name}" for name in self.vertex.property_names() if name not in WORDS]


@naming_rules(CODES)
def open_packed(stream: BinaryIO) -> PackedPly:
    """Read the header and hold it against the format and the size of the file.

    Raises
    ------
    FormatError
        An element or property is missing or of the wrong type, or counts contradict each other or the file's size.
    """
    header = read_header(stream)
    if header.encoding == "ascii":
        raise UnsupportedVersionError("compressed.ply is binary, found format ascii", field="format")
    chunk, vertex, sh = (header.element(name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None:
        found = ", ".join(element.name for element in header.elements) or "none"
        raise CorruptDataError(f"expected elements chunk and vertex, found {found}", field="chunk")
    color_names = COLOR_BOUNDS if set(COLOR_BOUNDS) & set(chunk.property_names()) else ()
    _require(chunk, (*BOUNDS[:12], *color_names), "f4")
    _require(vertex, WORDS, "u4")
    expected = -(-vertex.count // BLOCK)
    if chunk.count != expected:
        raise CorruptDataError(
            f"{vertex.count} splats have {expected} chunks of {BLOCK}, found {chunk.count}",
            field="chunk",
            offset=chunk.line_offset,
        )
    degree = 0
    if sh is not None:
        counts = [3 * coefficients for coefficients in REST_COEFFICIENTS]
        number = len(sh.properties)
        if number not in counts:
            raise CorruptDataError(
                f"expected {', '.join(map(str, counts))} properties for SH degree 0 to 4, found {number}",
                field="sh",
                offset=sh.line_offset,
            )
        _require(sh, tuple(f"f_rest_{i}" for i in range(number)), "u1")
        if sh.count != vertex.count:
            raise CorruptDataError(
                f"expected a row for each of {vertex.count} splats, found {sh.count}", field="sh", offset=sh.line_offset
            )
        degree = counts.index(number)
        sh = sh if degree else None  # rows of no bytes
    comments = splat_comments(header, is_flat=False)
    check_splats(vertex.count, degree, None, field="vertex", offset=vertex.line_offset)
    return PackedPly(header, comments, chunk, vertex, sh, element_offsets(header, stream), degree)


def _require(element: PlyElement, names: tuple[str, ...], kind: str) -> None:
    """Refuse an element that lacks a property or has it in another type; signed words are read as unsigned."""
    properties = {prop.name: prop for prop in element.properties}
    missing = [name for name in names if name not in properties]
    if missing:
        raise CorruptDataError(f"lacks {', '.join(missing)}", field=element.name, offset=element.line_offset)
    wanted = np.dtype(kind)
    for name in names:
        prop = properties[name]
        same_kind = prop.dtype.kind == wanted.kind or {prop.dtype.kind, wanted.kind} == {"i", "u"}
        if prop.count_dtype is not None or prop.dtype.itemsize != wanted.itemsize or not same_kind:
            raise CorruptDataError(
                f"expected {wanted.name}, found {'a list of ' if prop.count_dtype is not None else ''}{prop.dtype.name}",
                field=f"{element.name} {name}",
                offset=element.line_offset,
            )
    if element.has_lists:
        raise CorruptDataError("expected no lists", field=element.name, offset=element.line_offset)


class PackedReader:
    """Reads ranges of splats."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.packed = packed = open_packed(stream)
        self.num_splats = packed.vertex.count
        names = BOUNDS if packed.has_color_bounds else BOUNDS[:12]
        self._bounds = np.zeros((packed.chunk.count, len(BOUNDS)), np.float32)
        self._bounds[:, 15:] = 1.0
        rows = self._rows(packed.chunk, 0, packed.chunk.count)
        for column, name in enumerate(names):
            self._bounds[:, column] = rows[name]
        others = packed.left_out()
        if others:
            warnings.warn(LossyConversionWarning(f"left out: {', '.join(others)}", code="left-out-elements"), stacklevel=4)

    def odd_boxes(self) -> NDArray[np.bool_]:
        """Return whether each box, (N / 256,), is empty or not finite."""
        low = self._bounds.reshape(-1, 3, 2, 3)[:, :, 0]
        high = self._bounds.reshape(-1, 3, 2, 3)[:, :, 1]
        is_sound = np.isfinite(low) & np.isfinite(high) & (low <= high)
        return np.asarray(~is_sound.all(axis=(1, 2)))

    @naming_rules(CODES)
    def _rows(self, element: PlyElement, start: int, stop: int) -> NDArray[Any]:
        """Read rows of an element as records."""
        size = element.min_row_bytes
        self._stream.seek(self.packed.offsets[element.name] + start * size)
        return np.frombuffer(read_exactly(self._stream, (stop - start) * size, field=element.name), element.row_dtype)

    def template(self) -> GaussianCloud:
        """Return a cloud without splats."""
        return self._describe(empty_cloud(0, self.packed.sh_degree))

    def _describe(self, cloud: GaussianCloud) -> GaussianCloud:
        """Return the cloud with what comments say."""
        comments = self.packed.comments
        return cloud.replace(
            coordinate_system=comments.coordinate_system, origin=comments.origin, splat_model=comments.splat_model
        )

    def read(self, start: int, stop: int) -> GaussianCloud:
        """Read splats; `start` is a multiple of 256."""
        from gsplat_tools.kernels import compressed_ply, smallest_three

        vertices = self._rows(self.packed.vertex, start, stop)
        rest = None if self.packed.sh is None else self._rows(self.packed.sh, start, stop)
        cloud = empty_cloud(stop - start, self.packed.sh_degree)
        logits, harmonics = _tables()

        def decode(first: int, last: int) -> None:
            part = slice(first, last)
            words = np.empty((last - first, 4), np.uint32)
            for column, name in enumerate(WORDS):
                words[:, column] = vertices[name][part].astype(np.uint32)
            box = slice((start + first) // BLOCK, -(-(start + last) // BLOCK))
            arrays = cloud.means[part], cloud.log_scales[part], cloud.opacity_logits[part], cloud.sh0[part]
            compressed_ply.decode_blocks(words, self._bounds[box], logits, *arrays)
            smallest_three.unpack_unsigned(np.ascontiguousarray(words[:, 1]), cloud.quats[part])
            if rest is not None and cloud.sh_degree:
                codes = np.empty((last - first, 3 * cloud.shN.shape[1]), np.uint8)
                for column in range(codes.shape[1]):
                    codes[:, column] = rest[f"f_rest_{column}"][part].astype(np.uint8)
                compressed_ply.decode_sh(codes, harmonics, cloud.shN[part])

        run_blocks(decode, stop - start)
        return self._describe(cloud)


def _tables() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return opacity logit and SH value of every byte."""
    codes = np.arange(256.0)
    with np.errstate(divide="ignore"):
        logits = np.log(codes) - np.log(255 - codes)
    harmonics = 8 * ((codes + 0.5) / 256 - 0.5)
    harmonics[[0, 255]] = -4, 4
    return logits.astype(np.float32), harmonics.astype(np.float32)


def check(stream: BinaryIO) -> Iterator[Issue]:
    """Yield what is odd about a file that can be read; the reader says what is wrong with others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        try:
            is_odd = PackedReader(stream).odd_boxes()
        except FormatError:
            return
    count = int(np.count_nonzero(is_odd))
    if count:
        message = f"{count} of {len(is_odd)} boxes are not finite or have min > max"
        yield Issue(code="box", message=message, field="chunk", splat=BLOCK * int(np.argmax(is_odd)), count=count)


def read(stream: BinaryIO, _options: Any = None) -> GaussianCloud:
    """Read the whole cloud; opacity bytes 0 and 255 have logits -inf and +inf.

    Raises
    ------
    FormatError
        The file is not what its header says, or the header not what the format asks for.

    Warns
    -----
    LossyConversionWarning
        Other elements or properties were left out.
    """
    reader = PackedReader(stream)
    return reader.read(0, reader.num_splats)


def read_chunks(stream: BinaryIO, _options: Any = None) -> CloudChunks:
    """Return the cloud in chunks.

    Raises
    ------
    FormatError
        The file is not what its header says, or the header not what the format asks for.

    Warns
    -----
    LossyConversionWarning
        Other elements or properties were left out.
    """
    reader = PackedReader(stream)

    def iterate() -> Iterator[GaussianCloud]:
        for start, stop in blocks(reader.num_splats, CHUNK_SIZE):
            yield reader.read(start, stop)

    return CloudChunks(reader.num_splats, reader.template(), iterate)
