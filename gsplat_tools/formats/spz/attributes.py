"""Clouds to the bytes of .spz, and back."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud, empty_cloud
from gsplat_tools.codecs.smallest_three import SPZ_FIRST_THREE, SPZ_SMALLEST_THREE, Grid, Rotation, choose_frames, in_frames
from gsplat_tools.errors import CapabilityError, CloudError, GsplatWarning, LossyConversionWarning
from gsplat_tools.formats.spz.header import FIRST_SMALLEST_THREE_VERSION, Header
from gsplat_tools.formats.spz.payload import Payload
from gsplat_tools.parallel import BLOCK_SIZE, blocks, map_ordered, run_blocks

DEFAULT_FRACTIONAL_BITS = 12
FINEST_FRACTIONAL_BITS = 23
STEPS_PER_SCALE = 16
"""Steps of positions that "auto" puts into a splat of middling size, where 1/4096 would be fewer: a half step moves it by
1/32 of its size, no more than the rounding of its scale does."""

LOG_SCALE_MIN, LOG_SCALE_STEP = -10.0, 1 / 16
LOG_SCALE_MAX = LOG_SCALE_MIN + 255 * LOG_SCALE_STEP
COLOR_SCALE = 0.15
"""Color byte / 255 = 0.15 sh0 + 0.5, which reaches beyond the colors that can be seen."""

_LARGEST = (1 << 23) - 1

FractionalBits = int | Literal["auto", "finest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantization:
    """What the writer decides once for a file.

    Parameters
    ----------
    version, fractional_bits
        As the header has them.
    sh1_bits, sh_rest_bits
        Bits of SH values of band 1, and above.
    rotation
        How frames are chosen.
    """

    version: int
    fractional_bits: int
    sh1_bits: int
    sh_rest_bits: int
    rotation: Rotation

    @property
    def grid(self) -> Grid:
        """Grid of the rotations."""
        return rotation_grid(self.version)


def rotation_grid(version: int) -> Grid:
    """Return the grid of the rotations of a version."""
    return SPZ_SMALLEST_THREE if version >= FIRST_SMALLEST_THREE_VERSION else SPZ_FIRST_THREE


def choose_fractional_bits(chunks: CloudChunks, wanted: FractionalBits) -> int:
    """Return how many bits of a position lie behind the point.

    Parameters
    ----------
    chunks
        The scene.
    wanted
        "auto": 12, as other writers do, more where splats are small, fewer where the scene would not fit; "finest": as
        many as fit; or a number.

    Raises
    ------
    CapabilityError
        Positions do not fit.
    CloudError
        A position is not finite.

    Warns
    -----
    GsplatWarning
        The steps are coarser than those of other writers.
    """
    largest, sum_of_logs = 0.0, 0.0
    for chunk in chunks:
        if len(chunk):
            low, high = chunk.means.min(), chunk.means.max()
            if not np.isfinite([low, high]).all():
                bad = int(np.count_nonzero(~np.isfinite(chunk.means).all(axis=1)))
                raise CloudError(f"{bad} splats have positions that are not finite; drop them first", field="means")
            largest = max(largest, -float(low), float(high))
            sum_of_logs += float(np.nan_to_num(chunk.log_scales.max(axis=1), nan=0.0).clip(LOG_SCALE_MIN, LOG_SCALE_MAX).sum())
    fitting = FINEST_FRACTIONAL_BITS if largest == 0 else int(np.floor(np.log2((_LARGEST - 0.5) / largest)))
    if isinstance(wanted, int):
        bits = wanted
    elif wanted == "finest":
        bits = max(min(fitting, FINEST_FRACTIONAL_BITS), 0)
    else:
        logarithm = sum_of_logs / max(len(chunks), 1)
        useful = round(np.log2(STEPS_PER_SCALE) - logarithm / np.log(2.0))
        bits = max(min(fitting, max(DEFAULT_FRACTIONAL_BITS, useful), FINEST_FRACTIONAL_BITS), 0)
    if bits > fitting:
        limit = (_LARGEST - 0.5) / (1 << bits)
        outside = sum(int(np.count_nonzero((np.abs(chunk.means) > limit).any(axis=1))) for chunk in chunks)
        raise CapabilityError(
            f"{outside} of {len(chunks)} splats lie beyond {limit:.6g}, the end of 24 bits with {bits} behind the point (up to "
            f"{largest:.6g}); use --recenter on, or leave them out",
            field="means",
        )
    if bits < DEFAULT_FRACTIONAL_BITS and not isinstance(wanted, int):
        warnings.warn(
            GsplatWarning(
                f"positions reach {largest:.6g} and are stored in steps of {0.5**bits:.3g} instead of "
                f"{0.5**DEFAULT_FRACTIONAL_BITS:.3g}: use --recenter on, or leave far splats out",
                code="position-step",
            ),
            stacklevel=3,
        )
    return bits


class ClampTally:
    """Counts what was clamped, over chunks; warns at the end."""

    def __init__(self) -> None:
        self._clamped: dict[str, int] = {}

    def add(self, counts: NDArray[np.int64]) -> None:
        """Take the counts of the kernels for one more chunk into account.

        Raises
        ------
        CloudError
            A value is not a number, or the scene changed between two looks at it.
        """
        from gsplat_tools.kernels import spz_pack

        if counts[spz_pack.INVALID]:
            raise CloudError(
                f"{counts[spz_pack.INVALID]} values of scale, opacity, color or SH are not numbers; drop those splats first"
            )
        if counts[spz_pack.POSITIONS]:
            raise CloudError(f"{counts[spz_pack.POSITIONS]} positions do not fit", field="means")
        found = {
            f"scale axes outside e^{LOG_SCALE_MIN:g}..e^{LOG_SCALE_MAX:g}": counts[spz_pack.SCALES],
            "color channels beyond the range of the bytes": counts[spz_pack.COLORS],
            "SH values outside -1..0.992": counts[spz_pack.SH],
        }
        for name, count in found.items():
            if count:
                self._clamped[name] = self._clamped.get(name, 0) + int(count)

    def finish(self) -> None:
        """Warn where values were clamped."""
        if self._clamped:
            parts = ", ".join(f"{count} {name}" for name, count in self._clamped.items())
            warnings.warn(LossyConversionWarning(f"clamped: {parts}", code="clamped"), stacklevel=3)


def encode_rows(cloud: GaussianCloud, how: Quantization) -> tuple[Payload, NDArray[np.int64]]:
    """Return the bytes of a chunk by attribute, and what the kernels counted.

    Raises
    ------
    CloudError
        A quaternion is not finite.
    """
    from gsplat_tools.kernels import smallest_three, spz_pack

    count = len(cloud)
    _check_quats(cloud)
    frames = choose_frames(cloud.quats, cloud.log_scales, how.grid, how.rotation)
    quats, log_scales = in_frames(cloud.quats, cloud.log_scales, frames)
    is_small = how.version >= FIRST_SMALLEST_THREE_VERSION
    rows: Payload = {name: np.empty((count, width), np.uint8) for name, width in _widths(how, cloud).items()}
    words = np.empty(count if is_small else 0, np.uint32)
    counts = np.zeros((len(blocks(count)), spz_pack.NUM_COUNTS), np.int64)
    steps = float(1 << how.fractional_bits)
    buckets = 1 << (8 - how.sh1_bits), 1 << (8 - how.sh_rest_bits)

    def encode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        spz_pack.encode_splats(
            cloud.means[part],
            log_scales[part],
            cloud.opacity_logits[part],
            cloud.sh0[part],
            steps,
            rows["positions"][part],
            rows["alphas"].reshape(-1)[part],
            rows["colors"][part],
            rows["scales"][part],
            counts[start // BLOCK_SIZE],
        )
        if is_small:
            smallest_three.pack_signed(quats[part], words[part])
        else:
            smallest_three.pack_first_three(quats[part], rows["rotations"][part])
        if "sh" in rows:
            spz_pack.encode_sh(cloud.shN[part], *buckets, rows["sh"][part], counts[start // BLOCK_SIZE])

    run_blocks(encode_block, count)
    if is_small:
        rows["rotations"] = words.astype("<u4", copy=False).view(np.uint8).reshape(count, 4)
    return rows, counts.sum(axis=0)


def _widths(how: Quantization, cloud: GaussianCloud) -> dict[str, int]:
    """Return the bytes a splat of every attribute that there is."""
    header = Header(version=how.version, num_splats=len(cloud), sh_degree=cloud.sh_degree, fractional_bits=0, flags=0)
    return {name: width for name, width in header.attributes().items() if width}


def _check_quats(cloud: GaussianCloud) -> None:
    """Refuse quaternions that are not finite."""
    from gsplat_tools.kernels.validity import has_nonfinite

    if has_nonfinite(cloud.quats.reshape(-1).view(np.uint32)):
        bad = int(np.count_nonzero(~np.isfinite(cloud.quats).all(axis=1)))
        raise CloudError(f"{bad} of {len(cloud)} quaternions are not finite; drop them first", field="quats")


def decode_rows(header: Header, rows: Payload) -> GaussianCloud:
    """Return the splats that bytes stand for: unit quaternions; opacity bytes 0 and 255 have logits -inf and +inf."""
    from gsplat_tools.kernels import smallest_three, spz_pack

    count = len(rows["positions"]) if rows else 0
    cloud = empty_cloud(count, header.sh_degree)
    logits, colors, scales, harmonics = _tables()
    step = 0.5**header.fractional_bits

    def decode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        if header.version == 1:
            cloud.means[part] = np.ascontiguousarray(rows["positions"][part]).view("<f2")
        else:
            spz_pack.decode_positions(rows["positions"][part], step, cloud.means[part])
        spz_pack.look_up(rows["alphas"][part].reshape(-1), logits, cloud.opacity_logits[part])
        spz_pack.look_up(rows["colors"][part].reshape(-1), colors, cloud.sh0[part].reshape(-1))
        spz_pack.look_up(rows["scales"][part].reshape(-1), scales, cloud.log_scales[part].reshape(-1))
        if header.version >= FIRST_SMALLEST_THREE_VERSION:
            words = np.ascontiguousarray(rows["rotations"][part]).view("<u4").reshape(-1).astype(np.uint32, copy=False)
            smallest_three.unpack_signed(words, cloud.quats[part])
        else:
            smallest_three.unpack_first_three(rows["rotations"][part], cloud.quats[part])
        if "sh" in rows:
            spz_pack.look_up(rows["sh"][part].reshape(-1), harmonics, cloud.shN[part].reshape(-1))

    run_blocks(decode_block, count)
    model = "antialiased" if header.splat_model == "antialiased" else "default"
    return cloud.replace(coordinate_system=header.coordinate_system, splat_model=model)


def _tables() -> tuple[NDArray[np.float32], ...]:
    """Return opacity logit, constant term, log scale and SH value of every byte."""
    codes = np.arange(256.0)
    with np.errstate(divide="ignore"):
        logits = np.log(codes) - np.log(255 - codes)
    values = (
        logits,
        (codes / 255 - 0.5) / COLOR_SCALE,
        LOG_SCALE_MIN + codes * LOG_SCALE_STEP,
        (codes - 128) / 128,
    )
    return tuple(table.astype(np.float32) for table in values)


def encode_chunks(chunks: CloudChunks, how: Quantization, tally: ClampTally) -> Iterator[Payload]:
    """Yield the bytes of every chunk; the next one is encoded while a consumer works on the last.

    Raises
    ------
    CloudError
        A value is not a number, or the chunks do not hold the splats that were announced.
    """
    total = 0
    for rows, counts in map_ordered(lambda chunk: encode_rows(chunk, how), chunks, ahead=2):
        tally.add(counts)
        total += len(rows["positions"])
        yield rows
    if total != len(chunks):
        raise CloudError(f"the scene announced {len(chunks)} splats but its chunks hold {total}")
