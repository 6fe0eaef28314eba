"""Choose by prediction, verify on the whole scene, correct the prediction, and again."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsplat_tools.errors import CapabilityError, GsplatError, ValidationError
from gsplat_tools.tuning.model import Choice, RateModel
from gsplat_tools.tuning.trials import Trial, Trials, level

_ROUNDS = 7
_STEP = 0.1
"""What is asked for beyond the budget after a choice came up again, dB or tenths of the logarithm of the bytes."""
_REPEATS = 20
"""How often more is asked for until something new comes up."""

LARGE = 1 << 16
"""Splats from which fewer rounds are made, and presets finer than one that is larger already are not tried."""
_LARGE_ROUNDS = 6
_STEPS = 4
"""Coarser values of a knob that are tried on top of a preset."""

_MOST_STEPS, _LARGE_STEPS = 16, 4
"""Choices beside those that nearly hold that are tried."""
_MOST_FAILED = 3
"""Of them, beside one, that were not better than the best."""
_GAIN = 0.995
"""Share of the bytes of the best choice from which another one is worth trying."""
_MARGIN = 0.05
"""dB that are asked for beyond the budget after each that failed."""
_WORTH_COARSENING = 1.6
"""Bytes of a preset, of those of what was found, up to which it may come out smaller where splats and codes are coarser."""
_NEAR_DB = 1.5
_DB_A_DOUBLING = 8.0
"""What twice the bytes buy, about: by this, choices of unlike bytes and PSNR are compared."""
_HIGHEST = 200.0
"""dB, for pictures that are identical."""

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


class Hunt:
    """Choose by prediction, verify on the whole scene, correct the prediction, and again."""

    def __init__(self, whole: Trials, rates: RateModel, budget: Budget, splats: int) -> None:
        self._whole, self._rates, self._budget = whole, rates, budget
        self._max_bytes = budget.bytes_for(splats)
        self._ratio, self._scale = 1.0, np.ones(1)
        self._is_large = splats > LARGE
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
        return self._refined(self._polished(best or self._extreme(), advance), advance)

    def _refined(self, best: tuple[Choice, Trial], advance: Callable[[int], None]) -> tuple[Choice, Trial]:
        """Return a choice with fewer splats and coarser codes that holds a PSNR too, where it had some dB to spare."""
        for axis, stream in enumerate(self._rates.streams):
            if self._budget.min_psnr is None or stream.name not in ("splats", "codes"):
                continue
            tried = stream.coarser(best[0].places[axis])
            while tried and not self._is_close(best[1]):  # the coarsest that holds lies on one side of the middle
                middle = len(tried) // 2
                choice = self._rates.moved(best[0], axis, tried[middle])
                trial = self._verify(choice)
                advance(1)
                holds = self._holds(trial) and self._is_better(trial, best[1])
                if holds:
                    best = choice, trial
                tried = tried[:middle] if holds else tried[middle + 1 :]
        return best

    def _polished(self, best: tuple[Choice, Trial], advance: Callable[[int], None]) -> tuple[Choice, Trial]:
        """Return the best of what lies two streams away from choices that nearly hold, and of what lies beside that.

        Beside a choice that was verified, predictions are much better than over all combinations.
        """
        failed: dict[tuple[int, ...], int] = {}
        wanted = self._budget.min_psnr
        steps = _LARGE_STEPS if self._is_large else _MOST_STEPS
        while steps and (anchors := [each for each in self._near_budget() if failed.get(each[0].places, 0) < _MOST_FAILED]):
            anchor = min(anchors, key=lambda each: _price(each[1]))
            failures = failed.setdefault(anchor[0].places, 0)
            self._correct(*anchor)
            goal = best[1].level + _MARGIN if wanted is None else wanted + _MARGIN * failures
            choice = self._rates.settle(
                near=anchor[0],
                min_level=goal if wanted is not None else None,
                max_bytes=(self._max_bytes if wanted is None else best[1].bytes * _GAIN) / self._ratio,
                scale=self._scale,
                avoided=self._verified,
            )
            if choice is None or level(choice.errors * self._scale) < goal:
                failed[anchor[0].places] = _MOST_FAILED
                continue
            trial = self._verify(choice)
            advance(1)
            steps -= 1
            if self._holds(trial) and self._is_better(trial, best[1]):
                best = choice, trial
            else:
                failed[anchor[0].places] += 1
        return best

    def _near_budget(self) -> list[tuple[Choice, Trial]]:
        """Return what was verified and is not far from the budget on either side."""
        drawn = [each for each in self._verified.values() if each[1].errors.size and each[1].splats]
        if self._budget.min_psnr is not None:
            return [each for each in drawn if abs(each[1].level - self._budget.min_psnr) < _NEAR_DB]
        return [each for each in drawn if abs(np.log2(each[1].bytes / self._max_bytes)) < _NEAR_DB / _DB_A_DOUBLING]

    def preset(self, best: Trial | None) -> tuple[dict[str, Any], Trial, str] | None:
        """Return the preset that holds the budget best, codes and splats coarser while a PSNR holds; None if it is no better.

        Presets are encoded in their order; only one is drawn that fits, or is little larger than what was found.
        """
        by_psnr = self._budget.min_psnr is not None
        most = self._max_bytes
        if by_psnr and best is not None:
            most = min(most, best.bytes * (1 if self._is_large else _WORTH_COARSENING))
        chosen: tuple[dict[str, Any], Trial, str] | None = None
        for name, options in self._preset_options():
            trial = self._try(options, most)
            if trial is None:
                continue
            if trial.bytes <= most and self._holds(trial) and (chosen is None or self._is_better(trial, chosen[1])):
                chosen, most = (options, trial, f"preset {name}"), min(most, trial.bytes) if by_psnr else most
            if self._is_large and trial.bytes > most:
                break
        if chosen is not None and by_psnr:
            chosen = self._coarser(*chosen)
        return None if chosen is None or (best is not None and self._is_better(best, chosen[1])) else chosen

    def _presets(self) -> list[Trial]:
        """Encode and draw all presets that the format can hold the scene with."""
        tried = (self._try(options, np.inf) for _, options in self._preset_options())
        return [trial for trial in tried if trial is not None]

    def _preset_options(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the presets that a search may take, without what was given."""
        for name, changes in self._whole.record.presets.items():
            if name != _EXACT:
                yield name, {option: value for option, value in changes.items() if option not in self._whole.fixed}

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
                tried = [value for value in knob.values if value != options.get(name, 0)]
                if not knob.graded:
                    tried = tried[: -_STEPS - 1 : -1]
                while tried:
                    middle = len(tried) // 2 if knob.graded else 0
                    changed = {**options, name: tried[middle]}
                    found = self._try(changed, trial.bytes - 1)
                    holds = found is not None and found.bytes < trial.bytes and self._holds(found)
                    if found is not None and holds:
                        options, trial = changed, found
                    if knob.graded:  # from coarsest to finest: the coarsest that holds lies on one side
                        tried = tried[:middle] if holds else tried[middle + 1 :]
                    else:
                        tried = tried[1:] if holds or stream.name == "container" else []
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
            smaller, larger = self._rates.neighbours(choice, axis, self._scale)
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


def _price(trial: Trial) -> float:
    """Return what a trial costs for what it shows, in doublings of bytes."""
    return float(np.log2(trial.bytes) - min(trial.level, _HIGHEST) / _DB_A_DOUBLING)
