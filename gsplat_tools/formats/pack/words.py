"""Clouds to Spark's words and back: the layout, without the container that holds it (docs/formats/spark.md)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, empty_cloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats.pack.description import SH_WORDS
from gsplat_tools.formats.pack.encoding import FLAT_LN_SCALE, SplatEncoding
from gsplat_tools.parallel import run_blocks

Rotation = Literal["reference", "best", "small"]
"""How the frame of a rotation is chosen: as Spark's own encoder, smallest error, or the bytes that compress best."""

Words = NDArray[np.uint32]

SH_BITS = {1: 7, 2: 8, 3: 6, 4: 4}
"""Bits of a value of each SH band; the largest code is 2^(bits - 1) - 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SparkPack:
    """A cloud in Spark's layout.

    Parameters
    ----------
    packed
        (N, 4) u32, 16 bytes a splat.
    sh1, sh2, sh3, sh4
        (N, 2), (N, 4), (N, 4), (N, 4) u32, or None above the degree.
    encoding
        Ranges of the quantized fields.
    velocities, times, durations
        Motion, as the cloud has it, or None.
    metadata
        Origin, coordinate system, splat model and time model, as `GaussianCloud` names them.
    clamped
        Values that were out of range, by kind; also warned about when they were encoded.
    """

    packed: Words
    sh1: Words | None = None
    sh2: Words | None = None
    sh3: Words | None = None
    sh4: Words | None = None
    encoding: SplatEncoding = field(default_factory=SplatEncoding)
    velocities: NDArray[np.float32] | None = None
    times: NDArray[np.float32] | None = None
    durations: NDArray[np.float32] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    clamped: Mapping[str, int] = field(default_factory=dict)

    @property
    def sh_degree(self) -> int:
        """Highest SH band, 0 to 4."""
        return max((band for band in SH_WORDS if getattr(self, f"sh{band}") is not None), default=0)


class ClampTally:
    """Counts what an encoding could not hold, over chunks; raises or warns at the end."""

    def __init__(self, encoding: SplatEncoding) -> None:
        self._encoding = encoding
        self.splats = 0
        self.overflows = 0
        self.clamped: dict[str, int] = {}
        self._largest = 0.0

    def add(self, cloud: GaussianCloud, counts: NDArray[np.int64], bands: Mapping[int, NDArray[np.int64]]) -> None:
        """Take the counts of the kernels for one more chunk into account.

        Raises
        ------
        CloudError
            A value is not a number.
        """
        from gsplat_tools.kernels import spark_pack, spark_sh

        self.splats += len(cloud)
        if counts[spark_pack.OVERFLOWS]:
            if not np.isfinite(cloud.means).all():
                bad = int(np.count_nonzero(~np.isfinite(cloud.means).all(axis=1)))
                raise CloudError(f"{bad} splats have positions that are not finite; drop them first", field="means")
            self.overflows += int(counts[spark_pack.OVERFLOWS])
            self._largest = max(self._largest, float(np.abs(cloud.means).max()))
        if counts[spark_pack.INVALID]:
            raise CloudError(
                f"{counts[spark_pack.INVALID]} splats have a scale, rotation, opacity or color that is not a number;"
                " drop them first"
            )
        found = {
            "colors": counts[spark_pack.COLORS],
            "scales": counts[spark_pack.SCALES],
            "flattened": counts[spark_pack.FLATTENED],
        }
        for band, band_counts in bands.items():
            if band_counts[spark_sh.INVALID]:
                raise CloudError(
                    f"{band_counts[spark_sh.INVALID]} coefficients are not finite; drop those splats first", field="shN"
                )
            found[f"sh{band}"] = band_counts[spark_sh.CLAMPED]
        for name, count in found.items():
            if count:
                self.clamped[name] = self.clamped.get(name, 0) + int(count)

    def finish(self) -> None:
        """Raise where positions do not fit, warn where values were clamped.

        Raises
        ------
        CapabilityError
            Finite positions are beyond the range of half precision.
        """
        if self.overflows:
            raise CapabilityError(
                f"{self.overflows} of {self.splats} splats lie beyond 65504, the end of half precision"
                f" (up to {self._largest:.6g}); use --recenter on, or leave them out",
                field="means",
            )
        ranges = self._encoding
        words = {
            "colors": f"color channels outside {ranges.rgb_min:g}..{ranges.rgb_max:g}",
            "scales": f"scale axes outside e^{ranges.ln_scale_min:g}..e^{ranges.ln_scale_max:g}",
            **{f"sh{band}": f"SH values of band {band} beyond {ranges.sh_max(band):g}" for band in SH_WORDS},
        }
        parts = [f"{self.clamped[name]} {text}" for name, text in words.items() if name in self.clamped]
        if parts:
            message = f"clamped {', '.join(parts)}, in {self.splats} splats; .gspk with --spark-encoding fit holds them all"
            warnings.warn(LossyConversionWarning(message, code="clamped"), stacklevel=3)
        if "flattened" in self.clamped:
            message = f"{self.clamped['flattened']} scale axes below e^{FLAT_LN_SCALE:g} became exactly flat"
            warnings.warn(LossyConversionWarning(message, code="flattened"), stacklevel=3)


def choose_frames(cloud: GaussianCloud, encoding: SplatEncoding, rotation: Rotation) -> NDArray[np.uint8]:
    """Return which of the 24 frames each splat is packed in, (N,); empty where all stay as they are.

    Parameters
    ----------
    cloud
        N splats.
    encoding
        Ranges; the error is that of the decoded covariance.
    rotation
        "reference" keeps every frame, "best" takes the smallest error, "small" the smallest turn.
    """
    from gsplat_tools.kernels import rotation_frames, spark_frames

    if rotation not in get_args(Rotation):
        raise ValueError(f"rotation must be one of {', '.join(get_args(Rotation))}, got {rotation!r}")
    if rotation == "reference":
        return np.empty(0, np.uint8)
    frames = np.empty(len(cloud), np.uint8)
    steps = 1.0 / encoding.ln_scale_step

    def choose(start: int, stop: int) -> None:
        quats = cloud.quats[start:stop]
        if rotation == "small":
            rotation_frames.frames_of_largest_w(quats, frames[start:stop])
        else:
            log_scales = cloud.log_scales[start:stop]
            spark_frames.choose_frames(quats, log_scales, encoding.ln_scale_min, steps, False, frames[start:stop])

    run_blocks(choose, len(cloud))
    return frames


def encode_rows(cloud: GaussianCloud, encoding: SplatEncoding, rotation: Rotation, tally: ClampTally) -> dict[str, Words]:
    """Return the words of a chunk by the name of their stream, and count what was clamped.

    Raises
    ------
    CloudError
        A value is not a number.
    """
    from gsplat_tools.kernels import spark_pack

    count = len(cloud)
    frames = choose_frames(cloud, encoding, rotation)
    ranges = np.array([encoding.rgb_min, encoding.rgb_max, encoding.ln_scale_min, encoding.ln_scale_max])
    rest = cloud.shN.reshape(count, 3 * cloud.shN.shape[1])
    rows = {"packed": np.empty((count, 4), np.uint32)}
    for band in range(1, cloud.sh_degree + 1):
        rows[f"sh{band}"] = np.empty((count, SH_WORDS[band]), np.uint32)
    num_blocks = -(-count // _BLOCK)
    counts = np.zeros((num_blocks, spark_pack.NUM_COUNTS), np.int64)
    band_counts = {band: np.zeros((num_blocks, 2), np.int64) for band in range(1, cloud.sh_degree + 1)}

    def encode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        block = start // _BLOCK
        with np.errstate(over="ignore"):  # counted by the kernel
            halves = cloud.means[part].astype(np.float16).view(np.uint16)
        spark_pack.encode_cloud(
            halves,
            cloud.log_scales[part],
            cloud.quats[part],
            cloud.opacity_logits[part],
            cloud.sh0[part],
            frames[part] if len(frames) else frames,
            ranges,
            rows["packed"][part],
            counts[block],
        )
        for band, found in band_counts.items():
            encode_band(rest[part], 3 * (band * band - 1), band, encoding, rows[f"sh{band}"][part], found[block])

    run_blocks(encode_block, count, _BLOCK)
    tally.add(cloud, counts.sum(axis=0), {band: found.sum(axis=0) for band, found in band_counts.items()})
    return rows


_BLOCK = 1 << 14


def encode_band(
    rest: NDArray[np.float32], first: int, band: int, encoding: SplatEncoding, packed: Words, counts: NDArray[np.int64]
) -> None:
    """Write the words of one SH band, whose values begin at column `first` of `rest` (N, V)."""
    from gsplat_tools.kernels import spark_sh

    limit = float((1 << (SH_BITS[band] - 1)) - 1)
    # Spark multiplies bands 1 and 3 by limit / max, band 2 by 1 / max and then by limit: the bits can differ.
    scale, then = (1.0 / encoding.sh_max(band), limit) if band == 2 else (limit / encoding.sh_max(band), 1.0)
    spark_sh.encode_band(rest, first, scale, then, limit, SH_BITS[band], 3 * (2 * band + 1), packed, counts)


def encode_values(
    means: NDArray[np.float32],
    scales: NDArray[np.float32],
    quats: NDArray[np.float32],
    opacities: NDArray[np.float32],
    colors: NDArray[np.float32],
    encoding: SplatEncoding | None = None,
) -> Words:
    """Return the 16 bytes of splats whose values are activated already, as Spark's own encoder takes them.

    Parameters
    ----------
    means, scales, quats, opacities, colors
        (N, 3), (N, 3) linear, (N, 4) wxyz, (N,), (N, 3). Beyond the range of half a position becomes infinite, anything
        else is clamped; nothing is counted.
    encoding
        Ranges of the quantized fields; Spark's defaults where None.

    Returns
    -------
    Words
        (N, 4) u32.
    """
    from gsplat_tools.kernels import spark_pack

    encoding = encoding if encoding is not None else SplatEncoding()
    wide = np.asarray(scales, np.float64)
    with np.errstate(divide="ignore", over="ignore"):
        ln_scales = np.where(wide < np.exp(FLAT_LN_SCALE), -np.inf, np.log(wide))
        halves = np.asarray(means, np.float32).astype(np.float16).view(np.uint16)
    packed = np.empty((len(halves), 4), np.uint32)
    ranges = np.array([encoding.rgb_min, encoding.rgb_max, encoding.ln_scale_min, encoding.ln_scale_max])
    values = [np.ascontiguousarray(array, np.float64) for array in (ln_scales, quats, opacities, colors)]
    spark_pack.encode_values(halves, *values, ranges, packed, np.zeros(spark_pack.NUM_COUNTS, np.int64))
    return packed


def encode(cloud: GaussianCloud, *, encoding: SplatEncoding | None = None, rotation: Rotation = "reference") -> SparkPack:
    """Pack a cloud into Spark's layout.

    Parameters
    ----------
    cloud
        N splats of degree 0 to 4.
    encoding
        Ranges of the quantized fields; Spark's defaults where None.
    rotation
        "reference" has the bits of Spark's own encoder; "best" packs each splat in the one of its 24 frames that decodes
        with the smallest error of the covariance; "small" in the one that makes the bytes most alike.

    Returns
    -------
    SparkPack
        The words, and how many values were clamped.

    Raises
    ------
    CapabilityError
        Finite positions are beyond the range of half precision.
    CloudError
        A value is not a number.

    Warns
    -----
    LossyConversionWarning
        Values out of range were clamped, or scales below e^-30 became flat.
    """
    encoding = encoding if encoding is not None else SplatEncoding()
    tally = ClampTally(encoding)
    rows = encode_rows(cloud, encoding, rotation, tally)
    tally.finish()
    motion = {"velocities": cloud.velocities, "times": cloud.times, "durations": cloud.durations}
    metadata = {name: getattr(cloud, name) for name in ("origin", "coordinate_system", "splat_model", "time_model")}
    return SparkPack(**rows, **motion, encoding=encoding, metadata=metadata, clamped=tally.clamped)  # type: ignore[arg-type]


def decode_rows(rows: Mapping[str, NDArray[Any]], encoding: SplatEncoding, target: GaussianCloud) -> None:
    """Fill the arrays of `target`, but for motion, from the words of its splats."""
    from gsplat_tools.kernels import spark_sh, spark_unpack

    packed = rows["packed"]
    target.means[:] = stored_positions(packed)
    spark_unpack.decode_cloud(packed, *_tables(encoding), target.log_scales, target.quats, target.opacity_logits, target.sh0)
    rest = target.shN.reshape(len(target), 3 * target.shN.shape[1])
    for band in range(1, target.sh_degree + 1):
        bits = SH_BITS[band]
        step = encoding.sh_max(band) / ((1 << (bits - 1)) - 1)
        spark_sh.decode_band(rows[f"sh{band}"], bits, 3 * (2 * band + 1), step, 3 * (band * band - 1), rest)


def stored_positions(packed: Words) -> NDArray[np.float32]:
    """Return the positions (N, 3) that words hold: halves 2, 3 and 4 of the eight that a splat has."""
    halves = np.ascontiguousarray(packed, "<u4").view("<f2").reshape(-1, 8)
    return halves[:, 2:5].astype(np.float32)


def _tables(encoding: SplatEncoding) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return log scale, opacity logit and constant term of every code."""
    codes = np.arange(256.0)
    log_scales = encoding.ln_scale_min + (codes - 1) * encoding.ln_scale_step
    log_scales[0] = -np.inf
    with np.errstate(divide="ignore"):
        logits = np.log(codes) - np.log(255 - codes)
    colors = encoding.rgb_min + codes / 255 * (encoding.rgb_max - encoding.rgb_min)
    return log_scales.astype(np.float32), logits.astype(np.float32), ((colors - 0.5) / SH_C0).astype(np.float32)


def decode(pack: SparkPack) -> GaussianCloud:
    """Return the cloud that a pack holds.

    Parameters
    ----------
    pack
        Words and their ranges.

    Returns
    -------
    GaussianCloud
        N splats; quaternions are unit with w >= 0, opacity codes 0 and 255 have logits -inf and +inf.
    """
    count = len(pack.packed)
    rows = {name: getattr(pack, name) for name in ("packed", *(f"sh{band}" for band in range(1, pack.sh_degree + 1)))}
    rows = {name: np.ascontiguousarray(words, np.uint32) for name, words in rows.items()}
    cloud = empty_cloud(count, pack.sh_degree)

    def decode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        decode_rows({name: words[part] for name, words in rows.items()}, pack.encoding, cloud.take(part))

    run_blocks(decode_block, count)
    assert cloud.shN.shape[1] == REST_COEFFICIENTS[pack.sh_degree]
    motion = {"velocities": pack.velocities, "times": pack.times, "durations": pack.durations}
    return cloud.replace(**pack.metadata, **motion)
