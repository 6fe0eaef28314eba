"""Clouds to the uncompressed layout and back: float32 arrays of activated values (docs/formats/uncompressed.md)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud, empty_cloud
from gsplat_tools.errors import CloudError, LossyConversionWarning
from gsplat_tools.parallel import run_blocks

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UncompressedPack:
    """A cloud as arrays that a renderer reads as they are.

    Parameters
    ----------
    positions
        (N, 3) f32, relative to the origin.
    colors
        (N, 4) f32: the SH constant term r g b as stored, then opacity in [0, 1].
    scales
        (N, 3) f32, linear.
    rotations
        (N, 4) f32 unit quaternions, wxyz.
    shs
        (N, C, 3) f32, coefficient-major, or None for degree 0.
    velocities, times, durations
        Motion, as the cloud has it, or None.
    metadata
        Origin, coordinate system, splat model and time model, as `GaussianCloud` names them.
    """

    positions: Float32
    colors: Float32
    scales: Float32
    rotations: Float32
    shs: Float32 | None = None
    velocities: Float32 | None = None
    times: Float32 | None = None
    durations: Float32 | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sh_degree(self) -> int:
        """Highest SH band, 0 to 4."""
        return 0 if self.shs is None else REST_COEFFICIENTS.index(self.shs.shape[1])


class RangeTally:
    """Counts scales that float32 cannot hold, over chunks; warns at the end."""

    def __init__(self) -> None:
        self.clamped = 0
        self.flattened = 0

    def add(self, cloud: GaussianCloud, scales: Float32) -> None:
        """Take one more chunk into account; scales that overflowed become the largest float32."""
        if not np.isfinite(cloud.means).all():
            bad = int(np.count_nonzero(~np.isfinite(cloud.means).all(axis=1)))
            raise CloudError(f"{bad} splats have positions that are not finite; drop them first", field="means")
        is_over = np.isinf(scales)
        if is_over.any():
            self.clamped += int(np.count_nonzero(is_over))
            scales[is_over] = np.finfo(np.float32).max
        if scales.min(initial=1.0) == 0.0:
            self.flattened += int(np.count_nonzero((scales == 0) & np.isfinite(cloud.log_scales)))

    def finish(self) -> None:
        """Warn where scales were changed."""
        if self.clamped:
            message = f"clamped {self.clamped} scale axes above 3.4e38, the end of float32"
            warnings.warn(LossyConversionWarning(message, code="clamped"), stacklevel=3)
        if self.flattened:
            message = f"{self.flattened} scale axes below 1.4e-45 became exactly flat"
            warnings.warn(LossyConversionWarning(message, code="flattened"), stacklevel=3)


def encode_rows(cloud: GaussianCloud, tally: RangeTally) -> dict[str, Float32]:
    """Return the arrays of a chunk by the name of their stream.

    Raises
    ------
    CloudError
        A position is not finite.
    """
    count = len(cloud)
    colors, scales, rotations = (np.empty((count, width), np.float32) for width in (4, 3, 4))

    def encode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        colors[part, :3] = cloud.sh0[part]
        colors[part, 3] = activations.sigmoid(cloud.opacity_logits[part])
        with np.errstate(over="ignore", under="ignore"):  # counted below
            scales[part] = np.exp(cloud.log_scales[part].astype(np.float64))
        quats = cloud.quats[part].astype(np.float64)
        lengths = np.sqrt(np.square(quats).sum(axis=1, keepdims=True))
        is_null = lengths == 0
        rotations[part] = np.where(is_null, (1.0, 0.0, 0.0, 0.0), quats / np.where(is_null, 1.0, lengths))

    run_blocks(encode_block, count)
    tally.add(cloud, scales)
    rows = {"positions": cloud.means, "colors": colors, "scales": scales, "rotations": rotations}
    return rows | ({"shs": cloud.shN} if cloud.sh_degree else {})


def encode(cloud: GaussianCloud) -> UncompressedPack:
    """Activate a cloud's values.

    Parameters
    ----------
    cloud
        N splats of degree 0 to 4.

    Returns
    -------
    UncompressedPack
        Arrays; a quaternion of length 0 is the identity.

    Raises
    ------
    CloudError
        A position is not finite.

    Warns
    -----
    LossyConversionWarning
        Scales beyond float32 were clamped or became flat.
    """
    tally = RangeTally()
    rows = encode_rows(cloud, tally)
    tally.finish()
    motion = {"velocities": cloud.velocities, "times": cloud.times, "durations": cloud.durations}
    metadata = {name: getattr(cloud, name) for name in ("origin", "coordinate_system", "splat_model", "time_model")}
    return UncompressedPack(**rows, **motion, metadata=metadata)  # type: ignore[arg-type]


def decode_rows(rows: Mapping[str, NDArray[Any]], target: GaussianCloud) -> None:
    """Fill the arrays of `target`, but for motion, from those of its splats."""
    target.means[:] = rows["positions"]
    target.sh0[:] = rows["colors"][:, :3]
    target.opacity_logits[:] = activations.logit(np.ascontiguousarray(rows["colors"][:, 3], np.float32))
    with np.errstate(divide="ignore", invalid="ignore"):
        target.log_scales[:] = np.log(rows["scales"].astype(np.float64))
    target.quats[:] = rows["rotations"]
    if target.sh_degree:
        target.shN[:] = rows["shs"]


def decode(pack: UncompressedPack) -> GaussianCloud:
    """Return the cloud that a pack holds.

    Parameters
    ----------
    pack
        Arrays of N splats.

    Returns
    -------
    GaussianCloud
        Opacities 0 and 1 have logits -inf and +inf, scales 0 have log scale -inf.
    """
    rows = {name: getattr(pack, name) for name in ("positions", "colors", "scales", "rotations", "shs")}
    cloud = empty_cloud(len(pack.positions), pack.sh_degree)

    def decode_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        decode_rows({name: values[part] for name, values in rows.items() if values is not None}, cloud.take(part))

    run_blocks(decode_block, len(cloud))
    motion = {"velocities": pack.velocities, "times": pack.times, "durations": pack.durations}
    return cloud.replace(**pack.metadata, **motion)
