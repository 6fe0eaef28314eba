"""The .splat4d asset of the raiscui/gsplat-unity fork: splats with velocity, time and duration.

Version 1 is an array of 64-byte records, known by its extension alone; version 2 puts a header before them and a table of
sections behind: RECS (the records), META, and for every SH band SHCT (codebook), SHLB (labels) and SHDL (their changes).
The byte tables are in `records` and `container`; the page is docs/formats/splat4d.md.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from gsplat_tools.attributes.motion import MIN_SIGMA
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0
from gsplat_tools.formats.base import Bounds, Format
from gsplat_tools.formats.splat4d.checking import RULES, check
from gsplat_tools.formats.splat4d.container import MAGIC
from gsplat_tools.formats.splat4d.options import KNOBS, Splat4dOptions, Splat4dReadOptions
from gsplat_tools.formats.splat4d.reading import inspect, read
from gsplat_tools.formats.splat4d.records import LOG_SCALE_RANGE, MAX_SH0
from gsplat_tools.formats.splat4d.writing import write

__all__ = ["FORMAT", "Splat4dOptions", "Splat4dReadOptions", "bounds", "inspect", "matches", "read", "write"]

_SCALE_ROUNDING = 2.0**-23
"""A scale is rounded to float32, which moves its logarithm by half of this, and so is the logarithm."""


def matches(head: bytes) -> bool:
    """Whether a file starts with the magic of version 2; version 1 has none."""
    return head.startswith(MAGIC)


def bounds(source: GaussianCloud, _stream: BinaryIO, _frame: int) -> Bounds:
    """Return the largest errors that records allow; shN depends on the codebook and is measured only.

    Parameters
    ----------
    source
        The cloud as it was given to `write`.

    Returns
    -------
    Bounds
        Zero for what is stored as float32, but for scales, which are stored linear; half of 1/255 for opacity and color;
        what clamping adds, splat by splat; covariances from the rotation's largest error.
    """
    from gsplat_tools.codecs.quaternion_u8 import MAX_ANGLE
    from gsplat_tools.codecs.rotation_bounds import covariance_bound_of_ranges

    logs = source.log_scales.astype(np.float64)
    is_finite = np.isfinite(logs)
    kept = np.where(is_finite, np.clip(logs, *LOG_SCALE_RANGE), logs)
    errors = np.where(is_finite, np.abs(np.nan_to_num(logs) - np.nan_to_num(kept)) + _SCALE_ROUNDING, 0.0)
    order = np.argsort(logs, axis=1)
    limits: Bounds = {
        "means": np.zeros((1, 3)),
        "scales": np.take_along_axis(errors, order, axis=1),
        "covariances": covariance_bound_of_ranges(logs, kept - _SCALE_ROUNDING, kept + _SCALE_ROUNDING, MAX_ANGLE),
        "opacities": np.full(1, 0.5 / 255 + _SCALE_ROUNDING),
        "sh0": 0.5 / 255 / SH_C0 + np.maximum(np.abs(source.sh0.astype(np.float64)) - MAX_SH0, 0.0),
    }
    if source.times is not None and source.durations is not None:
        times, durations = source.times.astype(np.float64), source.durations.astype(np.float64)
        is_window = source.time_model == "window"
        limits |= {
            "velocities": np.zeros((1, 3)),
            "times": np.abs(times - np.clip(times, 0, 1)) if is_window else np.zeros(1),
            "durations": np.abs(durations - (np.clip(durations, 0, 1) if is_window else np.maximum(durations, MIN_SIGMA))),
        }
    return limits


def _sizes(cloud: GaussianCloud, options: Splat4dOptions) -> dict[str, int]:
    """Return the entries of every band's codebook."""
    from gsplat_tools.formats.splat4d.writing import default_palette_size

    return {"sh_palette_size": options.sh_palette_size or default_palette_size(len(cloud))}


FORMAT = Format(
    id="splat4d",
    title=".splat4d asset",
    extensions=(".splat4d",),
    spec="docs/formats/splat4d.md",
    max_sh_degree=3,
    min_splats=1,
    matches=matches,
    inspect=inspect,
    read=read,
    write=write,
    bounds=bounds,
    check=check,
    rules=RULES,
    holds_motion=True,
    fits_sequences=True,
    read_options=Splat4dReadOptions,
    write_options=Splat4dOptions,
    presets={
        "fast": {"sh_palette_size": 1024},
        "balanced": {},
        "best": {"sh_palette_size": 32768, "centroids": "f32"},
        "exact": {"sh_palette_size": 65535, "centroids": "f32"},
    },
    knobs=KNOBS,
    sizes=_sizes,
    model=("unity", "fork-4d"),
)
