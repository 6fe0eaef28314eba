"""Visionary's precisions: one cloud through f32, f16 and int8 with its errors, and ranges of int8 chosen by rendering."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, BinaryIO, Literal

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.visionary_buffers import MAX_SH_DEGREE
from gsplat_tools.comparison import AttributeTally, compare_rendered, sample
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import drop_or_refuse
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.ops.harmonics import with_sh_degree
from gsplat_tools.ops.ordering import order_splats
from gsplat_tools.sequence import GaussianSequence

Precision = Literal["f32", "f16", "i8"]
Clip = float | Literal["auto"]

CLIPS: tuple[Clip, ...] = ("auto", 0.0, 1e-5, 1e-4, 1e-3, 1e-2)
"""Ranges that `choose_clip` tries: the least weighted error of each channel, and shares of values left out at either end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrecisionStep:
    """One change of precision.

    Parameters
    ----------
    precision
        What was changed to.
    cloud
        The splats after it.
    bytes_per_splat
        Size of the buffers over the number of splats.
    attributes
        max, mean, rms, bound and exceeded of every attribute, against the cloud before this step.
    exceeded
        One phrase for every attribute that leaves its bound; empty unless something is wrong.
    warnings
        What was lost, in words.
    """

    precision: Precision
    cloud: GaussianCloud
    bytes_per_splat: float
    attributes: dict[str, dict[str, float | int | None]]
    exceeded: list[str]
    warnings: list[str]


def change_precision(cloud: GaussianCloud, precisions: Sequence[Precision], **options: Any) -> list[PrecisionStep]:
    """Store a cloud in one precision after the other, each from what the one before gave back.

    Parameters
    ----------
    cloud
        N valid splats, at least one; SH above degree 3 are left out.
    precisions
        Such as ("f32", "f16", "i8", "f32").
    **options
        Write options, each for the formats that have it.

    Returns
    -------
    list of PrecisionStep
        One a precision, each with its errors against its own derived bounds.

    Raises
    ------
    GsplatError
        The cloud cannot be stored, see `save`.
    """
    cloud = with_sh_degree(cloud, min(cloud.sh_degree, MAX_SH_DEGREE))
    steps = []
    for precision in precisions:
        record = FORMATS[f"visionary-{precision}"]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", GsplatWarning)
            stored, stream, size = _stored(cloud, record, options)
        tally = AttributeTally()
        assert record.bounds is not None
        tally.add(cloud, stored, record.bounds(cloud, stream, 0))
        steps.append(
            PrecisionStep(
                precision=precision,
                cloud=stored,
                bytes_per_splat=size / max(len(cloud), 1),
                attributes=tally.to_json(),
                exceeded=tally.exceeded(),
                warnings=[str(warning.message) for warning in caught],
            )
        )
        cloud = stored
    return steps


@dataclass(frozen=True, slots=True)
class ClipChoice:
    """Ranges of int8 channels that render best.

    Parameters
    ----------
    clip
        The best of the candidates, for `--clip`.
    psnr
        Worst view of every candidate, dB; None where the pictures are identical.
    """

    clip: Clip
    psnr: dict[Clip, float | None]


def choose_clip(
    cloud: GaussianCloud,
    *,
    candidates: Sequence[Clip] = CLIPS,
    views: int = 2,
    size: tuple[int, int] = (640, 360),
    **options: Any,
) -> ClipChoice:
    """Return the ranges of visionary-i8 that render best.

    Parameters
    ----------
    cloud
        N valid splats, at least one; SH above degree 3 are left out.
    candidates
        Ranges to try; of equals the first is taken.
    views, size
        Automatic views and their size, px; the PSNR of the worst view counts.
    **options
        Other write options of visionary-i8.

    Returns
    -------
    ClipChoice
        The best, and the PSNR of all.
    """
    from gsplat_tools.reference.auto_cameras import auto_cameras

    record = FORMATS["visionary-i8"]
    cameras = auto_cameras(cloud, views=views, size=size)
    ordered = order_splats(with_sh_degree(cloud, min(cloud.sh_degree, MAX_SH_DEGREE)), "morton")
    psnr: dict[Clip, float | None] = {}
    for clip in candidates:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GsplatWarning)
            stored, _, _ = _stored(ordered, record, {**options, "clip": clip})
        psnr[clip] = compare_rendered([("", ordered, stored)], cameras, record.model).psnr_min
    best = max(candidates, key=lambda clip: float("inf") if psnr[clip] is None else float(psnr[clip] or 0.0))
    return ClipChoice(best, psnr)


def _stored(cloud: GaussianCloud, record: Format, options: dict[str, Any]) -> tuple[GaussianCloud, BinaryIO, int]:
    """Return a cloud as a format gives it back, the stream that it is in, and its size."""
    known = {option.name for option in fields(record.write_options)}
    assert record.write is not None
    assert record.read is not None
    stream = io.BytesIO()
    record.write(cloud, stream, record.write_options(**{name: value for name, value in options.items() if name in known}))
    size = len(stream.getbuffer())
    stream.seek(0)
    stored = record.read(stream, record.read_options())
    assert isinstance(stored, GaussianCloud)
    return stored, stream, size


def rendered_clip(scene: Scene, options: Mapping[str, Any]) -> Clip:
    """Return the clip that the int8 format writes a scene best with; see `choose_clip`."""
    if isinstance(scene, GaussianSequence):
        return "auto"  # refused by the writer
    cloud = drop_or_refuse(sample(scene), strict=False)
    return choose_clip(cloud, **{name: value for name, value in options.items() if name == "position_bits"}).clip
