"""Visionary's preprocess pass: how long it takes, and what buffers in half precision cost.

Run: python benchmarks/bench_visionary.py [FILE ...] [--repeat R]

Without files, random splats. Times are the best of R after a first run that compiles; the yardstick is `render` of the same
scene by model `visionary`. PSNR is that of records from f16 buffers against records from f32 buffers, worst of 4 views.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from machine import describe_machine

from gsplat_tools import GaussianCloud, load, render
from gsplat_tools.attributes.covariance import covariance_triangles
from gsplat_tools.codecs.visionary_buffers import half_covariance_losses
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.image_metrics import psnr
from gsplat_tools.reference.visionary import preprocess
from gsplat_tools.reference.visionary_drawing import draw_records


def best(function: Callable[[], object], repeat: int) -> float:
    times = []
    for _ in range(repeat + 1):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def random_cloud(count: int) -> GaussianCloud:
    rng = np.random.default_rng(0)
    return GaussianCloud(
        means=rng.normal(size=(count, 3)),
        log_scales=rng.normal(-5, 1, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        opacity_logits=rng.normal(0, 3, count),
        sh0=rng.normal(0, 0.9, (count, 3)),
        shN=rng.normal(0, 0.15, (count, 15, 3)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    scenes = {str(file).rsplit("/", 1)[-1]: load(file) for file in arguments.files} or {"random": random_cloud(200_000)}
    print(describe_machine())
    header = f"{'scene':<32} {'splats':>9} {'render ms':>10} {'f32 ms':>8} {'f16 ms':>8} {'ratio':>6}"
    print(f"{header} {'axis vanished':>14} {'x2 or /2':>9} {'overflow':>9} {'PSNR f16':>9}")
    for name, cloud in scenes.items():
        cameras = auto_cameras(cloud, views=4)
        yardstick = best(lambda cloud=cloud, camera=cameras[0]: render(cloud, camera, model="visionary"), arguments.repeat)
        single, half = (
            best(lambda cloud=cloud, camera=cameras[0], p=p: preprocess(cloud, camera, precision=p), arguments.repeat)
            for p in ("f32", "f16")
        )
        losses = half_covariance_losses(covariance_triangles(cloud.quats, cloud.log_scales, dtype=np.float64))
        worst = min(
            psnr(*(draw_records(preprocess(cloud, camera, precision=p), camera)[0] for p in ("f32", "f16"))) or np.inf
            for camera in cameras
        )
        times = f"{1e3 * yardstick:10.0f} {1e3 * single:8.0f} {1e3 * half:8.0f} {yardstick / single:6.2f}"
        shares = [f"{share / losses.splats:.2%}" for share in (losses.vanished, losses.halved, losses.overflowed)]
        print(f"{name:<32} {len(cloud):9} {times} {shares[0]:>14} {shares[1]:>9} {shares[2]:>9} {worst:9.1f}")


if __name__ == "__main__":
    main()
