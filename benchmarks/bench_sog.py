"""Write and read .sog, and compare bytes, seconds and pictures with splat-transform's where its files are given.

Run: python benchmarks/bench_sog.py [SCENE.ply[=THEIRS.sog] ...] [--repeat R] [--views V] [--splat-transform COMMAND]

Without scenes a cloud of 843,000 splats without SH is made. COMMAND, such as "node bin/cli.mjs", is timed in the same run
(whole command, CPU). Our times are those of library calls in a warm process, best of R; files stay in the page cache.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning

PRESETS = ("fast", "balanced", "best")


def surface_cloud(count: int) -> GaussianCloud:
    """Return flat splats on spheres, colored smoothly."""
    rng = np.random.default_rng(7)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centers = rng.uniform(-5, 5, (40, 3))
    means = normals * rng.uniform(0.5, 1.5, (40, 1))[np.arange(count) % 40] + centers[np.arange(count) % 40]
    return GaussianCloud(
        means=means,
        log_scales=np.stack([rng.normal(-5, 0.7, count), rng.normal(-5, 0.7, count), rng.normal(-8, 1, count)], axis=1),
        quats=rng.normal(size=(count, 4)),
        opacity_logits=rng.normal(1, 2, count),
        sh0=np.sin(means * 3) + rng.normal(0, 0.1, (count, 3)),
        shN=np.empty((count, 0, 3)),
    )


def best_of(repeat: int, function: Callable[[], Any]) -> float:
    """Return the shortest time of a call, after one that is not counted."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Print one table a scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--splat-transform")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    with tempfile.TemporaryDirectory() as folder:
        for scene in arguments.scenes or [""]:
            measure(scene, Path(folder), arguments)


def measure(scene: str, folder: Path, arguments: argparse.Namespace) -> None:
    """Print the table of one scene."""
    name, _, theirs = scene.partition("=")
    source = gsplat_tools.load(name) if name else surface_cloud(843_000)
    assert isinstance(source, GaussianCloud)
    print(f"\n{Path(name).name or 'generated'}: {len(source)} splats, SH degree {source.sh_degree}")
    header = f"{'':<24}{'bytes':>12}{'a splat':>9}{'write s':>9}{'read s':>8}"
    print(f"{header}{'PSNR min':>10}{'mean':>8}{'unpacked min':>14}{'mean':>8}")
    if arguments.splat_transform:
        ply, target = Path(name) if name else folder / "source.ply", folder / "theirs.sog"
        if not name:
            gsplat_tools.save(source, ply, overwrite=True)
        command = [*shlex.split(arguments.splat_transform), "-q", "-w", "-g", "cpu", str(ply), str(target)]
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        row("splat-transform", source, target, time.perf_counter() - start, arguments)
    elif theirs:
        row("splat-transform's file", source, Path(theirs), None, arguments)
    for preset in PRESETS:
        target = folder / f"{preset}.sog"
        repeat = arguments.repeat if preset != "best" else 1
        seconds = best_of(repeat, lambda: gsplat_tools.save(source, target, preset=preset, overwrite=True))  # noqa: B023
        row(f"gsplat_tools {preset}", source, target, seconds, arguments)


def row(label: str, source: GaussianCloud, path: Path, seconds: float | None, arguments: argparse.Namespace) -> None:
    """Print one file's figures; "unpacked" is Spark without its packing of splats into 16 bytes."""
    read = best_of(arguments.repeat, lambda: gsplat_tools.load(path))
    candidate = gsplat_tools.load(path)
    levels = ""
    for variant in (None, "none") if arguments.views else ():
        report = gsplat_tools.compare(source, candidate, views=arguments.views, model="spark", variant=variant)
        width = 10 if variant is None else 14
        levels += f"{report.psnr_min or np.inf:>{width}.2f}{report.psnr_mean or np.inf:>8.2f}"
    size = path.stat().st_size
    written = f"{seconds:>9.2f}" if seconds is not None else f"{'-':>9}"
    print(f"{label:<24}{size:>12,}{size / len(source):>9.2f}{written}{read:>8.2f}{levels}", flush=True)


if __name__ == "__main__":
    main()
