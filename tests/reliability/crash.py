"""Kill every writer at every operation, every line and at random moments, and look at what stands there afterwards.

Run as `scripts/reliability crash`, or `python -m tests.reliability.crash --help`.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.reliability.cases import Case, cases
from tests.reliability.faults import (
    Act,
    Operations,
    die_after,
    die_before,
    die_halfway,
    in_child,
    killed_at_line,
    leftovers,
    operations_of,
)

OLD, NEW = 1, 2
"""Seeds of the scene that stands there before, and of the one that is written."""

RANDOM_SPLATS = 20_000
ACTS = {"before": die_before, "halfway": die_halfway, "after": die_after}


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
        """Write the new scene."""
        self.case.write(self.path, self.splats, NEW)

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
        self.write()
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


def kill_at_operations(case: Case, *, exists: bool) -> Counter[str]:
    """Kill the writer before, in the middle of and after every operation."""
    outcomes: Counter[str] = Counter()
    with targets(case, 12, exists=exists) as fresh:
        names = operations_of(fresh().write)
        for number, name in enumerate(names):
            for moment, act in ACTS.items():
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
                target.check_next_run(what)
    return outcomes


def kill_at_lines(case: Case, *, exists: bool, step: int = 1) -> Counter[str]:
    """Kill the writer before every line of what puts files in place."""
    outcomes: Counter[str] = Counter()
    with targets(case, 12, exists=exists) as fresh:
        count = killed_at_line(fresh().write, None)[1]
        for line in range(0, count, step):
            target = fresh()
            what = f"killed at line {line} of {count}"
            if killed_at_line(target.write, line)[0] != -signal.SIGKILL:
                raise Broken(f"{case.id}, {what}: the child was not killed")
            outcomes[target.check(what)] += 1
            target.check_next_run(what)
    return outcomes


def kill_at_random(case: Case, *, exists: bool, times: int, seed: int = 0) -> Counter[str]:
    """Kill the writer from outside, at moments spread over the time that it takes."""
    outcomes: Counter[str] = Counter()
    rng = np.random.default_rng(seed)
    with targets(case, RANDOM_SPLATS, exists=exists) as fresh:
        spent = []
        for _ in range(3):
            target, start = fresh(), time.perf_counter()
            if in_child(target.write):
                raise Broken(f"{case.id}: the writer failed by itself")
            spent.append(time.perf_counter() - start)
        for _ in range(times):
            target = fresh()
            moment = rng.uniform(0, 1.1 * float(np.median(spent)))
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
    print(f"{'writer':<20}{'killed':<14}{'kills':>7}{'old':>7}{'absent':>8}{'new':>7}{'ended before':>14}")
    broken = 0
    totals: Counter[str] = Counter()
    for case in cases():
        if given.only and given.only not in case.id:
            continue
        for what, kill in (
            ("operations", kill_at_operations),
            ("lines", kill_at_lines),
            ("at random", lambda case, *, exists: kill_at_random(case, exists=exists, times=-(-given.kills // 2))),
        ):
            outcomes: Counter[str] = Counter()
            try:
                for exists in (False, True):
                    outcomes += kill(case, exists=exists)
            except Broken as error:
                broken += 1
                print(f"BROKEN: {error}", file=sys.stderr)
            totals += outcomes
            cells = [outcomes[name] for name in ("old", "absent", "new", "ended before")]
            print(
                f"{case.id:<20}{what:<14}{outcomes.total():>7}{cells[0]:>7}{cells[1]:>8}{cells[2]:>7}{cells[3]:>14}", flush=True
            )
    print(f"{totals.total()} kills, {broken} broken promises, {time.perf_counter() - start:.0f} s")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
