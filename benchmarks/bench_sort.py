"""Sort depths with payload, against numpy's stable argsort in the same run.

Run: python benchmarks/bench_sort.py [--repeat R] [--large]

Times are the best of R, after a first run that compiles. --large adds 20 million depths (0.5 GB).
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from machine import describe_machine

from gsplat_tools.parallel import num_jobs, use_jobs
from gsplat_tools.reference.sorting import float_to_sortable, sort_pairs


def best(function: Callable[[], object], repeat: int) -> float:
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def sort(depths: np.ndarray, payload: np.ndarray) -> np.ndarray:
    return sort_pairs(float_to_sortable(depths), payload)[1]


def peak_memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--large", action="store_true")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    print(describe_machine())
    print(f"{'depths':>10} {'keys':<22} {'threads':>7} {'numpy ms':>9} {'ours ms':>9} {'M keys/s':>9} {'ratio':>6}")
    for count in (10_000, 100_000, 1_000_000, *([20_000_000] if arguments.large else [])):
        kinds = {
            "uniform": rng.random(count, dtype=np.float32) * 100,
            "one octave": 1 + rng.random(count, dtype=np.float32),
            "sorted": np.sort(rng.random(count, dtype=np.float32)),
            "256 values": rng.integers(1, 257, count).astype(np.float32),
        }
        payload = np.arange(count, dtype=np.uint32)
        for name, depths in kinds.items():
            repeat = max(2, arguments.repeat if count < 10_000_000 else 2)
            yardstick = best(partial(np.argsort, depths, kind="stable"), max(2, repeat // 3))
            for jobs in sorted({1, num_jobs()}):
                with use_jobs(jobs):
                    order = sort(depths, payload)
                    ours = best(partial(sort, depths, payload), repeat)
                assert np.array_equal(order, np.argsort(depths, kind="stable"))
                print(
                    f"{count:>10,} {name:<22} {jobs:>7} {yardstick * 1e3:>9.2f} {ours * 1e3:>9.2f}"
                    f" {count / ours / 1e6:>9.1f} {yardstick / ours:>6.1f}"
                )
    print(f"peak memory {peak_memory() / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
