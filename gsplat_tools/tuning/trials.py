"""Try options on a scene: bytes of the file, and the errors of pictures in which only some attributes are the file's."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import open_scene
from gsplat_tools.formats.preparing import Prepared, prepare
from gsplat_tools.formats.saving import count_splats, save, split_options
from gsplat_tools.ops.visibility import Viewpoint, use_viewpoint
from gsplat_tools.tuning.measuring import Workbench, cloud_of, drawn_frames

Errors = NDArray[np.float64]
"""(frames x views,) mean square error of each picture against the source's."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What options gave.

    Parameters
    ----------
    bytes, splats
        Of the file.
    errors
        Of the pictures; empty where nothing was drawn.
    """

    bytes: int
    splats: int
    errors: Errors

    @property
    def level(self) -> float:
        """PSNR of the worst picture, dB."""
        return level(self.errors)


def level(errors: Errors) -> float:
    """Return the PSNR of the worst picture, dB; infinity where all are identical."""
    worst = float(errors.max(initial=0.0))
    return float(-10 * np.log10(worst)) if worst > 0 else float("inf")


class Trials:
    """One scene and one format, tried with many options; nothing is measured twice.

    Parameters
    ----------
    bench
        The scene, and how it is drawn.
    record
        The format.
    preset, fixed
        What holds for every trial.
    view
        From where the scene is looked at to tell what hardly shows; by default from where it looks best.
    """

    def __init__(
        self, bench: Workbench, record: Format, preset: str, fixed: Mapping[str, Any], view: Viewpoint | None = None
    ) -> None:
        self.bench, self.record, self.preset, self.fixed, self._view = bench, record, preset, dict(fixed), view
        self._known: dict[tuple[Any, ...], Trial] = {}

    @property
    def count(self) -> int:
        """How many encodings and drawings there were."""
        return len(self._known)

    def encode(
        self,
        options: Mapping[str, Any],
        attributes: Sequence[str] | None = None,
        *,
        draw: bool = True,
        limit: float = np.inf,
    ) -> Trial:
        """Write the scene, read it back and draw it.

        Parameters
        ----------
        options
            Above those that are fixed.
        attributes
            Arrays that are taken from the file, the others being those that were given to the writer; by default all.
        draw
            Whether pictures are made.
        limit
            Bytes of a file above which no pictures are made.

        Raises
        ------
        GsplatError
            The format cannot hold the scene with these options.
        """
        key = (*sorted(options.items()), ("attributes", attributes and tuple(attributes)))
        known = self._known.get((*key, True), None if draw else self._known.get((*key, False)))
        if known is None:
            undrawn = self._known.get((*key, False))
            if undrawn is not None and undrawn.bytes > limit:
                return undrawn
            known = self._encode({**self.fixed, **options}, attributes, limit if draw else -1)
            self._known[*key, bool(known.errors.size)] = known
        return known

    def prepare(self, options: Mapping[str, Any]) -> Trial:
        """Draw what would be given to the writer; no bytes are known."""
        key = (*sorted(options.items()), ("prepared", True))
        if key not in self._known:
            choices, _ = split_options(self.record, self.preset, {**self.fixed, **options})
            with warnings.catch_warnings(), use_viewpoint(self._view):
                warnings.simplefilter("ignore")
                prepared = prepare(self.bench.scene, self.record, choices).scene
            frames = _frames(prepared)
            self._known[key] = Trial(0, count_splats(prepared), self._draw(frames, frames[0].coordinate_system))
        return self._known[key]

    def _encode(self, options: dict[str, Any], attributes: Sequence[str] | None, limit: float) -> Trial:
        given = list[Scene]()

        def remember(_stream: BinaryIO, prepared: Prepared, _record: Format) -> None:
            given.append(prepared.scene)

        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), use_viewpoint(self._view):
            warnings.simplefilter("ignore")
            path = Path(folder) / f"trial{self.record.extensions[0]}"
            report = save(self.bench.scene, path, to=self.record.id, preset=self.preset, check=remember, **options)
            if report.bytes > limit:
                return Trial(report.bytes, report.splats, np.zeros(0))
            with open_scene(path, in_chunks=False, as_format=self.record.id) as decoded:
                read = _frames(decoded)
        written = _frames(given[0])
        if attributes is not None:
            read = [
                before.replace(**{name: values for name, values in after.arrays().items() if name in attributes})
                for before, after in zip(written, read, strict=True)
            ]
        return Trial(report.bytes, report.splats, self._draw(read, written[0].coordinate_system))

    def _draw(self, frames: list[GaussianCloud], system: str) -> Errors:
        """Return the errors of pictures of frames that are in the axes that the format asked for."""
        return np.array(self.bench.squared_errors(frames, self.bench.model_of(self.record), system))


def _frames(scene: Scene) -> list[GaussianCloud]:
    """Return the frames of a scene that are drawn."""
    return [cloud_of(scene, frame_id) for frame_id in drawn_frames(scene)]
