"""Choose by prediction, verify on the whole scene, correct the prediction, and again."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
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
