"""The 64-byte record of both versions.

| bytes | field |
|---|---|
| 0-11 | px py pz float32, world units |
| 12-23 | sx sy sz float32, linear |
| 24-27 | r g b a uint8: f_dc * SH_C0 + 0.5, and opacity, in 255ths |
| 28-31 | rw rx ry rz uint8, (b - 128) / 128 |
| 32-43 | vx vy vz float32, world units per 1.0 of normalized time |
| 44-51 | time, duration float32 |
| 52-63 | padding, 0 |
"""

from __future__ import annotations

import warnings
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.errors import LossyConversionWarning

RECORD = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),
        ("rgba", "u1", 4),
        ("quat", "u1", 4),
        ("velocity", "<f4", 3),
        ("time", "<f4"),
        ("duration", "<f4"),
        ("padding", "V12"),
    ]
)
assert RECORD.itemsize == 64

MAX_SH0 = 0.5 / SH_C0
"""Largest coefficient of the constant term that a byte of color reaches, either way."""

LOG_SCALE_RANGE = (float(np.log(np.finfo(np.float32).tiny)), 88.72)
"""Logarithms of the scales that a normal float32 holds; GPUs take smaller ones for 0."""


def encode(cloud: GaussianCloud, rotation: Literal["best", "small", "reference"]) -> NDArray[Any]:
    """Return the records of a cloud whose times suit its time model.

    Warns
    -----
    LossyConversionWarning
        Colors or scales were clamped, with counts.
    """
    from gsplat_tools.codecs import quaternion_u8

    records = np.zeros(len(cloud), RECORD)
    records["mean"] = cloud.means
    if rotation == "reference":
        records["quat"], log_scales = quaternion_u8.encode(cloud.quats, mode="reference"), cloud.log_scales
    else:
        records["quat"], log_scales = quaternion_u8.encode_with_frames(cloud.quats, cloud.log_scales, mode=rotation)
    low, high = LOG_SCALE_RANGE
    is_outside = np.isfinite(log_scales) & ((log_scales < low) | (log_scales > high))
    clipped = np.where(is_outside, np.clip(log_scales, low, high), log_scales)
    records["scale"] = activations.exp_scales(clipped.astype(np.float32))
    colors = cloud.sh0.astype(np.float64) * SH_C0 + 0.5
    records["rgba"][:, :3] = np.rint(np.clip(colors, 0, 1) * 255)
    records["rgba"][:, 3] = np.rint(activations.sigmoid(cloud.opacity_logits.astype(np.float64)) * 255)
    if cloud.has_motion:
        records["velocity"], records["time"], records["duration"] = cloud.velocities, cloud.times, cloud.durations
    else:
        records["duration"] = 1
    half_step = 0.5 / 255
    _warn_clamped("colors", ((colors < -half_step) | (colors > 1 + half_step)).any(axis=1), "beyond 0..1", "clamped-sh0")
    _warn_clamped("scales", is_outside.any(axis=1), "beyond float32", "clamped-scales")
    return records


def _warn_clamped(what: str, is_clamped: NDArray[np.bool_] | np.bool_, why: str, code: str) -> None:
    count = int(np.count_nonzero(is_clamped))
    if count:
        message = f".splat4d clamped the {what} of {count} of {np.size(is_clamped)} splats that are {why}"
        warnings.warn(LossyConversionWarning(message, code=code), stacklevel=4)


def decode_into(records: NDArray[Any], cloud: GaussianCloud) -> None:
    """Fill the arrays of a cloud with motion, all but shN, from as many records; nothing is repaired."""
    from gsplat_tools.codecs import quaternion_u8

    assert cloud.velocities is not None
    assert cloud.times is not None
    assert cloud.durations is not None
    cloud.means[:] = records["mean"]
    with np.errstate(invalid="ignore"):
        cloud.log_scales[:] = activations.log_scales(records["scale"].astype(np.float32))
    bytes_ = records["rgba"].astype(np.float64) / 255
    cloud.sh0[:] = (bytes_[:, :3] - 0.5) / SH_C0
    cloud.opacity_logits[:] = activations.logit(bytes_[:, 3])
    cloud.quats[:] = quaternion_u8.decode(records["quat"])
    cloud.velocities[:] = records["velocity"]
    cloud.times[:] = records["time"]
    cloud.durations[:] = records["duration"]


def is_gaussian(times: NDArray[np.floating[Any]], durations: NDArray[np.floating[Any]]) -> bool:
    """Whether version 1 records are of the gaussian model: over 1 % of the times, or of the durations, lie outside [0, 1].

    Values that are not finite count as inside, because the fork replaces them by 0 first.
    """
    if len(times) == 0:
        return False
    return any(
        np.count_nonzero(np.isfinite(values) & ((values < 0) | (values > 1))) > 0.01 * len(values)
        for values in (times, durations)
    )
