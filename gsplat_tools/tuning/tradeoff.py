"""Formats times settings on one scene: what each costs, what it keeps, and which are worth having."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, GsplatError
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.saving import DEFAULT_PRESET, split_options
from gsplat_tools.ops.sampling import crop
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.measuring import Model, Picture, Point, Setting, Workbench

PRESETS = ("fast", "balanced", "best")
_WARM_UP_SPLATS = 256
"""Enough to compile every kernel of a format."""
_VALUES_OF_A_KNOB = 6


@dataclass(slots=True)
class Tradeoff:
    """Every point that was measured on a scene.

    Parameters
    ----------
    splats, frames, sh_degree
        Of what was measured.
    cropped_from
        Splats of the whole scene where only a part was measured, else None.
    points
        One a setting, in the order of formats and presets.
    pareto
        Whether no other point has fewer bytes at the same `psnr_min` or more.
    worst
        Pictures of the source and the candidate in the worst view of each point.
    skipped
        Settings that could not be measured, with the reason.
    """

    splats: int
    frames: int
    sh_degree: int
    cropped_from: int | None
    points: list[Point] = field(default_factory=list)
    pareto: list[bool] = field(default_factory=list)
    worst: list[tuple[Picture, Picture] | None] = field(default_factory=list)
    skipped: list[tuple[Setting, str]] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the names of `gsplat-inspect tradeoff --json`."""
        return {
            "splats": self.splats,
            "frames": self.frames,
            "sh_degree": self.sh_degree,
            "cropped_from": self.cropped_from,
            "points": [_row(point, mark) for point, mark in zip(self.points, self.pareto, strict=True)],
            "skipped": [{"format": s.format, "settings": _settings(s), "reason": reason} for s, reason in self.skipped],
        }

    def to_csv(self) -> str:
        """Return the points as a table with one line of names."""
        rows = []
        for row in self.to_json()["points"]:
            errors = {f"rms_{name}": values["rms"] for name, values in row.pop("attributes").items()}
            row["settings"] = " ".join(f"{name}={value}" for name, value in row["settings"].items())
            row["warnings"] = " ".join(row["warnings"])
            rows.append({**row, **errors})
        names = list(dict.fromkeys(name for row in rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()


def _settings(setting: Setting) -> dict[str, Any]:
    """Return what tells settings of one format apart."""
    return {"preset": setting.preset, **setting.options}


def _row(point: Point, is_pareto: bool) -> dict[str, Any]:
    """Return a point with the names of the JSON."""
    likeness = point.likeness
    names = ("psnr_min", "psnr_mean", "ssim_mean", "max_abs", "worst_view")
    return {
        "format": point.setting.format,
        "settings": _settings(point.setting),
        "bytes": point.bytes,
        "bytes_per_splat": point.bytes_per_splat,
        "sh_degree": point.sh_degree,
        "encode_seconds": point.encode_seconds,
        "decode_seconds": point.decode_seconds,
        "peak_memory": point.peak_memory,
        **{name: None if likeness is None else getattr(likeness, name) for name in names},
        "identical": likeness is not None and likeness.psnr_min is None,
        "pareto": is_pareto,
        "warnings": list(point.warnings),
        "attributes": {name: dict(errors) for name, errors in point.attributes.items()},
    }


def measure_tradeoff(
    scene: GaussianCloud | GaussianSequence,
    *,
    formats: Sequence[str] = (),
    settings: Sequence[Setting] = (),
    knobs: bool = False,
    crop_to: int | None = None,
    repeats: int = 3,
    views: int = 4,
    size: tuple[int, int] = (480, 270),
    model: Model | None = None,
) -> Tradeoff:
    """Encode a scene in many ways and measure each.

    Parameters
    ----------
    scene
        Valid splats, or a sequence.
    formats
        Ids of the formats to try; by default every one that can be written and read and that fits the scene.
    settings
        Further settings to measure.
    knobs
        Whether every knob of each format is also turned by itself, from the balanced preset.
    crop_to
        Measure only so many splats around the middle of a still scene.
    repeats
        Encodings and decodings to take the median time of, after a first one on a few splats that compiles.
    views, size, model
        As `Workbench` has them.

    Returns
    -------
    Tradeoff
        Points in the order of the settings; pictures of each one's worst view.

    Raises
    ------
    CapabilityError
        A part of a sequence is asked for.
    """
    whole = None
    if crop_to is not None:
        if isinstance(scene, GaussianSequence):
            raise CapabilityError("a crop is of a still scene; choose a frame of the sequence")
        whole, scene = len(scene), crop(scene, crop_to)
        whole = whole if whole > len(scene) else None
    is_sequence = isinstance(scene, GaussianSequence)
    records = [FORMATS[name] for name in formats or FORMATS]
    if not formats:
        records = [each for each in records if each.write and each.read and (not is_sequence or each.holds_sequences)]
    wanted = [setting for record in records for setting in settings_of(record, scene.sh_degree, knobs=knobs, moves=is_sequence)]
    wanted += settings
    bench = Workbench(scene, views=views, size=size, model=model)
    small = Workbench(scene if isinstance(scene, GaussianSequence) else scene.take(slice(0, _WARM_UP_SPLATS)), views=1)
    result = Tradeoff(
        splats=scene.num_splats if isinstance(scene, GaussianSequence) else len(scene),
        frames=len(scene) if isinstance(scene, GaussianSequence) else 1,
        sh_degree=scene.sh_degree,
        cropped_from=whole,
    )
    with stage("measuring", len(wanted), "settings") as progress:
        for setting in wanted:
            seen: list[tuple[Picture, Picture]] = []
            try:
                if not is_sequence:
                    with suppress(GsplatError):  # a few splats may not do where the scene does
                        small.measure(setting, draw=False)
                point = bench.measure(setting, repeats=repeats, see=_keep_in(seen))
            except GsplatError as error:
                error.path = None  # a temporary file, of which the name says nothing
                result.skipped.append((setting, str(error)))
            else:
                result.points.append(point)
                result.worst.append(seen[-1] if seen else None)
            progress.advance(1)
    result.pareto = pareto_front([(p.bytes, _level(p)) for p in result.points])
    return result


def _keep_in(seen: list[tuple[Picture, Picture]]) -> Callable[[Picture, Picture], None]:
    """Return a function that keeps the pictures it is shown."""

    def see(source: Picture, candidate: Picture) -> None:
        seen.append((source, candidate))

    return see


def _level(point: Point) -> float:
    """Return `psnr_min`; infinity for identical pictures, minus infinity where nothing was drawn."""
    return -np.inf if point.likeness is None else point.likeness.level


def pareto_front(points: Sequence[tuple[int, float]]) -> list[bool]:
    """Return for every (bytes, PSNR) whether nothing is as small and as good, and better in one of both."""
    return [not any((b <= size and q >= level) and (b < size or q > level) for b, q in points) for size, level in points]


def _spread(values: Sequence[Any]) -> list[Any]:
    """Return a few values of a knob, its ends among them."""
    places = np.linspace(0, len(values) - 1, min(len(values), _VALUES_OF_A_KNOB))
    return [values[round(place)] for place in places]


def settings_of(record: Format, sh_degree: int, *, knobs: bool = False, moves: bool = True) -> list[Setting]:
    """Return the settings of a format that differ: its presets, fewer SH bands, and its knobs one at a time.

    Parameters
    ----------
    record
        A format that can be written.
    sh_degree
        Highest band of the scene.
    knobs
        Whether to turn every knob by itself, those with many values to six of them from end to end.
    moves
        Whether the scene is a sequence: some knobs say nothing about a still scene.
    """
    wanted = [Setting(format=record.id, preset=preset) for preset in PRESETS if preset in (record.presets or {DEFAULT_PRESET})]
    if not record.lossless:
        wanted += [
            Setting(format=record.id, options={"sh_degree": degree})
            for degree in reversed(range(min(sh_degree, record.max_sh_degree)))
        ]
    if knobs:
        wanted += [
            Setting(format=record.id, options={name: value})
            for name, knob in record.knobs.items()
            if moves or not knob.sequences_only
            for value in _spread(knob.values)
        ]
    chosen: dict[tuple[Any, ...], Setting] = {}
    for setting in wanted:
        chosen.setdefault(split_options(record, setting.preset, dict(setting.options)), setting)
    return list(chosen.values())
