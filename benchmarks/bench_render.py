"""Draw a scene with every model, and see how time grows with splats and pixels.

Run: python benchmarks/bench_render.py [FILE] [--size WxH] [--repeat R] [--scaling]

FILE is any scene that gsplat_tools reads; without it a random one of 100,000 splats. Times are warm means over the eight
automatic views, the best of R rounds; the yardstick is numpy's exp over one float for each pixel of the picture.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from machine import describe_machine

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.parallel import num_jobs
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.models import MODELS
from gsplat_tools.reference.rasterizer import render


def random_scene(count: int) -> GaussianCloud:
    """Splats on the surface of a sphere."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((count, 3), np.float32)
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    size = np.float32(np.log(2.0 / np.sqrt(count)))
    return GaussianCloud(
        means=means,
        log_scales=rng.standard_normal((count, 3), np.float32) * np.float32(0.4) + size,
        quats=rng.standard_normal((count, 4), np.float32),
        opacity_logits=rng.standard_normal(count, np.float32) * np.float32(2),
        sh0=rng.standard_normal((count, 3), np.float32),
        shN=rng.standard_normal((count, 8, 3), np.float32) * np.float32(0.1),
    )


def best(function: Callable[[], object], repeat: int) -> float:
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?")
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--scaling", action="store_true", help="also: a table over splats and pixels")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    cloud = random_scene(100_000) if arguments.file is None else gsplat_tools.load(arguments.file)
    assert isinstance(cloud, GaussianCloud)
    print(f"{describe_machine()}, {num_jobs()} threads")
    print(f"{len(cloud):,} splats of SH degree {cloud.sh_degree}, {width}x{height}, mean of 8 views\n")
    cameras = auto_cameras(cloud, size=(width, height))
    floats = np.random.default_rng(0).random(width * height, np.float32)
    yardstick = best(lambda: np.exp(floats), 5)
    print(f"{'model':<10} {'variant':<8} {'type':<8} {'framebuffer':<11} {'s':>7} {'yardsticks':>10} {'drawn':>9}")
    settings = [(model, variant, "float32", "float") for model, variants in MODELS.items() for variant in variants]
    settings += [("unity", "1.2.1", "float32", "unorm8"), ("inria", None, "float64", "float")]
    for model, variant, dtype, framebuffer in settings:

        def draw(chosen: dict[str, str | None]) -> int:
            return sum(render(cloud, camera, **chosen).counts.drawn for camera in cameras)  # type: ignore[arg-type]

        chosen = {"model": model, "variant": variant, "dtype": dtype, "framebuffer": framebuffer}
        seconds = best(lambda chosen=chosen: draw(chosen), arguments.repeat) / len(cameras)
        drawn = draw(chosen) // len(cameras)
        print(
            f"{model:<10} {variant or '':<8} {dtype:<8} {framebuffer:<11} {seconds:>7.3f} {seconds / yardstick:>10.0f}"
            f" {drawn:>9,}"
        )
    if arguments.scaling:
        print_scaling(cloud, arguments.repeat)


def print_scaling(cloud: GaussianCloud, repeat: int) -> None:
    """Print seconds over splats and pixels, model inria; the views stay those of the whole scene."""
    sizes = [(320, 180), (640, 360), (1280, 720), (2560, 1440)]
    print(f"\nseconds a view, model inria\n{'splats':>10} " + " ".join(f"{f'{w}x{h}':>10}" for w, h in sizes))
    for share in (16, 8, 4, 2, 1):
        part = cloud.take(slice(0, None, share))
        row = []
        for size in sizes:
            cameras = auto_cameras(cloud, views=4, size=size)
            row.append(best(lambda part=part, cameras=cameras: [render(part, c) for c in cameras], repeat) / len(cameras))
        print(f"{len(part):>10,} " + " ".join(f"{seconds:>10.3f}" for seconds in row))


if __name__ == "__main__":
    main()
