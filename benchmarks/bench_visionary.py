"""Visionary's pipeline: how long its preprocess pass takes, and what each precision of its buffers costs.

Run: python benchmarks/bench_visionary.py [FILE ...] [--repeat R]

Without files, random splats. Times are the best of R after a first run that compiles; the yardstick is `render` of the same
scene by model `unity`. PSNR is that of what a file gives back against the source, drawn by model `visionary`, worst of 4
views; the share of lost needles is that of splats whose smallest axis half precision loses.
"""

from __future__ import annotations

import argparse
import io
import time
import warnings
from collections.abc import Callable

import numpy as np
from machine import describe_machine

from gsplat_tools import GaussianCloud, load, render
from gsplat_tools.attributes.covariance import covariance_triangles
from gsplat_tools.codecs.visionary_buffers import half_covariance_losses
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.ops.ordering import order_splats
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.image_metrics import psnr
from gsplat_tools.reference.visionary import preprocess
from gsplat_tools.tuning.precision import choose_clip

SETTINGS = [
    ("f32", {}),
    ("f16", {}),
    ("i8", {}),
    ("i8", {"clip": 0.0}),
    ("i8", {"clip": "rendered"}),
    ("i8", {"position_bits": 8}),
]


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


def stored(cloud: GaussianCloud, precision: str, options: dict) -> tuple[GaussianCloud, int, float, float]:
    """Return what a file gives back, its bytes, and the seconds of writing and of reading."""
    record = FORMATS[f"visionary-{precision}"]
    stream = io.BytesIO()
    start = time.perf_counter()
    record.write(cloud, stream, record.write_options(**options))
    written = time.perf_counter()
    stream.seek(0)
    found = record.read(stream, record.read_options())
    return found, len(stream.getbuffer()), written - start, time.perf_counter() - written


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    scenes = {str(file).rsplit("/", 1)[-1]: load(file) for file in arguments.files} or {"random": random_cloud(200_000)}
    scenes = {name: order_splats(cloud, "morton") for name, cloud in scenes.items()}
    print(describe_machine())

    columns = f"{'unity ms':>9} {'visionary ms':>13} {'preprocess ms':>14} {'ratio':>6}"
    print(f"\n{'scene':<30} {'splats':>9} {columns} {'axis lost':>10} {'x2 or /2':>9} {'overflow':>9}")
    for name, cloud in scenes.items():
        camera = auto_cameras(cloud, views=4)[0]
        yardstick, drawn, prepared = (
            best(function, arguments.repeat)
            for function in (
                lambda cloud=cloud, camera=camera: render(cloud, camera, model="unity"),
                lambda cloud=cloud, camera=camera: render(cloud, camera, model="visionary"),
                lambda cloud=cloud, camera=camera: preprocess(cloud, camera, precision="f16"),
            )
        )
        losses = half_covariance_losses(covariance_triangles(cloud.quats, cloud.log_scales, dtype=np.float64))
        times = f"{1e3 * yardstick:9.0f} {1e3 * drawn:13.0f} {1e3 * prepared:14.0f} {yardstick / drawn:6.2f}"
        shares = [f"{share / losses.splats:.2%}" for share in (losses.vanished, losses.halved, losses.overflowed)]
        print(f"{name:<30} {len(cloud):9} {times} {shares[0]:>10} {shares[1]:>9} {shares[2]:>9}")

    print(f"\n{'scene':<30} {'setting':<24} {'bytes/splat':>11} {'write ms':>9} {'read ms':>8} {'PSNR min':>9} {'mean':>7}")
    for name, cloud in scenes.items():
        cameras = auto_cameras(cloud, views=4)
        pictures = [render(cloud, camera, model="visionary").image for camera in cameras]
        for precision, options in SETTINGS:
            if options.get("clip") == "rendered":
                chosen = {"clip": choose_clip(cloud).clip}
                label = f"i8 clip rendered: {chosen['clip']}"
            else:
                chosen, label = options, " ".join([precision, *(f"{key} {value}" for key, value in options.items())])
            found, size, writing, reading = stored(cloud, precision, chosen)
            values = [
                psnr(picture, render(found, camera, model="visionary").image) or np.inf
                for picture, camera in zip(pictures, cameras, strict=True)
            ]
            times = f"{1e3 * writing:9.0f} {1e3 * reading:8.0f}"
            print(f"{name:<30} {label:<24} {size / len(cloud):11.1f} {times} {min(values):9.1f} {np.mean(values):7.1f}")


if __name__ == "__main__":
    main()
