"""What one stream of a format may cost: its options, those that were measured, and a prediction of the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.errors import GsplatError
from gsplat_tools.formats.knobs import ATTRIBUTES, Knob, Stream
from gsplat_tools.tuning.trials import Errors, Trials

Option = tuple[tuple[str, Any], ...]
"""Values of the knobs of one stream; knobs that say nothing beside the others are left out."""

_ANCHOR, _KNOTS = 0.6, (0.2, 0.95)
"""Where along its values a graded knob is measured at first: the anchor, at which other knobs are varied, and two more,
the second not for SH palettes, whose largest take long."""

_FLOOR = 1e-14
"""Mean square error below any that float32 pictures have, so that logarithms exist."""


class StreamModel:
    """Bytes and errors of the options of one stream.

    Parameters
    ----------
    name
        The stream.
    knobs
        Its knobs, those that are pinned left out.
    others
        Values of the knobs of the other streams while this one is measured.
    """

    def __init__(self, name: Stream, knobs: Mapping[str, Knob], others: Mapping[str, Any]) -> None:
        self.name, self.knobs, self.others = name, dict(knobs), dict(others)
        self.options = _options(self.knobs)
        self._graded = [knob_name for knob_name, knob in self.knobs.items() if knob.graded]
        self._places = [self._place(option) for option in self.options]
        self._categories = [self._category(option) for option in self.options]
        self.bytes: NDArray[np.float64] = np.full(len(self.options), np.nan)
        self.errors: list[Errors | None] = [None] * len(self.options)
        self.is_impossible = np.zeros(len(self.options), np.bool_)

    def _category(self, option: Option) -> Option:
        """Return the part of an option that is not graded."""
        return tuple(item for item in option if item[0] not in self._graded)

    def _place(self, option: Option) -> tuple[int, ...]:
        """Return where each graded value stands among the values of its knob."""
        given = dict(option)
        return tuple(self.knobs[name].values.index(given[name]) for name in self._graded if name in given)

    def anchor(self) -> Option:
        """Return the option of the finest category at which other streams are measured."""
        members = [i for i, category in enumerate(self._categories) if category == self._categories[-1]]
        wanted = [round(_ANCHOR * (len(self.knobs[name].values) - 1)) for name in self._names(members[0])]
        return self.options[min(members, key=lambda i: _distance(self._places[i], wanted))]

    def _names(self, index: int) -> list[str]:
        """Return the graded knobs that an option names."""
        return [name for name in self._graded if name in dict(self.options[index])]

    def coarser(self, index: int) -> list[int]:
        """Return the options whose graded knobs are coarser than those of an option, all else alike, the coarsest first."""
        place, category = self._places[index], self._categories[index]
        found = [
            i
            for i, (other, kind) in enumerate(zip(self._places, self._categories, strict=True))
            if kind == category and other != place and all(a <= b for a, b in zip(other, place, strict=True))
        ]
        return sorted(found, key=lambda i: self._places[i])

    def first_choices(self) -> list[Option]:
        """Return the options that are measured before anything is predicted."""
        chosen: list[Option] = []
        for category in dict.fromkeys(self._categories):
            members = [i for i, each in enumerate(self._categories) if each == category]
            lengths = [len(self.knobs[name].values) - 1 for name in self._names(members[0])]
            anchor = [round(_ANCHOR * length) for length in lengths]
            knots = _KNOTS[: 1 if "sh_palette_size" in self.knobs else 2]
            wanted = [
                anchor,
                *(
                    [*anchor[:axis], round(share * length), *anchor[axis + 1 :]]
                    for axis, length in enumerate(lengths)
                    for share in knots
                ),
            ]
            places = {self._places[i]: i for i in members}
            chosen += [self.options[min(places.values(), key=lambda i: _distance(self._places[i], at))] for at in wanted]
        return list(dict.fromkeys(chosen))

    def is_measured(self, index: int) -> bool:
        """Whether an option need not be predicted."""
        return self.is_impossible[index] or self.errors[index] is not None

    def measure(self, trials: Trials, option: Option) -> None:
        """Try an option while the other streams stay as they are."""
        index = self.options.index(option)
        if self.is_measured(index):
            return
        values = {**self.others, **dict(option)}
        try:
            if self.name == "splats":
                trial = trials.prepare(values)
                self.bytes[index], self.errors[index] = trial.splats, trial.errors
                return
            trial = trials.encode(values, ATTRIBUTES[self.name], draw=self.name != "container")
        except GsplatError:
            self.is_impossible[index] = True
            return
        self.bytes[index], self.errors[index] = trial.bytes, trial.errors

    def predict(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return bytes (O,) and errors (O, pictures) of all options; infinite bytes where nothing is known.

        Over graded knobs, bytes and logarithms of errors run straight between what was measured at the anchor of the
        others, and knobs add up.
        """
        measured = [i for i in range(len(self.options)) if self.errors[i] is not None]
        num_pictures = max((len(each) for each in self.errors if each is not None), default=0)
        total_bytes = np.full(len(self.options), np.inf)
        logs = np.zeros((len(self.options), num_pictures))
        for i in measured:
            total_bytes[i], logs[i] = self.bytes[i], np.log(np.maximum(self.errors[i], _FLOOR))  # type: ignore[arg-type] # measured
        for i, category in enumerate(self._categories):
            if self.is_measured(i):
                continue
            known = [j for j in measured if self._categories[j] == category]
            if not known:
                continue
            anchor = self._most_central(known)
            total_bytes[i], logs[i] = total_bytes[anchor], logs[anchor]
            for axis, place in enumerate(self._places[i]):
                line = [j for j in known if _others(self._places[j], axis) == _others(self._places[anchor], axis)]
                line.sort(key=lambda j: self._places[j][axis])
                at = [self._places[j][axis] for j in line]
                total_bytes[i] += _along(at, total_bytes[line], place) - total_bytes[anchor]
                logs[i] += _along(at, logs[line], place) - logs[anchor]
        return total_bytes, np.exp(logs) * (logs > np.log(_FLOOR) + 1e-6)

    def _most_central(self, known: Sequence[int]) -> int:
        """Return the option with most others on its axes."""
        width = len(self._places[known[0]])
        return max(
            known,
            key=lambda i: sum(
                _others(self._places[i], axis) == _others(self._places[j], axis) for j in known for axis in range(width)
            ),
        )


def _options(knobs: Mapping[str, Knob]) -> list[Option]:
    """Return every combination of values that differs from the others."""
    seen: dict[Option, None] = {}
    for values in product(*(knob.values for knob in knobs.values())):
        given = dict(zip(knobs, values, strict=True))
        seen[tuple((name, value) for name, value in given.items() if _counts(knobs[name], given, knobs))] = None
    return list(seen)


def _counts(knob: Knob, given: Mapping[str, Any], knobs: Mapping[str, Knob]) -> bool:
    """Whether a knob says something beside the values of the others."""
    return all(name not in knobs or given[name] in values for name, values in knob.needs.items())


def _others(place: tuple[int, ...], axis: int) -> tuple[int, ...]:
    return place[:axis] + place[axis + 1 :]


def _distance(place: Sequence[int], wanted: Sequence[int]) -> int:
    return sum(abs(a - b) for a, b in zip(place, wanted, strict=True))


def _along(at: Sequence[int], values: NDArray[np.float64], place: int) -> Any:
    """Return values on the straight lines between points, continued beyond the last two."""
    if len(at) == 1:
        return values[0]
    right = int(np.clip(np.searchsorted(at, place), 1, len(at) - 1))
    left = right - 1
    share = (place - at[left]) / (at[right] - at[left])
    return values[left] + share * (values[right] - values[left])
