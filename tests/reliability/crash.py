"""Kill every writer at every operation, every line and at random moments, and look at what stands there afterwards.

Run as `scripts/reliability crash`, or `python -m tests.reliability.crash --help`.
"""

from __future__ import annotations

import argparse
import errno
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsplat_tools.errors import GsplatError
from tests.reliability.cases import Case, cases
from tests.reliability.faults import (
    Act,
    Operations,
    die_after,
    die_before,
    die_halfway,
    failing,
    in_child,
    interrupted_at_line,
    killed_at_line,
    leftovers,
    lines_of,
    lose,
    operations_of,
    spoil,
)

OLD, NEW = 1, 2
"""Seeds of the scene that stands there before, and of the one that is written."""

RANDOM_SPLATS = 5_000
NEXT_RUN_EVERY = 5
"""Kills after which the writer is run once more, and must sweep."""

ACTS = {"before": die_before, "halfway": die_halfway, "after": die_after}
FAULTS: dict[str, Act] = {"ENOSPC": failing(errno.ENOSPC), "EIO": failing(errno.EIO), "lost": lose, "changed": spoil}
FAULT_WORDS = {"ENOSPC": {"space"}, "EIO": {"Input/output"}, "lost": {"read"}, "changed": {"read"}}


class Broken(AssertionError):
    """A promise was not kept."""


@dataclass(frozen=True, slots=True)
class Target:
    """A target in a folder of its own, and what may stand there.

    Parameters
    ----------
    case, path, splats
        What is written where.
    before
        What stood there before the writer began; None for nothing.
    after
        What stands there when it ends well.
    """

    case: Case
    path: Path
    splats: int
    before: str | None
    after: str | None

    def write(self) -> None:
        """Write the new scene, without leave to overwrite where nothing stands."""
        self.case.write(self.path, self.splats, NEW, overwrite=self.before is not None)

    def check(self, what: str) -> str:
        """Return "old", "new" or "absent"; raise where anything else stands there."""
        found = self.case.content(self.path)
        if found == self.before:
            return "absent" if found is None else "old"
        if found == self.after:
            return "new"
        raise Broken(f"{self.case.id}, {what}: neither the old nor the new target stands there")

    def check_next_run(self, what: str) -> None:
        """Write once more: that must end well and sweep what the killed writer left."""
        self.case.write(self.path, self.splats, NEW)
        if self.case.content(self.path) != self.after:
            raise Broken(f"{self.case.id}, {what}: the next run wrote something else")
        if left := leftovers(self.path.parent):
            raise Broken(f"{self.case.id}, {what}: the next run did not sweep {left}")


@contextmanager
def targets(case: Case, splats: int, *, exists: bool) -> Iterator[Callable[[], Target]]:
    """Give a function that sets up a fresh target."""
    with tempfile.TemporaryDirectory(prefix="gsplat-crash-") as folder:
        root = Path(folder)
        contents = {}
        for seed in (OLD, NEW):
            place = root / str(seed)
            place.mkdir()
            case.write(place / case.name, splats, seed)
            contents[seed] = case.content(place / case.name)
        count = 0

        def fresh() -> Target:
            nonlocal count
            count += 1
            place = root / f"try{count}"
            place.mkdir()
            if exists:
                for file in (root / str(OLD)).iterdir():
                    (place / file.name).write_bytes(file.read_bytes())
            return Target(case, place / case.name, splats, contents[OLD] if exists else None, contents[NEW])

        yield fresh


def kill_at_operations(case: Case, *, exists: bool, acts: Mapping[str, Act] = ACTS, most: int | None = None) -> Counter[str]:
    """Kill the writer before, in the middle of and after every operation; run it once more after every few kills."""
    outcomes: Counter[str] = Counter()
    with targets(case, 12, exists=exists) as fresh:
        names = operations_of(fresh().write)
        for number in chosen(names, most):
            name = names[number]
            for moment, act in acts.items():
                if moment == "halfway" and name != "write":
                    continue
                target = fresh()

                def work(target: Target = target, number: int = number, act: Act = act) -> None:
                    with Operations(number, act).installed():
                        target.write()

                what = f"killed {moment} operation {number} ({name})"
                if in_child(work) not in {-signal.SIGKILL, 1}:
                    raise Broken(f"{case.id}, {what}: the child was not killed")
                outcomes[target.check(what)] += 1
                if outcomes.total() % NEXT_RUN_EVERY == 0:
                    target.check_next_run(what)
    return outcomes


def kill_at_lines(case: Case, *, exists: bool, step: int = 1) -> Counter[str]:
    """Kill the writer before every line of what puts files in place, when it runs first and when it runs last."""
    outcomes: Counter[str] = Counter()
    with targets(case, 12, exists=exists) as fresh:
        places = lines_of(fresh().write)
        first = {place: number for number, place in reversed(list(enumerate(places)))}
        last = {place: number for number, place in enumerate(places)}
        for line in sorted({*first.values(), *last.values()})[::step]:
            target = fresh()
            what = f"killed at {places[line]}, line {line} of {len(places)}"
            if killed_at_line(target.write, line) != -signal.SIGKILL:
                raise Broken(f"{case.id}, {what}: the child was not killed")
            outcomes[target.check(what)] += 1
            if outcomes.total() % NEXT_RUN_EVERY == 0:
                target.check_next_run(what)
    return outcomes


def interrupt_at_lines(case: Case, *, exists: bool, step: int = 1) -> Counter[str]:
    """Interrupt the writer, as the commands do on SIGTERM, before every line until it begins to publish and to clean up."""
    outcomes: Counter[str] = Counter()
    with targets(case, 12, exists=exists) as fresh:
        places = lines_of(fresh().write)
        # What an interruption of that leaves, the next run sweeps.
        functions = [place.split(":")[1] for place in places]
        complete = functions.index("read_back")
        last = min(functions.index(name, complete) for name in ("_publish", "temporary_beside"))
        first = {place: number for number, place in reversed(list(enumerate(places[:last])))}
        for line in sorted(first.values())[::step]:
            target = fresh()
            what = f"interrupted at {places[line]}, line {line} of {len(places)}"
            if not interrupted_at_line(target.write, line):
                raise Broken(f"{case.id}, {what}: the interruption was swallowed")
            outcomes[target.check(what)] += 1
            if left := leftovers(target.path.parent):
                raise Broken(f"{case.id}, {what}: {left} were left")
    return outcomes


def fail_at_operations(case: Case, *, exists: bool, most: int | None = None) -> Counter[str]:
    """Let every operation fail, every write fill the disk, and every write lose or change bytes."""
    outcomes: Counter[str] = Counter()
    with targets(case, 12, exists=exists) as fresh:
        names = operations_of(fresh().write)
        for number in chosen(names, most):
            for fault, act in FAULTS.items():
                if fault != "EIO" and names[number] != "write":
                    continue
                target = fresh()
                what = f"{fault} at operation {number} ({names[number]})"
                error: Exception | None = None
                try:
                    with Operations(number, act, keeps_on=fault == "ENOSPC").installed():
                        target.write()
                except (GsplatError, OSError) as caught:
                    error = caught
                outcome = target.check(what)
                outcomes[outcome] += 1
                if error is None:
                    # Some operations only tidy up; those that bring bytes to the disk must not fail in silence.
                    if outcome != "new" or (fault in {"EIO", "ENOSPC"} and names[number] in {"write", "fsync"}):
                        raise Broken(f"{case.id}, {what}: no error was raised, and the target is {outcome}")
                    continue
                if not isinstance(error, GsplatError) or error.path is None or not FAULT_WORDS[fault] & set(str(error).split()):
                    raise Broken(f"{case.id}, {what}: the error does not say what happened: {error!r}")
                if names[number] == "write" and (outcome == "new" or leftovers(target.path.parent)):
                    raise Broken(f"{case.id}, {what}: the target is {outcome}, left are {leftovers(target.path.parent)}")
    return outcomes


def chosen(names: list[str], most: int | None) -> list[int]:
    """Return the numbers of all operations, or of so many of each name, the first and the last among them."""
    kept: set[int] = set()
    for name in dict.fromkeys(names):
        numbers = [number for number, other in enumerate(names) if other == name]
        count = len(numbers) if most is None else min(most, len(numbers))
        kept.update(numbers[round(i * (len(numbers) - 1) / max(1, count - 1))] for i in range(count))
    return sorted(kept)


def kill_at_random(case: Case, *, exists: bool, times: int, splats: int = RANDOM_SPLATS, seed: int = 0) -> Counter[str]:
    """Kill the writer from outside, at moments spread over the time that it takes."""
    outcomes: Counter[str] = Counter()
    rng = np.random.default_rng(seed)
    with targets(case, splats, exists=exists) as fresh:
        spent = []
        for _ in range(3):
            target, start = fresh(), time.perf_counter()
            if in_child(target.write):
                raise Broken(f"{case.id}: the writer failed by itself")
            spent.append(time.perf_counter() - start)
        # A child that ends before its moment was not killed, and does not count.
        while outcomes.total() - outcomes["ended before"] < times:
            target = fresh()
            moment = rng.uniform(0, float(np.median(spent)))
            status = in_child(target.write, kill_after=moment)
            what = f"killed after {moment:.4f} s"
            outcome = target.check(what)
            if status == 0 and outcome != "new":
                raise Broken(f"{case.id}, {what}: the writer ended well but the target is {outcome}")
            outcomes[outcome if status else "ended before"] += 1
            target.check_next_run(what)
    return outcomes


def main() -> int:
    """Run everything and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="random kills per writer (default: %(default)s)")
    parser.add_argument("--only", help="run the writers whose name holds this")
    given = parser.parse_args()
    start = time.perf_counter()
    print(f"{'writer':<20}{'killed at':<15}{'times':>7}{'old':>8}{'absent':>8}{'new':>8}{'ended before':>14}")
    broken = 0
    totals: Counter[str] = Counter()
    for case in cases():
        if given.only and given.only not in case.id:
            continue
        for what, kill in (
            ("operations", kill_at_operations),
            ("lines", kill_at_lines),
            ("interrupted", interrupt_at_lines),
            ("failed, lossy", fail_at_operations),
            ("random moments", lambda case, *, exists: kill_at_random(case, exists=exists, times=-(-given.kills // 2))),
        ):
            outcomes: Counter[str] = Counter()
            try:
                for exists in (False, True):
                    outcomes += kill(case, exists=exists)
            except Broken as error:
                broken += 1
                print(f"BROKEN: {error}", file=sys.stderr)
            ended = outcomes.pop("ended before", 0)
            totals += outcomes
            cells = "".join(f"{outcomes[name]:>8}" for name in ("old", "absent", "new"))
            print(f"{case.id:<20}{what:<15}{outcomes.total():>7}{cells}{ended:>14}", flush=True)
    print(f"{totals.total()} faults, {broken} broken promises, {time.perf_counter() - start:.0f} s")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
