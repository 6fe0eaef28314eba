"""Visionary's own storage buffers, one behind the other: Gaussians of ten scalars, then colors."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations
from gsplat_tools.attributes.covariance import covariance_triangles, decompose
from gsplat_tools.chunks import CHUNK_SIZE, CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud, empty_cloud
from gsplat_tools.codecs import visionary_buffers as codec
from gsplat_tools.codecs.visionary_buffers import Precision, ShLayout
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning, TruncatedDataError
from gsplat_tools.formats._companion import attach, companion_of
from gsplat_tools.formats._limits import check_splats
from gsplat_tools.formats._stream import read_exactly, stream_size
from gsplat_tools.formats.base import Bounds, FileInfo, Scene
from gsplat_tools.formats.visionary.sidecar import ModelOptions, Sidecar, compose, parse
from gsplat_tools.parallel import BLOCK_SIZE, blocks, run_blocks
from gsplat_tools.sequence import GaussianSequence

_GAUSSIAN_WORDS = {"f32": 10, "f16": 5}
_SH_WORDS = {"f32": 48, "f16": 24}
_RAW_WORDS = {"f32": 3, "f16": 2}
_LARGEST = {"f32": float(np.finfo(np.float32).max), "f16": 65504.0}
_HALF_OVERFLOW = 65520.0
_HALF_STEP = 2.0**-24 * (1 + 1e-6)
"""Rounding to float32 relative to the value, and what float64 arithmetic adds."""

_EIGEN_NOISE = 8e-15
"""Eigenvalues of float64 are off by a few roundings of the largest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BufferOptions(ModelOptions):
    """Choices of the writer, and ModelParams.

    Parameters
    ----------
    sh_layout
        "interleaved", which Visionary reads, or "channel-major", which its shader has but nothing switches on.
    raw_color
        Store RGB in place of SH, for clouds of degree 0.
    kernel_size, gaussian_scaling, opacity_scale, cutoff_scale, render_mode, base_offset
        As in `ModelOptions`.
    """

    sh_layout: ShLayout = "interleaved"
    raw_color: bool = False

    def __post_init__(self) -> None:
        ModelOptions.__post_init__(self)
        if self.sh_layout not in ("interleaved", "channel-major"):
            raise CapabilityError(f"sh_layout must be 'interleaved' or 'channel-major', got {self.sh_layout!r}")


def color_words(precision: Precision, *, raw_color: bool) -> int:
    """Return the words of a splat in the color buffer."""
    return (_RAW_WORDS if raw_color else _SH_WORDS)[precision]


def _layout(stream: BinaryIO, precision: Precision) -> tuple[Sidecar, int]:
    """Return what the buffers are, and how many splats they hold.

    Raises
    ------
    TruncatedDataError
        The size is that of no number of splats, or not of those that the sidecar promises.
    CorruptDataError
        The sidecar is at fault.
    """
    companion = companion_of(stream)
    sidecar = Sidecar(precision=precision) if companion is None else parse(companion, precision)
    stride = 4 * (_GAUSSIAN_WORDS[precision] + color_words(precision, raw_color=sidecar.raw_color))
    size = stream_size(stream)
    count = size // stride if sidecar.splats is None else sidecar.splats
    if size != count * stride or size == 0:
        promised = "at least one" if sidecar.splats is None else f"and {sidecar.splats} splats by the sidecar"
        raise TruncatedDataError(f"expected {stride} bytes a splat, {promised}, found {size} bytes", offset=size)
    check_splats(count, sidecar.sh_degree, None, field="splats")
    return sidecar, count


def inspect(stream: BinaryIO, precision: Precision) -> FileInfo:
    """Return what length and sidecar tell.

    Raises
    ------
    TruncatedDataError
        The size does not fit.
    CorruptDataError
        The sidecar is at fault.
    """
    sidecar, count = _layout(stream, precision)
    words = color_words(precision, raw_color=sidecar.raw_color)
    return FileInfo(
        version="",
        splats=count,
        sh_degree=sidecar.sh_degree,
        origin=(float(sidecar.origin[0]), float(sidecar.origin[1]), float(sidecar.origin[2])),
        encoding={
            "gaussian_bytes": 4 * _GAUSSIAN_WORDS[precision],
            "color_bytes": 4 * words,
            "color": "raw" if sidecar.raw_color else "sh",
            "sh_layout": sidecar.sh_layout,
            "model_params": dict(sidecar.params),
        },
    )


def read_chunks(stream: BinaryIO, precision: Precision) -> CloudChunks:
    """Return the cloud in chunks.

    Raises
    ------
    TruncatedDataError
        The size does not fit.
    CorruptDataError
        The sidecar is at fault.
    """
    sidecar, count = _layout(stream, precision)
    row, color_row = _GAUSSIAN_WORDS[precision], color_words(precision, raw_color=sidecar.raw_color)

    def words_at(offset: int, width: int, start: int, stop: int, field: str) -> NDArray[np.uint32]:
        stream.seek(4 * (offset + start * width))
        data = read_exactly(stream, 4 * (stop - start) * width, field=field)
        return np.frombuffer(data, "<u4").reshape(stop - start, width)

    def iterate() -> Iterator[GaussianCloud]:
        for start, stop in blocks(count, CHUNK_SIZE):
            gaussians = words_at(0, row, start, stop, "gaussian buffer")
            yield decode(gaussians, words_at(count * row, color_row, start, stop, "color buffer"), sidecar)

    template = empty_cloud(0, sidecar.sh_degree).replace(origin=sidecar.origin, source_format=sidecar.source_format)
    return CloudChunks(count, template, iterate)


def decode(gaussians: NDArray[np.uint32], colors: NDArray[np.uint32], sidecar: Sidecar) -> GaussianCloud:
    """Return the splats of both buffers; covariances become rotations and scales by their eigenvectors.

    Parameters
    ----------
    gaussians, colors
        (N, W) words each.
    sidecar
        What they hold.
    """
    precision: Precision = "f32" if sidecar.precision == "f32" else "f16"
    cloud = empty_cloud(len(gaussians), sidecar.sh_degree).replace(origin=sidecar.origin, source_format=sidecar.source_format)

    def decode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        means, opacities, covariances = codec.decode_gaussians(gaussians[part], precision=precision)
        cloud.means[part] = means
        with np.errstate(invalid="ignore"):
            cloud.opacity_logits[part] = activations.logit(opacities)
            cloud.quats[part], cloud.log_scales[part] = decompose(covariances)
        if sidecar.raw_color:
            cloud.sh0[part] = (codec.decode_raw_colors(colors[part], precision=precision).astype(np.float64) - 0.5) / SH_C0
        else:
            cloud.sh0[part], cloud.shN[part] = codec.decode_sh(
                colors[part], sidecar.sh_degree, precision=precision, layout=sidecar.sh_layout
            )

    run_blocks(decode_block, len(gaussians))
    return cloud


def write(scene: Scene, stream: BinaryIO, options: BufferOptions, precision: Precision) -> None:
    """Write a cloud or chunks, and attach the sidecar.

    Raises
    ------
    CapabilityError
        The scene is a sequence, has SH and raw colors are wanted, or positions are beyond half precision.
    CloudError
        A position is not finite, or a value is not a number.

    Warns
    -----
    LossyConversionWarning
        Half precision loses thin axes, or values were clamped, with counts.
    """
    if isinstance(scene, GaussianSequence):
        raise CapabilityError("a .vis file holds one moment; choose one with --time or --frame")
    chunks = as_chunks(scene)
    if options.raw_color and chunks.sh_degree:
        raise CapabilityError(f"raw colors have no SH, and the scene has degree {chunks.sh_degree}; use --sh-degree 0")
    count, start = len(chunks), 0
    row, color_row = _GAUSSIAN_WORDS[precision], color_words(precision, raw_color=options.raw_color)
    tally: Counter[str] = Counter()
    for chunk in chunks:
        gaussians, colors = encode(chunk, options, precision, tally)
        stream.seek(4 * start * row)
        stream.write(gaussians.data)
        stream.seek(4 * (count * row + start * color_row))
        stream.write(colors.data)
        start += len(chunk)
    lost = tally.pop("thin axes", 0)
    if lost:
        message = (
            f"covariances in half precision lose the thinnest axis of {lost} of {count} splats, which come back flat; "
            "visionary-f32 and visionary-i8 keep them"
        )
        warnings.warn(LossyConversionWarning(message, code="lost-needles"), stacklevel=2)
    if tally:
        parts = ", ".join(f"{number} {what}" for what, number in tally.items())
        warnings.warn(LossyConversionWarning(f"clamped: {parts}", code="clamped"), stacklevel=2)
    buffers = [("gaussian", 0, 4 * row), ("color", 4 * count * row, 4 * color_row)]
    sidecar = compose(
        precision,
        count,
        chunks.sh_degree,
        chunks.template.origin,
        options,
        buffers,
        sh_layout=options.sh_layout,
        raw_color=options.raw_color,
        source_format=chunks.template.source_format,
    )
    attach(stream, sidecar)


def encode(
    cloud: GaussianCloud, options: BufferOptions, precision: Precision, tally: Counter[str]
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the words of both buffers, and add to the counts of what was lost.

    Parameters
    ----------
    cloud
        N splats.
    options
        What the color buffer holds.
    precision
        "f32" or "f16".
    tally
        Counts by what was clamped; "thin axes" are those that half precision loses.

    Raises
    ------
    CapabilityError
        Finite positions are beyond half precision.
    CloudError
        A position is not finite, or a value is not a number.
    """
    check(cloud)
    if precision == "f16":
        beyond = int(np.count_nonzero((np.abs(cloud.means) >= _HALF_OVERFLOW).any(axis=1)))
        if beyond:
            raise CapabilityError(
                f"positions of {beyond} splats are beyond 65504, the largest half; use --recenter on", field="means"
            )
    gaussians = np.empty((len(cloud), _GAUSSIAN_WORDS[precision]), "<u4")
    colors = np.empty((len(cloud), color_words(precision, raw_color=options.raw_color)), "<u4")
    counts = np.zeros((len(blocks(len(cloud))), 3), np.int64)
    largest = _LARGEST[precision]

    def encode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        block = cloud.take(part)
        covariances, is_shrunk = _fitting(block, precision)
        opacities = activations.sigmoid(block.opacity_logits)
        gaussians[part] = codec.encode_gaussians(block.means, opacities, covariances, precision=precision)
        if options.raw_color:
            values = block.sh0.astype(np.float64) * SH_C0 + 0.5
            colors[part] = codec.encode_raw_colors(np.clip(values, -largest, largest).astype(np.float32), precision=precision)
        else:
            values = np.concatenate([block.sh0[:, None], block.shN], axis=1)
            fitting = np.clip(values, -largest, largest)
            colors[part] = codec.encode_sh(fitting[:, 0], fitting[:, 1:], precision=precision, layout=options.sh_layout)
        needles = codec.count_lost_needles(block.quats, block.log_scales, covariances) if precision == "f16" else 0
        counts[start // BLOCK_SIZE] = (
            needles,
            np.count_nonzero(is_shrunk),
            np.count_nonzero(np.abs(values) > largest),
        )

    run_blocks(encode_block, len(cloud))
    for what, number in zip(("thin axes", "splats too large", "color values"), counts.sum(axis=0), strict=True):
        if number:
            tally[what] += int(number)
    return gaussians, colors


def _fitting(cloud: GaussianCloud, precision: Precision) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return covariances in float32, and which of them were shrunk as a whole so that nothing overflows."""
    covariances = covariance_triangles(cloud.quats, cloud.log_scales, dtype=np.float64)
    largest = np.abs(covariances).max(axis=1, initial=0.0)
    is_shrunk = largest > _LARGEST[precision]
    if is_shrunk.any():
        finite = np.minimum(cloud.log_scales, 300.0)  # beyond, float64 overflows too
        covariances = covariance_triangles(cloud.quats, finite, dtype=np.float64)
        covariances[is_shrunk] *= (_LARGEST[precision] / np.abs(covariances[is_shrunk]).max(axis=1))[:, None]
    return covariances.astype(np.float32), is_shrunk


def check(cloud: GaussianCloud) -> None:
    """Refuse what buffers cannot express.

    Raises
    ------
    CloudError
        A position is not finite, or a value is not a number.
    """
    if not np.isfinite(cloud.means).all():
        bad = int(np.count_nonzero(~np.isfinite(cloud.means).all(axis=1)))
        raise CloudError(f"{bad} splats have positions that are not finite; drop them first", field="means")
    for name in ("log_scales", "quats", "opacity_logits", "sh0", "shN"):
        if np.isnan(getattr(cloud, name)).any():
            raise CloudError("values are not numbers; drop those splats first", field=name)
    if np.isposinf(cloud.log_scales).any():
        raise CloudError("scales are infinite; drop those splats first", field="log_scales")


def bounds(source: GaussianCloud, stream: BinaryIO, _frame: int, precision: Precision) -> Bounds:
    """Return the largest errors that the buffers allow for the splats of `source`.

    Notes
    -----
    Every entry of a covariance is rounded; together they move it by at most the Frobenius norm of those errors, and no
    eigenvalue by more (Weyl). What is clamped moves by the rest. Decoded quaternions and log scales are float32: a turn of
    2^-23, and log scales off by 2^-24 of themselves, most felt in the longest.
    """
    companion = companion_of(stream)
    is_raw = companion is not None and companion.get("color") == "raw"
    true = covariance_triangles(source.quats, source.log_scales, dtype=np.float64)
    stored = _fitting(source, precision)[0]
    logs = np.sort(source.log_scales.astype(np.float64), axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        moved = np.abs(stored - true) + _rounding(stored, precision)
        error = np.sqrt((moved**2 * [1, 2, 2, 1, 2, 1]).sum(axis=1))
        norms = np.sqrt((true**2 * [1, 2, 2, 1, 2, 1]).sum(axis=1))
        squares = np.exp(2 * logs)
        noise = error[:, None] + _EIGEN_NOISE * squares[:, 2:]
        shares = np.divide(noise, squares, out=np.full_like(squares, np.inf), where=squares > 0)
        scales = np.where(shares < 1, -0.5 * np.log1p(-np.minimum(shares, 1.0)), np.inf)
        relative = np.divide(error, norms, out=np.where(error > 0, np.inf, 0.0), where=norms > 0) + _EIGEN_NOISE
        # Beyond float64 all that is known is that a covariance shrinks, by no more than the whole of it.
        is_beyond = ~np.isfinite(norms)
        relative, scales = np.where(is_beyond, 1 + _EIGEN_NOISE, relative), np.where(is_beyond[:, None], np.inf, scales)
        sizes = np.where(np.isfinite(logs), np.abs(logs), 0.0)
        scales += (sizes + scales) * _HALF_STEP
        decoding = 2 * _HALF_STEP * (np.sqrt(8.0 / 3.0) + sizes[:, 2] + relative + 0.4)
    opacities = activations.sigmoid(source.opacity_logits.astype(np.float64))
    if is_raw:
        colors = source.sh0.astype(np.float64) * SH_C0 + 0.5
        color_error = _clamped(colors, precision) / SH_C0 + 2 * _HALF_STEP * (np.abs(source.sh0) + 0.5 / SH_C0)
    else:
        color_error = _stored_error(source.sh0, precision)
    return {
        "means": _stored_error(source.means, precision),
        "scales": scales,
        "covariances": relative + (1 + relative) * decoding,
        "opacities": _rounding(opacities, precision) + _HALF_STEP / 4,  # p (1 - p) |logit| stays below a quarter
        "sh0": color_error,
        "shN": _stored_error(source.shN, precision),
    }


def _stored_error(values: NDArray[np.float32], precision: Precision) -> NDArray[np.float64]:
    """Return how far float32 values move that are stored as they are."""
    if precision == "f32":
        return np.zeros((1,) * values.ndim)
    return np.asarray(
        np.maximum(np.abs(values.astype(np.float64)) - _LARGEST["f16"], 0.0)
        + codec.half_error(np.clip(values, -_LARGEST["f16"], _LARGEST["f16"]))
    )


def _clamped(values: NDArray[Any], precision: Precision) -> NDArray[np.float64]:
    """Return how far values move that are clamped to the precision's range and rounded."""
    largest = _LARGEST[precision]
    excess = np.maximum(np.abs(values.astype(np.float64)) - largest, 0.0)
    return np.asarray(excess + _rounding(np.clip(values, -largest, largest), precision))


def _rounding(values: NDArray[Any], precision: Precision) -> NDArray[np.float64]:
    """Return the largest error of storing values in a precision, by way of float32 as the encoder goes."""
    sizes = np.abs(values.astype(np.float64))
    single: NDArray[np.float64] = np.maximum(sizes * 2.0**-24, 2.0**-150)
    if precision == "f32":
        return single
    return single + codec.half_error(np.minimum(sizes + single, _LARGEST["f16"]))
