"""What the tool's own shortcuts cost: number types and views of the renderer, sampled palettes and statistics.

    python benchmarks/bench_tool_accuracy.py SCENE...

Every row compares a quicker way with a slower one in the same run.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine

from gsplat_tools import load, render
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.ops.sampling import spread_runs
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.tuning.measuring import Setting, Workbench

REPEATS = 3


def best_of(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the shortest time of a few runs after a first one, and the result."""
    result = work()
    spent = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        result = work()
        spent.append(time.perf_counter() - start)
    return min(spent), result


def rendering(cloud: GaussianCloud) -> None:
    """float32 against float64, and what that does to a PSNR."""
    camera = auto_cameras(cloud, views=1, size=(640, 360))[0]
    quick, picture = best_of(lambda: render(cloud, camera).image)
    slow, exact = best_of(lambda: render(cloud, camera, dtype="float64").image)
    off = np.abs(picture - exact)
    rms = float(np.sqrt(np.square(off).mean()))
    print(
        f"  render 640x360: float32 {quick:.3f} s, float64 {slow:.3f} s ({slow / quick:.2f}x); "
        f"largest difference {off.max():.1e}, rms {rms:.1e}, that is {-20 * np.log10(rms):.0f} dB"
    )


def views(cloud: GaussianCloud) -> None:
    """The PSNR that few and small views find, against many."""
    found = []
    for count, size in ((2, (320, 180)), (4, (480, 270)), (8, (640, 360)), (24, (640, 360))):
        bench = Workbench(cloud, views=count, size=size)
        bench.measure(Setting(format="spark"))
        start = time.perf_counter()
        likeness = bench.measure(Setting(format="spark")).likeness
        assert likeness is not None
        spent = time.perf_counter() - start
        found.append(f"{count} of {size[0]}x{size[1]} {likeness.level:.2f} / {likeness.psnr_mean:.2f} dB {spent:.2f} s")
    print(f"  views (spark, PSNR min / mean): {'; '.join(found)}")


def statistics(cloud: GaussianCloud) -> None:
    """Percentiles of a spread sample against those of all splats."""
    for share in (16, 4):
        start = time.perf_counter()
        sample = cloud.take(spread_runs(cloud, len(cloud) // share))
        part = np.percentile(sample.log_scales, (1, 50, 99))
        quick = time.perf_counter() - start
        start = time.perf_counter()
        whole = np.percentile(cloud.log_scales, (1, 50, 99))
        slow = time.perf_counter() - start
        print(
            f"  percentiles 1, 50, 99 of log scales: one in {share} {np.round(part, 3)} {quick:.3f} s; "
            f"all {np.round(whole, 3)} {slow:.3f} s"
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="+", type=Path)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    for path in arguments.scenes:
        cloud = load(path)
        assert isinstance(cloud, GaussianCloud)
        print(f"{path.stem}: {len(cloud):,} splats, SH degree {cloud.sh_degree}")
        rendering(cloud)
        views(cloud)
        statistics(cloud)


if __name__ == "__main__":
    main()
