"""Numbered cases of a format: the systematic ones first, then mutants without end; each can be made again from its number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain
from random import Random

from tests.hostile.corpus import seeds_of
from tests.hostile.mutations import mutant, systematic
from tests.hostile.seed import Seed


@dataclass(frozen=True)
class Case:
    """One hostile file."""

    index: int
    seed: Seed
    what: str
    data: bytes


def cases(format_id: str, start: int, stop: int) -> Iterator[Case]:
    """Yield the cases from `start` on; those beyond the systematic ones are mutants."""
    position = 0
    for seed, count in systematic_counts(format_id):
        if start < position + count and position < stop:
            for offset, (what, data, is_sealed) in enumerate(_whole(seed)):
                if start <= position + offset < stop:
                    yield Case(position + offset, seed, what, data if is_sealed else seed.seal(data))
        position += count
    for index in range(max(start, position), stop):
        yield make_mutant(format_id, index)


def make_mutant(format_id: str, index: int) -> Case:
    """Return a random case; it depends on the format and the number alone."""
    rng = Random(f"{format_id} {index}")
    seed = rng.choice(seeds_of(format_id))
    if seed.rebuild and rng.random() < 0.5:
        data = rng.choice(seed.rebuild)(rng)
        # Half of the rebuilt files are damaged once more.
        if rng.random() < 0.25:
            place = rng.randrange(len(data) + 1)
            data = data[:place] + rng.randbytes(1) + data[place + 1 :]
        return Case(index, seed, "rebuilt", seed.seal(data) if data[:3] == b"NGS" or data[:4] == b"GSPK" else data)
    return Case(index, seed, "mutant", seed.seal(mutant(seed, rng)))


def _whole(seed: Seed) -> Iterator[tuple[str, bytes, bool]]:
    """Yield the systematic cases of a seed and whether each is sealed already, which takes time; its relatives first."""
    for what, data in chain(seed.named(), seed.relatives()):
        yield what, data, True
    for what, data in systematic(seed):
        yield what, data, False


def named(format_id: str) -> Iterator[Case]:
    """Yield the files of a format that are there for one rule each."""
    for seed in seeds_of(format_id):
        for what, data in seed.named():
            yield Case(-16, seed, what, data)  # judged thoroughly


def relatives(format_id: str) -> Iterator[Case]:
    """Yield the files of a format that are there for one rule or one field each."""
    yield from named(format_id)
    for seed in seeds_of(format_id):
        for number, (what, data) in enumerate(seed.relatives()):
            yield Case(-1 - number, seed, what, data)


@cache
def systematic_counts(format_id: str) -> tuple[tuple[Seed, int], ...]:
    """Return each seed and how many systematic cases it gives."""
    return tuple((seed, sum(1 for _ in _whole(seed))) for seed in seeds_of(format_id))


def num_systematic(format_id: str) -> int:
    """Return how many cases of a format are systematic."""
    return sum(count for _, count in systematic_counts(format_id))


def sample(format_id: str, count: int) -> Iterator[Case]:
    """Yield `count` cases: half of them spread over the systematic ones, half mutants."""
    total = num_systematic(format_id)
    wanted = min(count // 2, total)
    chosen = {total * i // wanted for i in range(wanted)}
    position = 0
    for seed, number in systematic_counts(format_id):
        for offset, (what, data, is_sealed) in enumerate(_whole(seed)):
            if position + offset in chosen:
                yield Case(position + offset, seed, what, data if is_sealed else seed.seal(data))
        position += number
    for index in range(total, total + count - wanted):
        yield make_mutant(format_id, index)
