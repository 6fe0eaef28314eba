"""What a conversion will cost and keep, estimated from a part of the scene before the work is done.

Bytes and seconds of two samples give a straight line in the number of splats; codebooks of a sample have its share of the
entries that those of the whole scene will have. For the pictures, the splats of a sample
are put back into the whole scene as they come out of the target: errors of different splats are nearly independent, so
the squared error of n of N splats is n / N of the whole. The splats that show most are all in the sample and count once,
because a few large ones decide what is seen.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.loading import open_scene
from gsplat_tools.formats.preparing import Prepared
from gsplat_tools.formats.registry import find_format
from gsplat_tools.formats.saving import SaveReport, count_splats, save, split_options
from gsplat_tools.ops.importance import importance
from gsplat_tools.ops.sampling import spread_runs
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.measuring import Setting, Workbench, cloud_of

SAMPLE_SHARE = 8
"""One of so many splats is in the sample."""
SMALLEST_SAMPLE, LARGEST_SAMPLE = 16384, 65536
SAMPLED_FRAMES = 4
TOP_SHARE = 0.5
"""Splats that show most, as a share of the sample's size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """An estimate of one conversion.

    Parameters
    ----------
    bytes
        Of the target.
    encode_seconds
        Of preparing and encoding, without reading the source and without validation.
    psnr_min, psnr_mean
        Against the source, dB; None where the pictures would be identical.
    splats, frames
        Of the scene.
    sampled_splats, sampled_frames
        What the estimate is from; everything for a small scene, which is then no estimate.
    """

    bytes: int
    encode_seconds: float
    psnr_min: float | None
    psnr_mean: float | None
    splats: int
    frames: int
    sampled_splats: int
    sampled_frames: int

    @property
    def is_exact(self) -> bool:
        """Whether everything was encoded."""
        return (self.sampled_splats, self.sampled_frames) == (self.splats, self.frames)

    def to_json(self) -> dict[str, Any]:
        """Return the names of `gsplat-convert --dry-run --json`."""
        return {**{name: getattr(self, name) for name in self.__slots__}, "exact": self.is_exact}


def predict(
    scene: GaussianCloud | GaussianSequence, setting: Setting, *, views: int = 2, size: tuple[int, int] = (320, 180)
) -> Prediction:
    """Estimate bytes, seconds and PSNR of a conversion.

    Parameters
    ----------
    scene
        Valid splats, or a sequence, of which a few frames are looked at.
    setting
        What will be written.
    views, size
        Views that will be compared; 0 compares nothing.

    Returns
    -------
    Prediction
        For scenes of up to 32,768 splats and four frames, what was measured.

    Raises
    ------
    GsplatError
        The format cannot hold the scene with these settings.
    """
    splats, frames = count_splats(scene), len(scene) if isinstance(scene, GaussianSequence) else 1
    sampled = int(np.clip(splats // SAMPLE_SHARE, SMALLEST_SAMPLE, LARGEST_SAMPLE))
    if 2 * sampled >= splats and frames <= SAMPLED_FRAMES:
        return _measured(scene, setting, views, size)
    first = cloud_of(scene, 0)
    small, large = (spread_runs(first, count) for count in (sampled // 2, sampled))
    taken = min(frames, SAMPLED_FRAMES)
    sizes = _sizes(first, setting)

    def costs(number: int) -> list[NDArray[np.float64]]:
        """Return what both samples take with so many frames."""
        return [
            _encode(_part(scene, indices, number), _in_proportion(setting, sizes, len(indices) / splats))
            for indices in (small, large)
        ]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        _encode(_part(scene, small, 1), setting)  # compiles
        counts = len(small), len(large)
        few = costs(min(frames, 2))
        total = _line(counts, few, splats)
        if frames > 2:
            more = costs(taken)
            total += _line(counts, [(m - f) / (taken - 2) for m, f in zip(more, few, strict=True)], splats) * (frames - 2)
        levels = _levels(cloud_of(scene, frames // 2), large, setting, sizes, views, size) if views else []
    return Prediction(
        bytes=round(total[0]),
        encode_seconds=float(total[1]),
        psnr_min=min(levels) if levels else None,
        psnr_mean=float(np.mean(levels)) if levels else None,
        splats=splats,
        frames=frames,
        sampled_splats=len(large),
        sampled_frames=taken,
    )


def _sizes(cloud: GaussianCloud, setting: Setting) -> Mapping[str, int]:
    """Return the entries of codebooks that the whole scene will be written with, by option."""
    record = find_format(setting.format)
    if record.sizes is None:
        return {}
    _, options = split_options(record, setting.preset, dict(setting.options))
    return record.sizes(cloud, options)


def _in_proportion(setting: Setting, sizes: Mapping[str, int], share: float) -> Setting:
    """Return the setting for a part of the scene, with its share of the entries."""
    own = {name: max(1, round(size * share)) for name, size in sizes.items()}
    return replace(setting, options={**setting.options, **own})


def _line(sizes: tuple[int, int], costs: Sequence[NDArray[np.float64]], splats: int) -> NDArray[np.float64]:
    """Return what a straight line through the costs of two sizes says of a third; nothing gets cheaper by growing."""
    slope = np.maximum((costs[1] - costs[0]) / max(sizes[1] - sizes[0], 1), 0)
    return np.asarray(np.maximum(costs[1], 0) + slope * (splats - sizes[1]))


def _measured(scene: GaussianCloud | GaussianSequence, setting: Setting, views: int, size: tuple[int, int]) -> Prediction:
    """Return what a small scene gives: all of it is encoded."""
    bench = Workbench(scene, views=max(views, 1), size=size)
    bench.measure(setting, draw=False)  # compiles
    point = bench.measure(setting, draw=views > 0)
    return Prediction(
        bytes=point.bytes,
        encode_seconds=point.encode_seconds,
        psnr_min=None if point.likeness is None else point.likeness.psnr_min,
        psnr_mean=None if point.likeness is None else point.likeness.psnr_mean,
        splats=count_splats(scene),
        frames=point.frames,
        sampled_splats=count_splats(scene),
        sampled_frames=point.frames,
    )


def _part(scene: GaussianCloud | GaussianSequence, indices: NDArray[np.intp], frames: int) -> GaussianCloud | GaussianSequence:
    """Return some splats of the first frames."""
    if isinstance(scene, GaussianCloud):
        return scene.take(indices)
    return GaussianSequence(
        lambda frame_id: scene.frame(frame_id).take(indices),
        num_splats=len(indices),
        sh_degree=scene.sh_degree,
        num_frames=frames,
    )


def _encode(scene: GaussianCloud | GaussianSequence, setting: Setting) -> NDArray[np.float64]:
    """Return bytes and seconds of an encoding that is thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        report = _save(scene, Path(folder), setting, **setting.options)
    return np.array([report.bytes, report.seconds["read"] + report.seconds["encode"]])


def _save(scene: Any, folder: Path, setting: Setting, **options: Any) -> SaveReport:
    """Write a scene into a folder."""
    record = find_format(setting.format)
    return save(scene, folder / f"sample{record.extensions[0]}", to=record.id, preset=setting.preset, **options)


def _levels(
    cloud: GaussianCloud,
    runs: NDArray[np.intp],
    setting: Setting,
    sizes: Mapping[str, int],
    views: int,
    size: tuple[int, int],
) -> list[float]:
    """Return the PSNR to be expected in every view that would differ."""
    weights = importance(cloud)
    top = np.argpartition(-weights, int(TOP_SHARE * len(runs)))[: int(TOP_SHARE * len(runs))]
    rest = np.setdiff1d(runs, top)
    chosen = np.union1d(top, rest)
    decoded, system = _decoded(cloud.take(chosen), _in_proportion(setting, sizes, len(chosen) / len(cloud)))
    bench = Workbench(cloud, views=views, size=size)
    reference = bench.source_frames(system)[0]
    if decoded is None or len(decoded) != len(chosen):  # splats were left out: nothing to put back one by one
        return []
    squared = np.zeros(views)
    for indices, factor in ((top, 1.0), (rest, (len(cloud) - len(top)) / max(len(rest), 1))):
        mixed = _put_back(reference, indices, decoded.take(np.searchsorted(chosen, indices)))
        squared += factor * np.array(bench.squared_errors([mixed], bench.model_of(find_format(setting.format)), system))
    return [float(-10 * np.log10(error)) for error in squared if error > 0]


def _decoded(cloud: GaussianCloud, setting: Setting) -> tuple[GaussianCloud | None, str]:
    """Return splats as they come out of the target, in their order, and the axes that they are in."""
    systems: list[str] = []

    def remember(_stream: BinaryIO, prepared: Prepared, _record: Format) -> None:
        systems.append(cloud_of(prepared.scene, 0).coordinate_system)

    options = {**setting.options, "order": "none", "prune_opacity": 0.0, "prune_faint": 0.0, "outliers": "keep"}
    with tempfile.TemporaryDirectory() as folder:
        report = _save(cloud, Path(folder), setting, check=remember, **options)
        with open_scene(report.path, in_chunks=False, as_format=setting.format) as scene:
            return cloud_of(scene, 0), systems[0]


def _put_back(reference: GaussianCloud, indices: NDArray[np.intp], decoded: GaussianCloud) -> GaussianCloud:
    """Return the scene with some splats as they were decoded."""
    from gsplat_tools.ops.harmonics import with_sh_degree
    from gsplat_tools.ops.recentering import recenter

    decoded = recenter(with_sh_degree(decoded, reference.sh_degree), reference.origin)
    arrays: dict[str, Any] = {}
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh0", "shN"):
        arrays[name] = getattr(reference, name).copy()
        arrays[name][indices] = getattr(decoded, name)
    return reference.replace(**arrays)
