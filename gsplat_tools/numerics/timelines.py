"""Sequences whose times repeat, crowd together or leave their range, in formats that hold sequences."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatError
from gsplat_tools.formats.base import Bounds, Format
from gsplat_tools.numerics import rotations, sizes
from gsplat_tools.numerics.conditions import ordinary
from gsplat_tools.numerics.measuring import Row, compare_clouds, judge, transfer
from gsplat_tools.sequence import GaussianSequence

SWEEP = "sequence"

_WATCHED = ("means", "scales", sizes.ATTRIBUTE, rotations.ATTRIBUTE, "covariances", "opacities", "sh0", "shN")
_CASES: dict[str, tuple[float, ...] | None] = {
    "evenly spaced": None,
    "times repeated": (0.0, 0.5, 0.5, 0.5, 1.0),
    "times clustered": (0.0, 0.5, 0.5 + 1e-12, 0.5 + 1e-9, 1.0),
    "times all equal": (0.25,) * 5,
    "times out of range": (-0.5, 0.0, 0.5, 1.0, 1.5),
}
_FRAMES = 5


def moving_frames(times: tuple[float, ...] | None) -> GaussianSequence:
    """Return five frames in which splats drift, turn, swell and fade.

    Raises
    ------
    CloudError
        The times leave [0, 1].
    """
    base = ordinary(1)
    rng = np.random.default_rng(7)
    drift, turn = rng.normal(0, 0.2, base.means.shape), rng.normal(0, 0.2, base.quats.shape)

    def frame(index: int) -> GaussianCloud:
        return base.replace(
            means=base.means + index * drift,
            quats=base.quats + index * turn,
            log_scales=base.log_scales + 0.1 * index,
            opacity_logits=base.opacity_logits - 0.3 * index,
        )

    return GaussianSequence(
        frame, num_splats=len(base), sh_degree=base.sh_degree, frame_times=times, num_frames=None if times else _FRAMES
    )


def sequence_rows(record: Format) -> list[Row]:
    """Return the rows of every case: the times, every frame's values, and the ends beyond which nothing moves."""
    rows: list[Row] = []
    for label, times in _CASES.items():
        facts: dict[str, Any] = {"format": record.id, "condition": f"{SWEEP} {label}", "sweep": SWEEP}
        try:
            done = transfer(moving_frames(times), record)
        except GsplatError as error:
            rows.append(Row(**facts, attribute="frame times", note=f"refused: {error.message}"))
            continue
        assert isinstance(done.prepared, GaussianSequence)
        assert isinstance(done.decoded, GaussianSequence)
        off = np.abs(done.prepared.frame_times - done.decoded.frame_times)
        rows.append(judge("frame times", off, np.zeros(1), **facts))
        errors, limits = _all_frames(done.prepared, done.decoded, record, done.stream)
        rows += [judge(name, errors[name], limits.get(name), **facts) for name in _WATCHED]
        rows.append(_clamped(done.prepared, done.decoded, limits, facts))
    return rows


def _all_frames(
    source: GaussianSequence, decoded: GaussianSequence, record: Format, stream: io.BytesIO
) -> tuple[dict[str, NDArray[np.float64]], Bounds]:
    """Return errors and bounds of every frame, one below the other."""
    errors: dict[str, list[NDArray[np.float64]]] = {}
    limits: dict[str, list[NDArray[Any]]] = {}
    for index in range(len(source)):
        frame = source.frame(index)
        off, bounds = compare_clouds(frame, frame, decoded.frame(index), record, stream, index)
        for name, values in off.items():
            errors.setdefault(name, []).append(values)
            if name in bounds:
                limits.setdefault(name, []).append(np.broadcast_to(bounds[name], values.shape))
    stacked: Bounds = {name: np.concatenate(parts) for name, parts in limits.items()}
    return {name: np.concatenate(parts) for name, parts in errors.items()}, stacked


def _clamped(source: GaussianSequence, decoded: GaussianSequence, limits: Bounds, facts: dict[str, Any]) -> Row:
    """Compare what is shown before the first and after the last frame with those frames."""
    ends = ((-1.0, 0), (source.frame_times[0] - 1e-9, 0), (source.frame_times[-1] + 1e-9, -1), (2.0, -1))
    count = len(source)
    off = [np.abs(source.frame(last % count).means - decoded.at(t).means.astype(np.float64)) for t, last in ends]
    per_frame = np.asarray(limits["means"]).reshape(count, -1, 3)
    return judge(
        "means out of range", np.concatenate(off), np.concatenate([per_frame[last % count] for _, last in ends]), **facts
    )
