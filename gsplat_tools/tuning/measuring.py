"""One scene, many encodings: bytes, seconds, memory, and how far the pictures are from those of the source.

The source is drawn once per rendering model; every candidate is written by `save` itself, read back and drawn from the
same cameras, so that a point is what a user of those settings would get.
"""

from __future__ import annotations

import ctypes
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import AttributeTally
from gsplat_tools.errors import CapabilityError, GsplatWarning
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import open_scene
from gsplat_tools.formats.preparing import Prepared
from gsplat_tools.formats.registry import find_format
from gsplat_tools.formats.saving import DEFAULT_PRESET, save
from gsplat_tools.sequence import GaussianSequence

if TYPE_CHECKING:
    from gsplat_tools.reference.camera import Camera

RENDERED_FRAMES = 3
"""Frames of a sequence that are drawn: the first, the middle and the last."""

Model = tuple[str, str | None]
Picture = NDArray[np.floating[Any]]
See = Callable[[Picture, Picture], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One way to encode: a format, a preset, and options above it."""

    format: str
    preset: str = DEFAULT_PRESET
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name for people, such as `sog4d best sh0_entries=64`."""
        return " ".join([self.format, self.preset, *(f"{name}={value}" for name, value in self.options.items())])


@dataclass(frozen=True, slots=True, kw_only=True)
class Likeness:
    """How near the pictures of a candidate are to those of the source.

    Parameters
    ----------
    psnr_min, psnr_mean
        dB over views and frames; None where every picture is identical.
    ssim_mean, max_abs
        Mean SSIM, and the largest difference of a channel, 0..1.
    worst_view
        Index into the views of all drawn frames (frame by frame) with the lowest PSNR.
    """

    psnr_min: float | None
    psnr_mean: float | None
    ssim_mean: float | None
    max_abs: float
    worst_view: int

    @property
    def level(self) -> float:
        """`psnr_min` as a number that can be compared: infinity for identical pictures."""
        return float("inf") if self.psnr_min is None else self.psnr_min


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """What one setting gave.

    Parameters
    ----------
    setting
        What was measured.
    bytes, splats, frames, sh_degree
        Of the written file.
    encode_seconds, decode_seconds
        Median over the repeats, of preparing and encoding, and of reading to arrays.
    peak_memory
        Largest resident memory while encoding above what was resident before, bytes; None where the system does not tell.
    likeness
        Of the pictures; None where nothing was drawn.
    attributes
        Errors per attribute against what was given to the writer.
    options
        Every write option as it was used.
    warnings
        Codes of the warnings that were given.
    """

    setting: Setting
    bytes: int
    splats: int
    frames: int
    sh_degree: int
    encode_seconds: float
    decode_seconds: float
    peak_memory: int | None
    likeness: Likeness | None
    attributes: Mapping[str, Mapping[str, float | int | None]]
    options: Mapping[str, Any]
    warnings: Sequence[str]

    @property
    def bytes_per_splat(self) -> float:
        """Bytes of a splat in a frame."""
        return self.bytes / max(self.splats * self.frames, 1)


class Workbench:
    """A scene on which settings are tried.

    Parameters
    ----------
    scene
        Valid splats (as `load` returns them), or a sequence.
    views, size
        Automatic views, and their width and height in px.
    model
        Rendering model for every format; by default the one that stands for each.
    """

    def __init__(
        self,
        scene: GaussianCloud | GaussianSequence,
        *,
        views: int = 4,
        size: tuple[int, int] = (480, 270),
        model: Model | None = None,
    ) -> None:
        self.scene = scene
        self._views, self._size, self._model = views, size, model
        self._references: dict[tuple[Model, str], tuple[list[Camera], list[Picture]]] = {}

    def model_of(self, record: Format) -> Model:
        """Return the rendering model that candidates of a format are drawn by."""
        return self._model or record.model

    def measure(self, setting: Setting, *, repeats: int = 1, draw: bool = True, see: See | None = None) -> Point:
        """Write, read back and draw the scene with a setting.

        Parameters
        ----------
        setting
            Format, preset and options.
        repeats
            Encodings and decodings to take the median time of; the first is warm only if kernels were used before.
        draw
            Whether pictures are compared.
        see
            Called with the worst view of the source and of the candidate.

        Raises
        ------
        GsplatError
            The format cannot hold the scene with these settings.
        """
        record = find_format(setting.format)
        if record.write is None or record.read is None:
            raise CapabilityError(f"{record.title} cannot be written and read back")
        tally, given = AttributeTally(), list[Prepared]()

        def remember(_stream: BinaryIO, prepared: Prepared, _record: Format) -> None:
            given[:] = [prepared]

        encode, decode = list[float](), list[float]()
        peak: int | None = None
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            path = Path(folder) / f"candidate{record.extensions[0]}"
            for _ in range(repeats):
                resident = _reset_peak()
                report = save(
                    self.scene, path, to=record.id, overwrite=True, preset=setting.preset, check=remember, **setting.options
                )
                highest = _status("VmHWM")
                if resident is not None and highest is not None:
                    peak = max(peak or 0, highest - resident)
                encode.append(report.seconds["read"] + report.seconds["encode"])
            for _ in range(repeats):
                start = time.perf_counter()
                with open_scene(path, in_chunks=False, as_format=record.id) as decoded:
                    frames = [cloud_of(decoded, frame_id) for frame_id in drawn_frames(decoded)]
                    seconds = time.perf_counter() - start
                    if isinstance(decoded, GaussianSequence):  # all frames, from the few that were decoded
                        seconds *= len(decoded) / len(frames)
                decode.append(seconds)
        prepared = given[0].scene
        written = [cloud_of(prepared, frame_id) for frame_id in drawn_frames(prepared)]
        for before, after in zip(written, frames, strict=True):
            tally.add(before, after)
        likeness = (
            self.compare(frames, self.model_of(record), written[0].coordinate_system, see) if draw and len(frames[0]) else None
        )
        return Point(
            setting=setting,
            bytes=report.bytes,
            splats=report.splats,
            frames=report.frames,
            sh_degree=report.sh_degree,
            encode_seconds=float(np.median(encode)),
            decode_seconds=float(np.median(decode)),
            peak_memory=peak,
            likeness=likeness,
            attributes=tally.to_json(),
            options=report.options,
            warnings=sorted({each.message.code for each in caught if isinstance(each.message, GsplatWarning)}),
        )

    def compare(
        self, frames: Sequence[GaussianCloud], model: Model, system: str | None = None, see: See | None = None
    ) -> Likeness:
        """Draw frames (one cloud for a still scene) and compare them with the source's.

        Parameters
        ----------
        frames
            What stands for the drawn frames of the scene.
        model
            Rendering model and variant.
        system
            Axes that the frames are in; by default the scene's. "unknown" says that they were left as they were.
        see
            Called with the worst view of the source and of the candidate.
        """
        from gsplat_tools.reference import image_metrics

        cameras, references = self._reference(model, system)
        images = self._draw(frames, cameras, model)
        metrics = [image_metrics.compare_images(*pair) for pair in zip(references, images, strict=True)]
        levels = [np.inf if each.psnr is None else each.psnr for each in metrics]
        finite = [level for level in levels if np.isfinite(level)]
        similarities = [each.ssim for each in metrics if each.ssim is not None]
        worst = int(np.argmin(levels))
        if see is not None:
            see(references[worst], images[worst])
        return Likeness(
            psnr_min=min(finite) if finite else None,
            psnr_mean=float(np.mean(finite)) if finite else None,
            ssim_mean=float(np.mean(similarities)) if similarities else None,
            max_abs=max(each.max_abs for each in metrics),
            worst_view=worst,
        )

    def squared_errors(self, frames: Sequence[GaussianCloud], model: Model, system: str | None = None) -> list[float]:
        """Return the mean squared error of every drawn view, of colors clamped to [0, 1]; arguments as in `compare`."""
        cameras, references = self._reference(model, system)
        images = self._draw(frames, cameras, model)
        return [
            float(np.square(np.clip(a, 0, 1).astype(np.float64) - np.clip(b, 0, 1)).mean())
            for a, b in zip(references, images, strict=True)
        ]

    def shows_anything(self, model: Model) -> bool:
        """Whether any picture of the source is not black."""
        return any(picture.any() for picture in self._reference(model, None)[1])

    def source_frames(self, system: str | None = None) -> list[GaussianCloud]:
        """Return the frames of the source that are drawn, one for a still scene, in the axes of a candidate."""
        from gsplat_tools.ops.coordinates import convert_coordinates

        frames = [cloud_of(self.scene, frame_id) for frame_id in drawn_frames(self.scene)]
        if system in (None, "unknown", frames[0].coordinate_system):
            return frames
        # A format that is always in one system takes unknown axes as RUB, as `prepare` does.
        source = "RUB" if frames[0].coordinate_system == "unknown" else None
        return [convert_coordinates(cloud, system, source) for cloud in frames]

    def _reference(self, model: Model, system: str | None) -> tuple[list[Camera], list[Picture]]:
        """Return cameras and pictures of the source in the axes of a candidate, drawn once."""
        from gsplat_tools.reference.auto_cameras import auto_cameras

        frames = self.source_frames(system)
        key = (model, frames[0].coordinate_system)
        if key not in self._references:
            cameras = auto_cameras(frames[0], views=self._views, size=self._size)
            self._references[key] = cameras, self._draw(frames, cameras, model)
        return self._references[key]

    @staticmethod
    def _draw(frames: Sequence[GaussianCloud], cameras: Sequence[Camera], model: Model) -> list[Picture]:
        """Draw every frame from every camera."""
        from gsplat_tools.reference.rasterizer import render

        name, variant = model
        return [render(cloud, camera, model=name, variant=variant).image for cloud in frames for camera in cameras]


def drawn_frames(scene: Scene) -> list[int]:
    """Return the frames that are drawn: 0 for a still scene."""
    if not isinstance(scene, GaussianSequence):
        return [0]
    return sorted({round(each) for each in np.linspace(0, len(scene) - 1, RENDERED_FRAMES)})


def cloud_of(scene: Scene, frame_id: int) -> GaussianCloud:
    """Return a frame, or the still scene, in memory."""
    if isinstance(scene, GaussianSequence):
        return scene.frame(frame_id)
    return scene if isinstance(scene, GaussianCloud) else scene.read()


def _status(name: str) -> int | None:
    """Return a size from the kernel's account of this process, bytes; None where there is none."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith(f"{name}:")), None)


def _reset_peak() -> int | None:
    """Start counting peak memory anew and return what is resident now, bytes; None where the system cannot."""
    try:
        ctypes.CDLL(None).malloc_trim(0)  # memory that is kept for reuse would hide what the next encoding needs
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except (OSError, AttributeError):
        return None
    return _status("VmRSS")
