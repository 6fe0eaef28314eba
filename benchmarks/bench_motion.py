"""What baking a 4D asset to keyframes costs: bytes and PSNR at random times, evenly spaced and adaptive frames.

    python benchmarks/bench_motion.py SCENE.ply [--frames 15 30 60] [--tolerances 0.02 0.01] [--times 200]

The scene is given procedural motion: three fifths of it stand and always show; a fifth drifts and comes and goes at any
time; the last fifth bursts outward from the middle within a tenth of the time. It is baked to .sog4d, read back, and
drawn at random times beside the 4D asset itself. "uncoded" is the same frames without .sog4d between: what interpolation
alone loses. Then the 60 frames are fitted back to one .splat4d.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.ops.keyframes import choose_frames, interpolation_error
from gsplat_tools.ops.motion import bake
from gsplat_tools.ops.motion_fitting import fit_motion
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.image_metrics import compare_images
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.sequence import GaussianSequence


def with_motion(cloud: GaussianCloud, seed: int) -> GaussianCloud:
    """The scene of the benchmark."""
    rng = np.random.default_rng(seed)
    count = len(cloud)
    kind = rng.choice(3, count, p=[0.6, 0.2, 0.2])
    middle, reach = np.median(cloud.means, axis=0), np.percentile(np.abs(cloud.means - np.median(cloud.means, axis=0)), 90)
    outward = (cloud.means - middle) / np.maximum(np.linalg.norm(cloud.means - middle, axis=1, keepdims=True), 1e-6)
    velocities = np.zeros((count, 3), np.float32)
    velocities[kind == 1] = rng.normal(0, 0.1 * reach, (np.count_nonzero(kind == 1), 3))
    velocities[kind == 2] = reach * outward[kind == 2]
    times = np.where(kind == 0, 0.0, np.where(kind == 1, rng.uniform(0, 0.8, count), 0.4 + rng.uniform(0, 0.1, count)))
    durations = np.where(kind == 0, 1.0, np.where(kind == 1, rng.uniform(0.2, 0.6, count), rng.uniform(0.2, 0.3, count)))
    return cloud.replace(velocities=velocities, times=times, durations=durations)


def cached(sequence: GaussianSequence) -> GaussianSequence:
    """The same frames, the last two kept: times are asked for in rising order."""
    return GaussianSequence(
        lru_cache(maxsize=2)(sequence.frame),
        num_splats=sequence.num_splats,
        sh_degree=sequence.sh_degree,
        frame_times=None if sequence.is_uniform else sequence.frame_times,
        num_frames=len(sequence),
    )


def frames_for(asset: GaussianCloud, count: int) -> np.ndarray:
    """The adaptive choice with the most frames up to `count`."""
    low, high = 1e-4, 0.5
    for _ in range(12):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if len(choose_frames(asset, middle).times) <= count else (middle, high)
    return choose_frames(asset, high).times


class Judge:
    """PSNR against the asset at fixed times and views."""

    def __init__(self, asset: GaussianCloud, times: np.ndarray, views: int, size: tuple[int, int]) -> None:
        self.times = times
        self._cameras = auto_cameras(asset, views=views, size=size)
        self._true = [self._draw(asset, t) for t in times]

    def _draw(self, scene: GaussianCloud, t: float) -> list[np.ndarray]:
        return [render(scene, camera, model="unity", variant="fork-4d", t=t).image for camera in self._cameras]

    def judge(self, scene: GaussianSequence | GaussianCloud) -> str:
        """Lowest, fifth percentile and mean PSNR."""
        levels = []
        for t, true in zip(self.times, self._true, strict=True):
            still = scene.at(t) if isinstance(scene, GaussianSequence) else scene
            pairs = zip(true, self._draw(still, t), strict=True)
            levels += [np.inf if (p := compare_images(a, b).psnr) is None else p for a, b in pairs]
        finite = [level for level in levels if np.isfinite(level)] or [np.inf]
        return f"{min(levels):>8.2f}{np.percentile(levels, 5, method='lower'):>8.2f}{np.mean(finite):>8.2f}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("--frames", type=int, nargs="*", default=[15, 30, 60])
    parser.add_argument("--tolerances", type=float, nargs="*", default=[0.02, 0.01])
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 180))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    scene = load(arguments.scene)
    assert isinstance(scene, GaussianCloud)
    asset = with_motion(scene, arguments.seed)
    times = np.sort(np.random.default_rng(arguments.seed + 1).uniform(0, 1, arguments.times))
    judge = Judge(asset, times, arguments.views, tuple(arguments.size))
    print(f"{len(asset):,} splats of SH degree {asset.sh_degree}, {len(times)} random times, {arguments.views} views")
    print(f"{'':44}{'---- .sog4d, dB ----':>24}{'---- uncoded, dB ----':>24}")
    columns = ("keyframes", "frames", "bytes", "error", "seconds", *["min", "5 %", "mean"] * 2)
    print("".join(f"{name:>{width}}" for name, width in zip(columns, (16, 8, 13, 7, 9, *[8] * 6), strict=True)))
    plans: list[tuple[str, int | np.ndarray]] = []
    for count in arguments.frames:
        plans += [(f"even {count}", count), (f"auto for {count}", frames_for(asset, count))]
    for tolerance in arguments.tolerances:
        choice = choose_frames(asset, tolerance)
        plans.append((f"auto {tolerance:g}", choice.times))
        if choice.uniform_frames is not None:
            plans.append((f" as even {choice.uniform_frames}", choice.uniform_frames))
    with tempfile.TemporaryDirectory() as folder:
        for label, plan in plans:
            start = time.perf_counter()
            baked = bake(asset, plan)
            report = save(baked, Path(folder) / "baked.sog4d", overwrite=True)
            seconds = time.perf_counter() - start
            error = interpolation_error(asset, baked.frame_times)
            coded = load(Path(folder) / "baked.sog4d")
            assert isinstance(coded, GaussianSequence)
            quality = judge.judge(cached(coded)) + judge.judge(cached(baked))
            print(f"{label:>16}{len(baked):>8}{report.bytes:>13,}{error:>7.4f}{seconds:>9.1f}{quality}", flush=True)
        baked = bake(asset, max(arguments.frames))
        start = time.perf_counter()
        fitted, residuals = fit_motion(baked)
        seconds = time.perf_counter() - start
        report = save(fitted, Path(folder) / "fitted.splat4d")
        again = load(Path(folder) / "fitted.splat4d")
        assert isinstance(again, GaussianCloud)
        print(f"{len(baked)} frames fitted in {seconds:.1f} s to a .splat4d of {report.bytes:,} bytes: {residuals.summary()}")
        print(f"dB (min, 5 %, mean):{judge.judge(again)}")


if __name__ == "__main__":
    main()
