"""Find the cheapest encoding that holds a PSNR, or the best one within bytes, by what each knob was measured to do."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import ValidationError
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.knobs import Knob
from gsplat_tools.formats.saving import DEFAULT_PRESET
from gsplat_tools.ops.visibility import viewpoint
from gsplat_tools.progress import report_to, stage
from gsplat_tools.remembering import remembering
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.hunting import LARGE, Budget, Found, Hunt
from gsplat_tools.tuning.measuring import Model, Workbench
from gsplat_tools.tuning.model import RateModel
from gsplat_tools.tuning.trials import Trials

__all__ = ["TARGET_SIZE", "TARGET_VIEWS", "Budget", "Found", "Searcher", "search", "turnable"]

TARGET_VIEWS, TARGET_SIZE = 8, (640, 360)
"""Views that a PSNR target is held at where none are asked for: those of `compare`."""

SEARCH_SPLATS = 1 << 16
"""Scenes half as large again are searched on a ball of so many splats around their middle, and verified whole."""
SEARCH_FRAMES = 3
"""Frames at the start of a sequence that stand for it while searching."""

_SPLATS = {"prune_opacity", "prune_faint"}
"""Options that say which splats are left out: where one is given, the others are not turned."""


def search(
    scene: GaussianCloud | GaussianSequence,
    record: Format,
    budget: Budget,
    *,
    preset: str = DEFAULT_PRESET,
    pinned: Mapping[str, Any] | None = None,
    views: int = TARGET_VIEWS,
    size: tuple[int, int] = TARGET_SIZE,
    model: Model | None = None,
) -> Found:
    """Find the options with the fewest bytes that hold a PSNR, or with the highest PSNR within bytes.

    Parameters
    ----------
    scene
        Valid splats, or a sequence.
    record
        Format to write.
    budget
        What to hold.
    preset, pinned
        What is given: options of the preset below those that are pinned; pinned ones are not turned.
    views, size, model
        Automatic views, their size in px, and the rendering model at which the PSNR holds.

    Returns
    -------
    Found
        Verified on the whole scene with the final views.

    Raises
    ------
    ValidationError
        Nothing holds the budget; the message says how close one gets.
    CapabilityError
        The format cannot hold the scene.

    Notes
    -----
    Every option of a stream is tried by itself, with the pictures of a scene that is the source's but for that stream;
    the streams' errors and bytes add up to a prediction for all combinations, from which the best is taken, encoded
    whole, drawn, and the prediction corrected, view by view, by what came out, until it holds. Pictures are half as wide
    and high while searching.
    """
    keeps_splats = budget.max_bytes_per_splat is not None
    searcher = Searcher(
        scene, record, preset=preset, pinned=pinned, views=views, size=size, model=model, keep_splats=keeps_splats
    )
    return searcher.find(budget)


class Searcher:
    """One scene and one format, searched for one budget after the other; what was measured serves them all.

    Parameters are those of `search`. `keep_splats` says that no splat may be left out for being faint.
    """

    def __init__(
        self,
        scene: GaussianCloud | GaussianSequence,
        record: Format,
        *,
        preset: str = DEFAULT_PRESET,
        pinned: Mapping[str, Any] | None = None,
        views: int = TARGET_VIEWS,
        size: tuple[int, int] = TARGET_SIZE,
        model: Model | None = None,
        keep_splats: bool = False,
    ) -> None:
        self._scene, self._keeps_splats = scene, keep_splats
        pinned = dict(pinned or {})
        if keep_splats:
            pinned.setdefault("outliers", "keep")
        if keep_splats or pinned.keys() & _SPLATS:
            pinned.setdefault("prune_faint", 0.0)  # which a visual tolerance would set
        self.whole = Trials(Workbench(scene, views=views, size=size, model=model), record, preset, pinned)
        half = max(size[0] // 2, 1), max(size[1] // 2, 1)
        part = _part(scene)
        view = viewpoint(scene) if isinstance(scene, GaussianCloud) and part is not scene else None
        self._part = Trials(Workbench(part, views=views, size=half, model=model), record, preset, pinned, view)
        self._rates: dict[bool, RateModel] = {}
        self.is_large = _count(scene) > LARGE

    def find(self, budget: Budget) -> Found:
        """Return the best encoding within a budget; as `search`, with the same errors."""
        start = time.perf_counter()
        keeps_splats = self._keeps_splats or budget.max_bytes_per_splat is not None
        with remembering(), stage("searching", 0, "trials") as progress, report_to(None):
            if keeps_splats not in self._rates:
                knobs = turnable(self._scene, self.whole.record, self.whole.fixed, keep_splats=keeps_splats)
                self._rates[keeps_splats] = RateModel(self._part, knobs)
            hunt = Hunt(self.whole, self._rates[keeps_splats], budget, _count(self._scene))
            try:
                found = hunt.run(progress.advance)
            except ValidationError:
                preset = hunt.preset(None)
                if preset is None:
                    raise
                report = Found(options={}, bytes=0, psnr_min=0.0)
            else:
                preset = hunt.preset(found[1])
                report = hunt.report(found)
            if preset is not None:
                options, trial, why = preset
                decision = {"stream": why, "options": options, "bytes": None, "db": None, "next_bytes": None, "next_db": None}
                report = replace(report, options=options, bytes=trial.bytes, psnr_min=trial.level, decisions=[decision])
            return replace(report, trials=self.whole.count, seconds=time.perf_counter() - start)


def turnable(
    scene: GaussianCloud | GaussianSequence, record: Format, pinned: Mapping[str, Any], *, keep_splats: bool = False
) -> dict[str, Knob]:
    """Return the knobs that say something about a scene, their values as far as they do."""
    from gsplat_tools.ops.harmonics import effective_sh_degree

    frames = [scene] if isinstance(scene, GaussianCloud) else (scene.frame(frame_id) for frame_id in range(len(scene)))
    given = dict(pinned)
    if not isinstance(pinned.get("sh_degree"), int):
        given.pop("sh_degree", None)
    degree = min(max(map(effective_sh_degree, frames)), record.max_sh_degree)
    most = max(64, scene.num_splats if isinstance(scene, GaussianSequence) else len(scene))
    if degree == 0:
        given["sh_degree"] = 0
    found: dict[str, Knob] = {}
    for name, knob in record.knobs.items():
        if name in given or (knob.sequences_only and not isinstance(scene, GaussianSequence)):
            continue
        if knob.stream == "splats" and (keep_splats or given.keys() & _SPLATS):
            continue
        if any(each in given and given[each] not in values for each, values in knob.needs.items()):
            continue
        values = knob.values
        if name == "sh_degree":
            values = tuple(value for value in values if value <= degree)
        elif name.endswith("_size"):
            values = tuple(value for value in values if value <= most)
        found[name] = Knob(values=values, stream=knob.stream, graded=knob.graded, needs=knob.needs)
    return found


def _part(scene: GaussianCloud | GaussianSequence) -> GaussianCloud | GaussianSequence:
    """Return what stands for the scene while searching: a ball of a large one, the first frames of a sequence."""
    from gsplat_tools.ops.sampling import crop

    if isinstance(scene, GaussianCloud):
        return crop(scene, SEARCH_SPLATS, keeps_box=True) if len(scene) > 1.5 * SEARCH_SPLATS else scene
    frames = [scene.frame(frame_id) for frame_id in range(min(SEARCH_FRAMES, len(scene)))]
    return GaussianSequence(frames.__getitem__, num_splats=scene.num_splats, sh_degree=scene.sh_degree, num_frames=len(frames))


def _count(scene: GaussianCloud | GaussianSequence) -> int:
    """Return the splats of all frames."""
    return scene.num_splats * len(scene) if isinstance(scene, GaussianSequence) else len(scene)
