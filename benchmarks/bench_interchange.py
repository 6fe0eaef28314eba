"""Write and read .spz, .splat and compressed.ply, against splat-transform where it is installed.

    python benchmarks/bench_interchange.py SCENE.ply [--splats 843000] [--repeat 5] [--splat-transform COMMAND]

The scene's splats, without SH, are tiled to the number asked for, each copy with a little noise, so that compressors find
no repeats that a scene would not have. Ours are warm library calls (`save` and `load`, best of
R); splat-transform's time is the one that it reports for its own work, and both whole commands are timed as well. Files
stay in the page cache.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools.cloud import GaussianCloud, concatenate
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.ops.harmonics import with_sh_degree

TARGETS = (
    ("scene.spz", {}),
    ("scene.spz", {"preset": "fast"}),
    ("scene.spz", {"version": 3}),
    ("scene.compressed.ply", {}),
    ("scene.compressed.ply", {"preset": "fast"}),
    ("scene.splat", {}),
    ("scene.splat", {"preset": "fast"}),
)


def tiled(cloud: GaussianCloud, splats: int) -> GaussianCloud:
    """Copies side by side, each with noise of a few percent."""
    rng = np.random.default_rng(0)

    def noisy(values: np.ndarray, sigma: float) -> np.ndarray:
        return values + rng.normal(0, sigma, values.shape).astype(np.float32)

    extent = np.ptp(np.percentile(cloud.means, [1, 99], axis=0), axis=0)
    copies = -(-splats // len(cloud))
    side = int(np.ceil(copies ** (1 / 3)))
    cells = np.array(np.unravel_index(np.arange(copies), (side,) * 3)).T
    tiles = [
        cloud.replace(
            means=noisy(cloud.means + (extent * cell).astype(np.float32), 1e-3),
            log_scales=noisy(cloud.log_scales, 0.05),
            quats=noisy(cloud.quats, 0.02),
            opacity_logits=noisy(cloud.opacity_logits, 0.05),
            sh0=noisy(cloud.sh0, 0.02),
        )
        for cell in cells
    ]
    return concatenate(tiles).take(slice(0, splats))


def best_of(repeat: int, function: Callable[[], object]) -> float:
    """Seconds of the fastest call, after one that does not count."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def run_peer(command: list[str]) -> tuple[float | None, float]:
    """Seconds that splat-transform reports for its own work, and those of the whole command."""
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    whole = time.perf_counter() - start
    if done.returncode:
        raise OSError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"exit status {done.returncode}")
    words = re.findall(r"done in ([0-9.]+) ?(ms|s)", done.stderr + done.stdout)
    reported = None if not words else float(words[-1][0]) / (1000 if words[-1][1] == "ms" else 1)
    return reported, whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splats", type=int, default=843_000)
    parser.add_argument("--sh-degree", type=int, default=0)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--splat-transform", default="splat-transform")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    cloud = load(arguments.scene)
    assert isinstance(cloud, GaussianCloud)
    scene = tiled(with_sh_degree(cloud, arguments.sh_degree), arguments.splats)
    print(describe_machine())
    print(f"{len(scene):,} splats of SH degree {scene.sh_degree}, tiled from {arguments.scene.name}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = folder / "source.ply"
        save(scene, source)
        peers: dict[str, tuple[float | None, float, int]] = {}
        for target in ("scene.spz", "scene.compressed.ply"):
            path = folder / f"peer.{target}"
            try:
                runs = [
                    run_peer([arguments.splat_transform, "-w", "-g", "cpu", os.fspath(source), os.fspath(path)])
                    for _ in range(min(arguments.repeat, 3))
                ]
            except OSError as error:
                print(f"splat-transform: not measured ({error})")
                break
            reported = [r for r, _ in runs if r is not None]
            peers[target] = min(reported, default=None), min(whole for _, whole in runs), path.stat().st_size
        print(f"{'':40}{'seconds':>9}{'bytes':>13}{'ratio':>8}{'read':>9}")
        for target, (reported, whole, size) in peers.items():
            print(f"{'splat-transform ' + target:40}{reported or float('nan'):>9.3f}{size:>13,}{1:>8.2f}")
            print(f"{'  whole command':40}{whole:>9.3f}")
        for target, options in TARGETS:
            path = folder / target
            seconds = best_of(arguments.repeat, lambda p=path, o=options: save(scene, p, overwrite=True, **o))
            reading = best_of(arguments.repeat, lambda p=path: load(p))
            label = target + "".join(f" {key}={value}" for key, value in options.items())
            peer = peers.get(target, (None, 0.0, 0))[0]
            ratio = f"{seconds / peer:.2f}" if peer else ""
            print(f"{label:40}{seconds:>9.3f}{path.stat().st_size:>13,}{ratio:>8}{reading:>9.3f}")
            if not options:
                command = [str(Path(sys.executable).parent / "gsplat-convert"), os.fspath(source), os.fspath(path)]
                start = time.perf_counter()
                subprocess.run([*command, "--overwrite", "--no-validate", "--quiet"], check=True)
                print(f"{'  whole command':40}{time.perf_counter() - start:>9.3f}")


if __name__ == "__main__":
    main()
