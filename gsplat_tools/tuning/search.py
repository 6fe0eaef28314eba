"""Find the cheapest encoding that holds a PSNR, or the best one within bytes, by what each knob was measured to do."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, GsplatError, ValidationError
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.knobs import Knob
from gsplat_tools.formats.saving import DEFAULT_PRESET
from gsplat_tools.progress import report_to, stage
from gsplat_tools.remembering import remembering
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning.measuring import Model, Workbench
from gsplat_tools.tuning.model import Choice, RateModel
from gsplat_tools.tuning.trials import Trial, Trials, level

TARGET_VIEWS, TARGET_SIZE = 8, (640, 360)
"""Views that a PSNR target is held at where none are asked for: those of `compare`."""

SEARCH_SPLATS = 1 << 16
"""Scenes a quarter larger are searched on a ball of so many splats around their middle, and verified whole."""
SEARCH_FRAMES = 3
"""Frames at the start of a sequence that stand for it while searching."""

_ROUNDS = 7
_STEP = 0.1
"""What is asked for beyond the budget after a choice came up again, dB or tenths of the logarithm of the bytes."""
_REPEATS = 20
"""How often more is asked for until something new comes up."""

_LARGE = 1 << 16
"""Splats from which fewer rounds are made, and presets finer than one that is larger already are not tried."""
_LARGE_ROUNDS = 4
_STEPS = 4
"""Coarser values of a knob that are tried on top of a preset."""

_EXACT = "exact"
_TINY = 1e-12
_CLOSE = 0.1
"""dB above the target, or share of the bytes below the budget, from which looking further is not worth its time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """What an encoding has to hold.

    Parameters
    ----------
    min_psnr
        dB of the worst view against the source, at the fewest bytes.
    max_bytes
        Size of the target; without `min_psnr`, at the highest PSNR of the worst view.
    max_bytes_per_splat
        The same for each splat of a frame.
    """

    min_psnr: float | None = None
    max_bytes: int | None = None
    max_bytes_per_splat: float | None = None

    def bytes_for(self, splats: int) -> float:
        """Return the bytes that so many splats, over all frames, may take."""
        per_splat = np.inf if self.max_bytes_per_splat is None else self.max_bytes_per_splat * splats
        return float(min(np.inf if self.max_bytes is None else self.max_bytes, per_splat))


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The encoding that was found.

    Parameters
    ----------
    options
        Values of the knobs that were turned.
    bytes, psnr_min
        Of the whole scene, measured; infinite for identical pictures.
    decisions
        One a stream: "stream", "options", what it bought over the next smaller one ("bytes", "db"), and what the next
        larger one would ("next_bytes", "next_db"); numbers are predictions, None where there is no such option.
    next_db_bytes, next_megabyte_db
        What one more dB, and one more megabyte, are expected to cost and to bring; None where they cannot be had.
    trials, seconds
        Encodings of the whole scene, and time of the search.
    """

    options: Mapping[str, Any]
    bytes: int
    psnr_min: float
    decisions: list[dict[str, Any]] = field(default_factory=list)
    next_db_bytes: float | None = None
    next_megabyte_db: float | None = None
    trials: int = 0
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the names of the command line's JSON."""
        return {
            "options": dict(self.options),
            "bytes": self.bytes,
            "psnr_min": self.psnr_min if np.isfinite(self.psnr_min) else None,
            "decisions": self.decisions,
            "next_db_bytes": self.next_db_bytes,
            "next_megabyte_db": self.next_megabyte_db,
            "trials": self.trials,
            "seconds": round(self.seconds, 3),
        }


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
        pinned = {**({"outliers": "keep"} if keep_splats else {}), **(pinned or {})}
        self.whole = Trials(Workbench(scene, views=views, size=size, model=model), record, preset, pinned)
        half = max(size[0] // 2, 1), max(size[1] // 2, 1)
        self._part = Trials(Workbench(_part(scene), views=views, size=half, model=model), record, preset, pinned)
        self._rates: dict[bool, RateModel] = {}
        self.is_large = _count(scene) > _LARGE

    def find(self, budget: Budget) -> Found:
        """Return the best encoding within a budget; as `search`, with the same errors."""
        start = time.perf_counter()
        keeps_splats = self._keeps_splats or budget.max_bytes_per_splat is not None
        with remembering(), stage("searching", 0, "trials") as progress, report_to(None):
            if keeps_splats not in self._rates:
                knobs = turnable(self._scene, self.whole.record, self.whole.fixed, keep_splats=keeps_splats)
                self._rates[keeps_splats] = RateModel(self._part, knobs)
            hunt = _Hunt(self.whole, self._rates[keeps_splats], budget, _count(self._scene))
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
        if keep_splats and knob.stream == "splats":
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


class _Hunt:
    """Choose by prediction, verify on the whole scene, correct the prediction, and again."""

    def __init__(self, whole: Trials, rates: RateModel, budget: Budget, splats: int) -> None:
        self._whole, self._rates, self._budget = whole, rates, budget
        self._max_bytes = budget.bytes_for(splats)
        self._ratio, self._scale = 1.0, np.ones(1)
        self._is_large = splats > _LARGE
        self._verified: dict[tuple[int, ...], tuple[Choice, Trial]] = {}

    def run(self, advance: Callable[[int], None]) -> tuple[Choice, Trial]:
        """Return the best choice that holds."""
        best: tuple[Choice, Trial] | None = None
        for _ in range(_LARGE_ROUNDS if self._is_large else _ROUNDS):
            margin = 0.0
            choice = self._propose(margin)
            for _ in range(_REPEATS):
                if choice is None or choice.places not in self._verified or (best and choice.places == best[0].places):
                    break
                margin += _STEP
                choice = self._propose(margin)
            if choice is None:
                if best is not None:
                    break
                best = self._extreme()  # which also corrects the prediction
                advance(1)
                continue
            if choice.places in self._verified:
                break
            trial = self._verify(choice)
            advance(1)
            if self._holds(trial) and (best is None or self._is_better(trial, best[1])):
                best = choice, trial
                if self._is_close(trial):
                    break
        return best or self._extreme()

    def preset(self, best: Trial | None) -> tuple[dict[str, Any], Trial, str] | None:
        """Return the smallest preset that holds a PSNR in no more bytes than what was found, a step coarser where one holds.

        Presets are encoded in their order; only one that is no larger is drawn.
        """
        if self._budget.min_psnr is None:
            return None
        limit = np.inf if best is None else best.bytes
        chosen: tuple[dict[str, Any], Trial, str] | None = None
        for name, changes in self._whole.record.presets.items():
            options = {option: value for option, value in changes.items() if option not in self._whole.fixed}
            trial = None if name == _EXACT else self._try(options, limit)
            if trial is None:
                continue
            if trial.bytes <= limit and self._holds(trial):
                chosen, limit = (options, trial, f"preset {name}"), trial.bytes
            if self._is_large and trial.bytes > limit:
                break
        return None if chosen is None else self._coarser(*chosen)

    def _presets(self) -> list[Trial]:
        """Encode and draw all presets that the format can hold the scene with."""
        changes = (each for name, each in self._whole.record.presets.items() if name != _EXACT)
        tried = (self._try({k: v for k, v in each.items() if k not in self._whole.fixed}, np.inf) for each in changes)
        return [trial for trial in tried if trial is not None]

    def _try(self, options: dict[str, Any], limit: float) -> Trial | None:
        """Encode the whole scene, and draw it if it is no larger than a limit; None where the format cannot hold it."""
        try:
            return self._whole.encode(options, limit=limit)
        except GsplatError:
            return None

    def _coarser(self, options: dict[str, Any], trial: Trial, why: str) -> tuple[dict[str, Any], Trial, str]:
        """Return options with packing, splats, and codes a step or more coarser than a preset's, while they hold."""
        for stream in self._rates.streams:
            if stream.name not in {"container", "splats", "codes"}:
                continue
            for name, knob in stream.knobs.items():
                finest_first = [value for value in reversed(knob.values) if value != options.get(name, 0)]
                for value in finest_first[:_STEPS]:
                    changed = {**options, name: value}
                    found = self._try(changed, trial.bytes - 1)
                    if found is not None and found.bytes < trial.bytes and self._holds(found):
                        options, trial = changed, found
                    elif stream.name != "container":
                        break
        return options, trial, why

    def _propose(self, margin: float) -> Choice | None:
        """Return the best choice by the corrected prediction, a little better than the budget asks for."""
        wanted = self._budget.min_psnr
        return self._rates.settle(
            min_level=None if wanted is None else wanted + margin,
            max_bytes=self._max_bytes / self._ratio * (1 if wanted is not None else float(np.exp(-margin / 10))),
            scale=self._scale,
        )

    def _verify(self, choice: Choice) -> Trial:
        """Encode and draw the whole scene, and learn from it; what the format cannot hold is worth nothing."""
        try:
            trial = self._whole.encode(self._rates.options_of(choice))
        except CapabilityError:  # the part that was searched has less in it
            trial = Trial(sys.maxsize, 0, np.ones_like(choice.errors))
            self._verified[choice.places] = choice, trial
            return trial
        self._verified[choice.places] = choice, trial
        self._correct(choice, trial)
        return trial

    def _correct(self, choice: Choice, trial: Trial) -> None:
        """Take the bytes and the errors of every picture by what came out for one choice."""
        self._ratio = trial.bytes / choice.bytes
        self._scale = np.maximum(trial.errors, _TINY) / np.maximum(choice.errors, _TINY)

    def _holds(self, trial: Trial) -> bool:
        wanted = self._budget.min_psnr
        return trial.bytes <= self._max_bytes and (wanted is None or trial.level >= wanted)

    def _is_better(self, trial: Trial, other: Trial) -> bool:
        if self._budget.min_psnr is not None:
            return trial.bytes < other.bytes
        return (trial.level, -trial.bytes) > (other.level, -other.bytes)

    def _is_close(self, trial: Trial) -> bool:
        if self._budget.min_psnr is not None:
            return trial.level < self._budget.min_psnr + _CLOSE
        return trial.bytes > (1 - 0.1 * _CLOSE) * self._max_bytes

    def _extreme(self) -> tuple[Choice, Trial]:
        """Try the finest, or the smallest, that there is; say how close it gets where it does not do.

        Raises
        ------
        ValidationError
            It does not hold the budget either.
        """
        wanted = self._budget.min_psnr
        finest = self._rates.settle()
        assert finest is not None
        if wanted is not None:
            trial = self._verify(finest)
            if self._holds(trial):
                return finest, trial
            if trial.level < wanted:
                best = max((trial, *self._presets()), key=lambda each: (each.level, -each.bytes))
                raise ValidationError(
                    f"no setting of {self._whole.record.title} reaches {wanted:g} dB: the finest has {best.level:.2f} dB in "
                    f"the worst view at {best.bytes} bytes; the target is left as it was. Ask for less, or take another format"
                )
            cheapest = self._cheapest(wanted)
            raise ValidationError(
                f"{wanted:g} dB within {int(self._max_bytes)} bytes cannot be had: {wanted:g} dB take {cheapest.bytes} bytes "
                f"({cheapest.level:.2f} dB); the target is left as it was"
            )
        smallest = self._rates.settle(min_level=0.0)
        assert smallest is not None
        trial = self._verify(smallest)
        if self._holds(trial):
            return smallest, trial
        raise ValidationError(
            f"no setting of {self._whole.record.title} fits into {int(self._max_bytes)} bytes: the smallest has {trial.bytes} "
            f"bytes and {trial.level:.2f} dB in the worst view; the target is left as it was. Leave out splats, or take "
            "another format"
        )

    def _cheapest(self, wanted: float) -> Trial:
        """Return the smallest encoding that was seen to reach a level, having looked for one."""
        choice = self._rates.settle(min_level=wanted, scale=self._scale)
        if choice is not None:
            self._verify(choice)
        return min((t for _, t in self._verified.values() if t.level >= wanted), key=lambda trial: trial.bytes)

    def report(self, found: tuple[Choice, Trial]) -> Found:
        """Return what was found, with the prices of a little more."""
        choice, trial = found
        self._correct(choice, trial)
        decisions = []
        for axis, stream in enumerate(self._rates.streams):
            smaller, larger = self._rates.neighbours(choice, axis)
            decisions.append({
                "stream": stream.name,
                "options": dict(stream.options[choice.places[axis]]),
                **self._price("bytes", "db", smaller, choice),
                **self._price("next_bytes", "next_db", choice, larger),
            })  # fmt: skip
        dearer = self._rates.choose(min_level=trial.level + 1, scale=self._scale) if np.isfinite(trial.level) else None
        richer = self._rates.choose(max_bytes=choice.bytes + 1e6 / self._ratio, scale=self._scale)
        return Found(
            options=self._rates.options_of(choice),
            bytes=trial.bytes,
            psnr_min=trial.level,
            decisions=decisions,
            next_db_bytes=self._price("bytes", "db", choice, dearer)["bytes"],
            next_megabyte_db=self._price("bytes", "db", choice, richer)["db"],
        )

    def _price(self, bytes_name: str, db_name: str, coarse: Choice | None, fine: Choice | None) -> dict[str, float | None]:
        """Return bytes and dB between two choices, as corrected; None where there is only one."""
        if coarse is None or fine is None:
            return {bytes_name: None, db_name: None}
        gain = level(fine.errors * self._scale) - level(coarse.errors * self._scale)
        return {
            bytes_name: round(self._ratio * (fine.bytes - coarse.bytes)),
            db_name: round(float(gain), 3) if np.isfinite(gain) else None,
        }


def _part(scene: GaussianCloud | GaussianSequence) -> GaussianCloud | GaussianSequence:
    """Return what stands for the scene while searching: a ball of a large one, the first frames of a sequence."""
    from gsplat_tools.ops.sampling import crop

    if isinstance(scene, GaussianCloud):
        return crop(scene, SEARCH_SPLATS, keeps_box=True) if len(scene) > 1.25 * SEARCH_SPLATS else scene
    frames = [scene.frame(frame_id) for frame_id in range(min(SEARCH_FRAMES, len(scene)))]
    return GaussianSequence(frames.__getitem__, num_splats=scene.num_splats, sh_degree=scene.sh_degree, num_frames=len(frames))


def _count(scene: GaussianCloud | GaussianSequence) -> int:
    """Return the splats of all frames."""
    return scene.num_splats * len(scene) if isinstance(scene, GaussianSequence) else len(scene)
