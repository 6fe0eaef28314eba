"""Spend only what a scene requires: options that are chosen by measurement, each with its evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatError, ValidationError
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import drop_or_refuse
from gsplat_tools.ops.coordinates import name_axes
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.measuring import Model, Workbench
from gsplat_tools.tuning.search import TARGET_SIZE, TARGET_VIEWS, Budget, Found, Searcher
from gsplat_tools.tuning.trials import Trial, Trials

VISIBLE_PSNR = 20 * float(np.log10(255))
"""48.13 dB: the root mean square error of a picture is one step of 8 bits, below which a screen shows next to nothing."""

_EQUAL_DB = 0.01
"""Less than this is no loss."""

Decision = dict[str, Any]
"""What was decided: "option", "value", "bytes_saved", "db_lost" (None where nothing was measured) and "why"."""


@dataclass(slots=True, kw_only=True)
class Tuned:
    """A scene and the options to write it with.

    Parameters
    ----------
    scene
        What to write; less than was given where nothing is lost by that.
    options
        Above those that were asked for.
    decisions
        What was decided, with its evidence.
    found
        Of the search; None where the preset stays.
    bench
        The source, for the pictures that the target is judged by.
    """

    scene: GaussianCloud | GaussianSequence
    options: dict[str, Any] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    found: Found | None = None
    bench: Workbench


def tune(
    scene: Scene,
    record: Format,
    *,
    preset: str,
    options: Mapping[str, Any],
    budget: Budget | None = None,
    views: int = TARGET_VIEWS,
    size: tuple[int, int] = TARGET_SIZE,
    model: Model | None = None,
) -> Tuned:
    """Choose the options of a conversion by measurement.

    Parameters
    ----------
    scene
        What is to be written; invalid splats are left out of what is measured.
    record
        Format to write.
    preset, options
        What was asked for; options stay as they are.
    budget
        What to hold. By default the worst view of the preset, or `VISIBLE_PSNR` where that is less, at fewer bytes.
    views, size, model
        Views that decide, their size in px, and the rendering model.

    Raises
    ------
    ValidationError
        Nothing holds the budget, or the views show nothing.
    GsplatError
        The format cannot hold the scene.
    """
    given = whole = scene.read() if isinstance(scene, CloudChunks) else scene
    decisions: list[Decision] = []
    if budget is None:
        whole, decisions = without_what_never_changes(whole)
    valid = whole if isinstance(whole, GaussianSequence) else drop_or_refuse(whole, strict=bool(options.get("strict")))
    valid = name_axes(valid, options.get("source_coordinates"))
    keeps_splats = budget is not None and budget.max_bytes_per_splat is not None
    searcher = Searcher(
        valid, record, preset=preset, pinned=options, views=views, size=size, model=model, keep_splats=keeps_splats
    )
    tuned = Tuned(scene=whole, decisions=decisions, bench=searcher.whole.bench)
    if not searcher.whole.bench.shows_anything(searcher.whole.bench.model_of(record)):
        raise ValidationError("the views show nothing of the scene, so that no choice can be judged by them")
    if budget is not None:
        tuned.found = searcher.find(budget)
        tuned.options = {**searcher.whole.fixed, **tuned.found.options}
        tuned.decisions += [_of_search(each, budget) for each in tuned.found.decisions]
        return tuned
    usual = searcher.whole.encode({})
    if decisions:
        _measure_bytes(decisions, Trials(Workbench(given), record, preset, options), usual)
    chosen, alternatives = _alternatives(searcher.whole, valid, usual)
    tuned.decisions += alternatives
    if chosen:
        pinned = {**options, **chosen}
        searcher = Searcher(valid, record, preset=preset, pinned=pinned, views=views, size=size, model=model)
        usual, tuned.options = searcher.whole.encode({}), chosen
    found = searcher.find(Budget(min_psnr=min(usual.level, VISIBLE_PSNR)))
    if found.bytes < usual.bytes:
        tuned.found, tuned.options = found, {**chosen, **found.options}
        tuned.decisions += _against_preset(searcher, found)
    return tuned


def _measure_bytes(decisions: list[Decision], before: Trials, after: Trial) -> None:
    """Enter what leaving out unchanging fields or frames saves in the file; pictures stay what they were."""
    try:
        saved = before.encode({}, draw=False).bytes - after.bytes
    except GsplatError:
        return  # the target cannot hold them
    for each in decisions:
        each["bytes_saved"] = saved


def _alternatives(
    trials: Trials, scene: GaussianCloud | GaussianSequence, usual: Trial
) -> tuple[dict[str, Any], list[Decision]]:
    """Hold choices that are no knobs against what else there is; return those to change, and all as decisions."""
    chosen: dict[str, Any] = {}
    decisions = list[Decision]()
    for name, other, why in _others(trials, scene):
        try:
            trial = trials.encode({name: other})
        except GsplatError:
            continue
        if (trial.bytes, trial.level) == (usual.bytes, usual.level):
            continue
        changes = trial.bytes <= usual.bytes and trial.level >= usual.level - _EQUAL_DB
        first, second = (usual, trial) if changes else (trial, usual)
        if changes:
            chosen[name] = other
        lost = first.level - second.level
        decisions.append({
            "option": name,
            "value": other if changes else f"not {other}",
            "bytes_saved": first.bytes - second.bytes,
            "db_lost": round(lost, 3) if np.isfinite(lost) else None,
            "why": f"{why}; measured against {'what was' if changes else other}",
        })  # fmt: skip
    return chosen, decisions


def _others(trials: Trials, scene: GaussianCloud | GaussianSequence) -> list[tuple[str, Any, str]]:
    """Return options that are no knobs with the value that their default is held against, where that may matter."""
    from gsplat_tools.ops.outliers import find_outliers

    record, others = trials.record, list[tuple[str, Any, str]]()
    if "outliers" not in trials.fixed and isinstance(scene, GaussianCloud):
        count = int(np.count_nonzero(find_outliers(scene)))
        if count:
            others.append(("outliers", "drop", f"{count} far splats that hardly show stretch the box"))
    if "recenter" not in trials.fixed and record.position_type == "f16":
        others.append(("recenter", "off", "positions are halves, finest near the origin"))
    has_centroids = any(each.name == "centroids" for each in fields(record.write_options))
    if has_centroids and "centroids" not in {*trials.fixed, *record.knobs} and scene.sh_degree > 0:
        others.append(("centroids", "f32", "centroids of SH lie on a grid that halves hold"))
    return others


def _of_search(decision: Mapping[str, Any], budget: Budget) -> Decision:
    """Return a stream's part of a search as a decision."""
    held = "of the fewest bytes found that hold it" if budget.min_psnr is not None else "of the best pictures found within it"
    return {
        "option": " ".join(decision["options"]),
        "value": " ".join(map(_short, decision["options"].values())),
        "bytes_saved": None,
        "db_lost": None,
        "why": held + _next_price(decision),
    }


def _next_price(decision: Mapping[str, Any]) -> str:
    """Return what the next finer option of a stream is expected to cost."""
    if decision["next_bytes"] is None or decision["next_db"] is None:
        return ""
    return f"; one step finer costs {decision['next_bytes']:,} bytes and brings {decision['next_db']:.2f} dB"


def _against_preset(searcher: Searcher, found: Found) -> list[Decision]:
    """Return every stream's choice held against what the preset has, the others as they were chosen; measured."""
    decisions = []
    final = searcher.whole.encode(found.options)
    for each in found.decisions:
        try:
            other = searcher.whole.encode({name: value for name, value in found.options.items() if name not in each["options"]})
        except GsplatError:
            continue  # the scene does not fit without it
        lost = other.level - final.level
        is_same = other.bytes == final.bytes and other.level == final.level
        decisions.append({
            "option": " ".join(each["options"]),
            "value": " ".join(map(_short, each["options"].values())),
            "bytes_saved": other.bytes - final.bytes,
            "db_lost": round(lost, 3) if np.isfinite(lost) else None,
            "why": ("as the preset has it" if is_same else "against the preset's, all else as chosen") + _next_price(each),
        })  # fmt: skip
    return decisions


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def without_what_never_changes(
    scene: GaussianCloud | GaussianSequence,
) -> tuple[GaussianCloud | GaussianSequence, list[Decision]]:
    """Return a scene without motion that moves nothing, or one frame of a sequence whose frames are all the same."""
    if isinstance(scene, GaussianSequence):
        first = scene.frame(0)
        if len(scene) == 1 or not all(_is_same(first, scene.frame(frame_id)) for frame_id in range(1, len(scene))):
            return scene, []
        still = GaussianSequence(lambda _frame: first, num_splats=scene.num_splats, sh_degree=scene.sh_degree, num_frames=1)
        why = f"all {len(scene)} frames are the same"
        return still, [{"option": "frames", "value": 1, "bytes_saved": None, "db_lost": 0.0, "why": why}]
    if not scene.has_motion or scene.velocities is None or scene.times is None or scene.durations is None:
        return scene, []
    always = scene.time_model == "window" and bool(((scene.times <= 0) & (scene.times + scene.durations >= 1)).all())
    if not always or scene.velocities.any():
        return scene, []
    size = scene.velocities.nbytes + scene.times.nbytes + scene.durations.nbytes
    why = f"nothing moves, and all splats are there all the time: {size:,} bytes before compression"
    still_cloud = scene.replace(velocities=None, times=None, durations=None)
    return still_cloud, [{"option": "motion", "value": "none", "bytes_saved": None, "db_lost": 0.0, "why": why}]


def _is_same(one: GaussianCloud, other: GaussianCloud) -> bool:
    """Whether two frames hold the same bits."""
    mine, theirs = one.arrays(), other.arrays()
    return mine.keys() == theirs.keys() and all(np.array_equal(values, theirs[name]) for name, values in mine.items())


def zero_bands(before: int, after: int) -> Decision:
    """Return the decision to leave out bands that are zero everywhere."""
    why = f"bands {after + 1} to {before} are zero everywhere"
    return {"option": "sh_degree", "value": after, "bytes_saved": None, "db_lost": 0.0, "why": why}
