"""All streams of a format together: what a combination is expected to cost, and the best one within a budget.

Errors of streams are nearly independent, so that mean square errors add up, picture by picture; so do bytes. Leaving out
splats, and how bytes are packed, multiply them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import CapabilityError, GsplatError
from gsplat_tools.formats.knobs import ATTRIBUTES, Knob, Stream
from gsplat_tools.tuning.streams import Option, StreamModel
from gsplat_tools.tuning.trials import Errors, Trials, level

_MAX_ELEMENTS = 1 << 19
"""Errors that are compared at once: combinations times pictures. Where there are more, some options of each stream are
combined first, and then all of them, two streams at a time."""
_FEWEST = 5
"""Options of a stream that are combined at least."""
_SWEEPS = 4
_FACTORS = ("splats", "codes", "container")


@dataclass(frozen=True, slots=True)
class Choice:
    """One option a stream, and what is expected of them.

    Parameters
    ----------
    places
        Index of the option of every stream, in the order of the model.
    bytes, errors
        Prediction, before any correction.
    """

    places: tuple[int, ...]
    bytes: float
    errors: Errors

    @property
    def level(self) -> float:
        """PSNR of the worst picture, dB."""
        return level(self.errors)


class RateModel:
    """Predicts bytes and errors of every combination from options that were measured by themselves.

    Parameters
    ----------
    trials
        Scene and format.
    knobs
        What may be turned.

    Raises
    ------
    CapabilityError
        The format cannot hold the scene with any of the settings that were tried.
    """

    def __init__(self, trials: Trials, knobs: Mapping[str, Knob]) -> None:
        self._trials = trials
        by_stream: dict[Stream, dict[str, Knob]] = {}
        for name, knob in knobs.items():
            by_stream.setdefault(knob.stream, {})[name] = knob
        plain = [StreamModel(stream, members, {}) for stream, members in by_stream.items()]
        self.base: dict[Stream, Option] = {each.name: _base(each) for each in plain if len(each.options) > 1}
        self._settle_base(plain)
        self.streams = [
            StreamModel(stream, by_stream[stream], self._values(base for name, base in self.base.items() if name != stream))
            for stream in self.base
        ]
        arrays = None
        if "sh" in self.base:  # its errors are taken whole, not as differences: the base is far from the finest
            arrays = ("means", "log_scales", "quats", "opacity_logits", "sh0", "velocities", "times", "durations")
        self._fixed = trials.encode(self._values(self.base.values()), arrays)
        for stream in self.streams:
            for option in (self.base[stream.name], *stream.first_choices()):
                stream.measure(trials, option)

    def _settle_base(self, plain: Sequence[StreamModel]) -> None:
        """Lower what does not fit the scene, such as bits of positions, until it does."""
        streams = {each.name: each for each in plain}
        while True:
            try:
                self._trials.encode(self._values(self.base.values()), draw=False)
            except GsplatError as error:
                positions = streams.get("positions")
                place = -1 if positions is None else positions.options.index(self.base["positions"])
                if place <= 0 or positions is None:
                    raise CapabilityError(f"nothing can be searched: {error.message}") from error
                self.base["positions"] = positions.options[place - 1]
            else:
                return

    @staticmethod
    def _values(options: Any) -> dict[str, Any]:
        """Return the values of several options as one mapping."""
        return {name: value for option in options for name, value in option}

    def options_of(self, choice: Choice) -> dict[str, Any]:
        """Return the values of a choice."""
        return self._values(stream.options[place] for stream, place in zip(self.streams, choice.places, strict=True))

    def table(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return what every option of every stream adds: bytes (or a factor), and errors (options x pictures)."""
        rows = []
        for stream in self.streams:
            sizes, errors = stream.predict()
            at = stream.options.index(self.base[stream.name])
            sizes = sizes / sizes[at] if stream.name in _FACTORS else sizes - sizes[at]
            if stream.name == "container":
                errors = np.zeros((len(sizes), len(self._fixed.errors)))
            elif stream.name == "sh":
                pass
            elif ATTRIBUTES[stream.name]:
                errors = errors - errors[at]
            rows.append((sizes, errors))
        return rows

    def choose(
        self, *, min_level: float | None = None, max_bytes: float = np.inf, scale: Errors | float = 1.0
    ) -> Choice | None:
        """Return the combination with fewest bytes that reaches a level, or with the highest level within bytes.

        Parameters
        ----------
        min_level
            dB that the worst picture must reach; None asks for the highest level.
        max_bytes
            Bytes at most.
        scale
            Factor of the errors of every picture.

        Returns
        -------
        Choice or None
            None where no combination is expected to do.
        """
        table = self.table()
        kept = [_undominated(sizes, errors) for sizes, errors in table]
        wanted = None if min_level is None else 10 ** (-min_level / 10)
        count = int(np.prod([len(each) for each in kept]))
        most = _MAX_ELEMENTS // len(self._fixed.errors)
        if count <= most:
            return self._best(table, kept, wanted, max_bytes, scale)
        share = (most / count) ** (1 / max(1, sum(len(each) > _FEWEST for each in kept)))
        choice = self._best(
            table, [_thinned(each, max(_FEWEST, int(len(each) * share))) for each in kept], wanted, max_bytes, scale
        )
        for _ in range(_SWEEPS):
            before = choice
            for pair in combinations(range(len(kept)), 2):
                if choice is not None:  # one of what the pair is chosen from, so that there always is one
                    rows = [kept[axis] if axis in pair else np.array([place]) for axis, place in enumerate(choice.places)]
                    choice = self._best(table, rows, wanted, max_bytes, scale)
            if choice is None or before is None or choice.places == before.places:
                break
        return choice

    def _best(
        self,
        table: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
        kept: Sequence[NDArray[np.intp]],
        wanted: float | None,
        max_bytes: float,
        scale: Errors | float,
        avoided: Iterable[tuple[int, ...]] = (),
    ) -> Choice | None:
        """Return the best combination of some options of every stream; `wanted` is the largest squared error."""
        shape = tuple(len(each) for each in kept)
        sizes = np.full(shape, float(self._fixed.bytes))
        errors = np.zeros((*shape, len(self._fixed.errors))) + self._fixed.errors
        factor = np.ones(shape)
        for axis, ((own_sizes, own_errors), rows) in enumerate(zip(table, kept, strict=True)):
            along = [1] * len(shape)
            along[axis] = len(rows)
            if self.streams[axis].name in _FACTORS:
                factor = factor * own_sizes[rows].reshape(along)
            else:
                sizes = sizes + own_sizes[rows].reshape(along)
            errors = errors + own_errors[rows].reshape(*along, -1)
        sizes = (sizes * factor).ravel()
        worst = np.maximum((errors * scale).max(axis=-1), 0).ravel()
        if wanted is not None:
            fits = (worst <= wanted) & (sizes <= max_bytes)
            key = sizes
        else:
            fits = sizes <= max_bytes
            key = worst
        for places in avoided:
            found = [np.flatnonzero(rows == place) for rows, place in zip(kept, places, strict=True)]
            if all(len(each) for each in found):
                fits[np.ravel_multi_index(tuple(int(each[0]) for each in found), shape)] = False
        if not fits.any():
            return None
        candidates = np.flatnonzero(fits)
        best = candidates[np.lexsort((sizes[candidates], key[candidates]))[0]]
        at = np.unravel_index(best, shape)
        places = tuple(int(rows[i]) for rows, i in zip(kept, at, strict=True))
        return Choice(places, float(sizes[best]), np.maximum(errors[at], 0))

    def choose_near(
        self,
        near: Choice,
        *,
        min_level: float | None = None,
        max_bytes: float = np.inf,
        scale: Errors | float = 1.0,
        avoided: Collection[tuple[int, ...]] = (),
    ) -> Choice | None:
        """Do as `choose`, among the combinations that differ from one in two streams at most, but for those to avoid."""
        table = self.table()
        kept = [_undominated(sizes, errors) for sizes, errors in table]
        wanted = None if min_level is None else 10 ** (-min_level / 10)
        found = list[Choice]()
        for pair in combinations(range(len(kept)), min(2, len(kept))):
            rows = [kept[axis] if axis in pair else np.array([place]) for axis, place in enumerate(near.places)]
            choice = self._best(table, rows, wanted, max_bytes, scale, avoided)
            if choice is not None:
                found.append(choice)
        if wanted is not None:
            return min(found, key=lambda each: each.bytes, default=None)
        return min(found, key=lambda each: (float((each.errors * scale).max(initial=0.0)), each.bytes), default=None)

    def settle(self, rounds: int = 12, near: Choice | None = None, **budget: Any) -> Choice | None:
        """Return `choose`, or `choose_near` of a choice, once every option of it was measured, not predicted."""

        def choose() -> Choice | None:
            return self.choose(**budget) if near is None else self.choose_near(near, **budget)

        choice = choose()
        for _ in range(rounds):
            if choice is None:
                return None
            guessed = [
                (stream, place)
                for stream, chosen in zip(self.streams, choice.places, strict=True)
                for place in _looked_at(stream, chosen)
                if not stream.is_measured(place)
            ]
            if not guessed:
                return choice
            for stream, place in guessed:
                stream.measure(self._trials, stream.options[place])
            choice = choose()
        return choice

    def neighbours(self, choice: Choice, axis: int, scale: Errors | float) -> tuple[Choice | None, Choice | None]:
        """Return the choices with the next smaller option of a stream, and the next larger one that helps the worst picture."""
        sizes, errors = self.table()[axis]
        rows = sorted(_undominated(sizes, errors), key=lambda row: sizes[row])
        here = sizes[choice.places[axis]]
        smaller = [self.moved(choice, axis, row) for row in rows if sizes[row] < here][-1:]
        larger = (self.moved(choice, axis, row) for row in rows if sizes[row] > here)
        reached = level(choice.errors * scale)
        finer = next((each for each in larger if level(each.errors * scale) > reached), None)
        return (smaller[0] if smaller else None), finer

    def moved(self, choice: Choice, axis: int, place: int) -> Choice:
        """Return a choice with another option of one stream."""
        places = (*choice.places[:axis], place, *choice.places[axis + 1 :])
        table = self.table()
        sizes, factor, errors = float(self._fixed.bytes), 1.0, self._fixed.errors.copy()
        for stream, (own_sizes, own_errors), at in zip(self.streams, table, places, strict=True):
            if stream.name in _FACTORS:
                factor *= own_sizes[at]
            else:
                sizes += own_sizes[at]
            errors = errors + own_errors[at]
        return Choice(places, sizes * factor, np.maximum(errors, 0))


def _base(stream: StreamModel) -> Option:
    """Return where a stream stands while others are measured: finest, but quick to encode."""
    if stream.name == "container":
        return stream.options[0]
    return stream.anchor() if stream.name in {"sh", "scales"} else stream.options[-1]


def _looked_at(stream: StreamModel, place: int) -> list[int]:
    """Return the options to measure for a choice: some beside it too where that needs a picture and no encoding."""
    beside = (0,) if stream.name != "splats" else (-4, -1, 0, 1, 4)
    return [place + step for step in beside if 0 <= place + step < len(stream.options)]


def _undominated(sizes: NDArray[np.float64], errors: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the options to which no other is better in bytes and every picture, the smallest first."""
    order = np.lexsort((errors.max(axis=1, initial=0.0), sizes))
    kept: list[int] = []
    for row in order:
        if not np.isfinite(sizes[row]):
            break
        if not any((errors[other] <= errors[row]).all() for other in kept):
            kept.append(int(row))
    return np.array(kept, np.intp)


def _thinned(rows: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return some of the options, evenly spaced, the ends among them."""
    if len(rows) <= count:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(np.intp))]
