"""Write every format again and again: threads, hash seeds, and kernels compiled afresh must not change a byte.

Run as `scripts/reliability determinism`, or `python -m tests.reliability.determinism --help`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from gsplat_tools.parallel import use_jobs
from tests.reliability.cases import cases

JOBS = (1, 2, 4)
SPLATS = 40_000
"""Three blocks of work, so that threads have something to share."""


def digests(splats: int, jobs: int) -> dict[str, str]:
    """Return the SHA-256 of what every writer writes, all files of a target together, by case."""
    found = {}
    for case in cases():
        with tempfile.TemporaryDirectory() as folder, use_jobs(jobs):
            case.write(Path(folder) / case.name, splats if case.record.id not in {"sog", "sog4d"} else splats // 10)
            whole = hashlib.sha256()
            for entry in sorted(Path(folder).iterdir()):
                whole.update(entry.name.encode() + entry.read_bytes())
        found[case.id] = whole.hexdigest()
    return found


def in_fresh_process(splats: int, jobs: int, *, hash_seed: int, cache: Path | None = None) -> dict[str, str]:
    """Return `digests` as a new process finds them, with compiled kernels from and into a folder of its own if given."""
    environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed)}
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    program = f"import json; from tests.reliability.determinism import digests; print(json.dumps(digests({splats}, {jobs})))"
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=root, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    found: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return found


def differences(first: dict[str, str], other: dict[str, str]) -> list[str]:
    """Return the cases whose bytes differ."""
    return [name for name in first if other.get(name) != first[name]]


def main() -> int:
    """Run everything and print a line a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20, help="processes with a hash seed each (default: %(default)s)")
    parser.add_argument("--splats", type=int, default=SPLATS, help="splats of the scenes (default: %(default)s)")
    given = parser.parse_args()
    start = time.perf_counter()
    seeds = random.Random(0)
    first: dict[str, str] = {}
    changed: set[str] = set()
    for run in range(given.runs):
        jobs, seed = JOBS[run % len(JOBS)], seeds.randrange(1, 1 << 32)
        with tempfile.TemporaryDirectory() as cache:
            is_cold = run < len(JOBS)  # kernels compiled by this very process
            found = in_fresh_process(given.splats, jobs, hash_seed=seed, cache=Path(cache) if is_cold else None)
        first = first or found
        differing = differences(first, found)
        changed.update(differing)
        kernels = "compiled afresh" if is_cold else "from the cache"
        print(
            f"run {run + 1}: {jobs} threads, hash seed {seed}, kernels {kernels}: {', '.join(differing) or 'the same'}",
            flush=True,
        )
    print(f"{len(first)} writers, {given.runs} runs, {len(changed)} with different bytes, {time.perf_counter() - start:.0f} s")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
