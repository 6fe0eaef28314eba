"""Write .sog4d: seconds, bytes and rendered PSNR, against scikit-learn's MiniBatchKMeans where it is installed.

Run: python benchmarks/bench_sog4d.py [SCENE.ply ...] [--palette K] [--repeat R] [--parts conversion,palette,order,effort,rate]

Without scenes, a seeded one is made: surfaces, 64 materials with noise in their SH. Times are the best of R after a first
run (compilation). The yardstick is what the packing tool of the format's authors does: mini-batch k-means without weights
for scales (4,096 triples of logs), sh0 (256 numbers) and SH, quaternions rounded, images at libwebp's method 6.
"""

from __future__ import annotations

import argparse
import io
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import quaternion_u8
from gsplat_tools.codecs.palette import fit_palette, nearest_labels
from gsplat_tools.formats import _webp
from gsplat_tools.formats.sog4d import Sog4dOptions, Sog4dReadOptions, read, write
from gsplat_tools.formats.sog4d.sampling import SAMPLE_ROWS
from gsplat_tools.ops.importance import importance
from gsplat_tools.ops.ordering import image_layout, splat_order
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.rasterizer import render

try:
    from sklearn.cluster import MiniBatchKMeans
except ImportError:
    MiniBatchKMeans = None

PARTS = ("conversion", "palette", "order", "effort", "rate")


def make_scene(count: int = 100_000, seed: int = 0) -> GaussianCloud:
    """Splats on spheres and planes, thin along the normal; each surface patch has one of 64 materials."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shape = rng.integers(0, 12, count)
    centers = rng.uniform(-3, 3, (12, 3))
    means = centers[shape] + directions * rng.uniform(0.2, 1.0, 12)[shape][:, None]
    material = (shape * 5 + (directions[:, 0] > 0) * 2 + (directions[:, 1] > 0)) % 64
    sizes = rng.normal(-5, 0.8, (count, 1))
    log_scales = np.concatenate(
        [sizes, sizes + rng.normal(0, 0.4, (count, 1)), sizes - rng.uniform(0.5, 4, (count, 1))], axis=1
    )
    half = directions + np.array([0, 0, 1])  # turns z to the normal
    quats = np.stack([half[:, 2], -half[:, 1], half[:, 0], np.zeros(count)], axis=1) + rng.normal(0, 0.1, (count, 4))
    return GaussianCloud(
        means=means,
        log_scales=log_scales,
        quats=quats,
        opacity_logits=rng.normal(1.5, 2.5, count),
        sh0=rng.normal(0, 0.8, (64, 3))[material] + rng.normal(0, 0.15, (count, 3)),
        shN=rng.normal(0, 0.12, (64, 15, 3))[material] + rng.normal(0, 0.03, (count, 15, 3)),
    )


def best_of(repeat: int, work: Callable[[], Any]) -> tuple[float, Any]:
    result = work()
    seconds = np.inf
    for _ in range(repeat):
        start = time.perf_counter()
        result = work()
        seconds = min(seconds, time.perf_counter() - start)
    return seconds, result


class Judge:
    """PSNR of a cloud against the source, as the fork draws it."""

    def __init__(self, source: GaussianCloud, views: int = 4) -> None:
        self._cameras = auto_cameras(source, views=views, size=(480, 270))
        self._pictures = [self._draw(source, camera) for camera in self._cameras]

    def _draw(self, cloud: GaussianCloud, camera: Any) -> np.ndarray:
        return np.clip(render(cloud, camera, model="unity", variant="fork-4d").image, 0, 1)

    def __call__(self, cloud: GaussianCloud) -> str:
        errors = [np.mean((self._draw(cloud, c) - p) ** 2) for c, p in zip(self._cameras, self._pictures, strict=True)]
        decibels = [-10 * np.log10(max(error, 1e-12)) for error in errors]
        return f"{min(decibels):6.2f} {np.mean(decibels):6.2f}"


def encode(cloud: GaussianCloud, **options: Any) -> bytes:
    target = io.BytesIO()
    write(cloud, target, Sog4dOptions(**options))
    return target.getvalue()


def decode(data: bytes) -> GaussianCloud:
    return read(io.BytesIO(data), Sog4dReadOptions()).frame(0)


def mini_batch(points: np.ndarray, size: int) -> np.ndarray:
    """Return the points as the yardstick's palette gives them."""
    model = MiniBatchKMeans(min(size, len(points)), batch_size=4096, random_state=0, n_init=1)
    model.fit(points)
    return model.cluster_centers_[model.predict(points)].astype(np.float32)


def yardstick(cloud: GaussianCloud, size: int) -> GaussianCloud:
    """Quantize as the packing tool does."""
    shN = cloud.shN
    if cloud.sh_degree:
        shN = mini_batch(cloud.shN.reshape(len(cloud), -1), size).reshape(cloud.shN.shape)
    return cloud.replace(
        log_scales=mini_batch(np.maximum(cloud.log_scales, -25), 4096),
        sh0=mini_batch(cloud.sh0.reshape(-1, 1), 256).reshape(-1, 3),
        quats=quaternion_u8.decode(quaternion_u8.encode(cloud.quats, mode="reference")),
        shN=shN,
    )


def measure_conversion(name: str, cloud: GaussianCloud, judge: Judge, size: int | None, repeat: int) -> None:
    presets = gsplat_tools.FORMATS["sog4d"].presets
    cloud = cloud.take(splat_order(cloud, "morton"))
    rows = {f"preset {preset}": dict(options) for preset, options in presets.items()}
    rows[f"balanced, K {size}"] = {"sh_palette_size": size}
    rows["version 2"] = {"version": 2, "sh_palette_size": size}
    for label, options in rows.items():
        seconds, data = best_of(repeat, lambda options=options: encode(cloud, **options))
        rate = f"{len(data):9} bytes {len(data) / len(cloud):6.2f} a splat"
        print(f"{name:24} {label:20} {seconds:7.2f} s {rate}  PSNR {judge(decode(data))}")
    with zipfile.ZipFile(io.BytesIO(encode(cloud, sh_palette_size=size))) as archive:
        parts = " ".join(f"{Path(e.filename).stem} {e.compress_size / len(cloud):.2f}" for e in archive.infolist())
    print(f"{name:24} bytes a splat: {parts}")
    if MiniBatchKMeans is not None:
        start = time.perf_counter()
        other = yardstick(cloud, size or 4096)
        print(f"{name:24} {'yardstick quantizers':20} {time.perf_counter() - start:7.2f} s {'':9}{'':28}PSNR {judge(other)}")


def measure_palette(name: str, cloud: GaussianCloud, size: int, repeat: int) -> None:
    if cloud.sh_degree == 0:
        return
    points = np.ascontiguousarray(cloud.shN.reshape(len(cloud), -1))
    weights = importance(cloud)
    rows = np.sort(np.random.default_rng(0).permutation(len(points))[:SAMPLE_ROWS])
    seconds, centroids = best_of(repeat, lambda: fit_palette(points[rows], np.sqrt(weights[rows]), size=size))
    assigning, (_, distances) = best_of(repeat, lambda: nearest_labels(points, centroids))
    work = 2e-9 * len(points) * size * (points.shape[1] + 1)
    left, right = np.ones((2048, points.shape[1] + 1), np.float32), np.ones((points.shape[1] + 1, size), np.float32)
    multiplying, _ = best_of(repeat, lambda: np.matmul(left, right))
    print(
        f"{name:24} ours            fit {seconds:6.2f} s, labels {assigning:5.2f} s ({work / assigning:5.0f} GFLOP/s; a "
        f"product of the same shape {2e-9 * left.size * size / multiplying:5.0f})  error {distances.mean():.5f}, weighted "
        f"{np.average(distances, weights=weights):.5f}"
    )
    if MiniBatchKMeans is not None:
        start = time.perf_counter()
        errors = ((mini_batch(points, size) - points) ** 2).sum(axis=1)
        print(
            f"{name:24} MiniBatchKMeans fit and labels {time.perf_counter() - start:6.2f} s  error {errors.mean():.5f}, "
            f"weighted {np.average(errors, weights=weights):.5f}"
        )


def measure_order(name: str, cloud: GaussianCloud, size: int | None) -> None:
    for method in ("none", "morton", "hilbert2d"):
        start = time.perf_counter()
        ordered = cloud.take(splat_order(cloud, method, image_layout(len(cloud))))
        seconds = time.perf_counter() - start
        print(f"{name:24} order {method:10} {seconds:6.3f} s {len(encode(ordered, sh_palette_size=size)):9} bytes")


def measure_effort(name: str, cloud: GaussianCloud) -> None:
    cloud = cloud.take(splat_order(cloud, "morton"))
    data = io.BytesIO(encode(cloud, webp_effort=0))
    with zipfile.ZipFile(data) as archive:
        files = [archive.read(entry) for entry in archive.namelist() if entry.endswith(".webp")]
    headers = [_webp.parse_header(file, field="") for file in files]
    images = [_webp.decode_rgba(f, h.width, h.height, field="") for f, h in zip(files, headers, strict=True)]
    for effort in range(10):
        start = time.perf_counter()
        size = sum(len(_webp.encode_rgba(image, effort)) for image in images)
        print(f"{name:24} webp effort {effort} {time.perf_counter() - start:7.2f} s on one thread {size:9} bytes")


def measure_rate(name: str, cloud: GaussianCloud, judge: Judge) -> None:
    cloud = cloud.take(splat_order(cloud, "morton"))
    for scales in (1024, 2048, 4096, 8192, 16384):
        data = encode(cloud, scale_codebook_size=scales)
        print(f"{name:24} scale codebook {scales:6} {len(data):9} bytes PSNR {judge(decode(data))}")
    for size in (512, 1024, 2048, 4096, 8192, 16384) if cloud.sh_degree else ():
        data = encode(cloud, sh_palette_size=size)
        print(f"{name:24} SH palette {size:10} {len(data):9} bytes PSNR {judge(decode(data))}")
    for entries in (64, 96, 128, 192, 256):
        data = encode(cloud, sh0_entries=entries)
        print(f"{name:24} sh0 entries {entries:9} {len(data):9} bytes PSNR {judge(decode(data))}")
    for steps in (32, 48, 64, 96, 127):
        data = encode(cloud, rotation_steps=steps)
        print(f"{name:24} rotation steps {steps:6} {len(data):9} bytes PSNR {judge(decode(data))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--palette", type=int, default=4096)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--parts", default="conversion,palette")
    options = parser.parse_args()
    parts = options.parts.split(",")
    if set(parts) - set(PARTS):
        parser.error(f"parts are {', '.join(PARTS)}")
    warnings.simplefilter("ignore", gsplat_tools.errors.GsplatWarning)
    print(describe_machine())
    scenes = {path.stem: path for path in options.scenes} or {"made": None}
    for name, path in scenes.items():
        cloud = make_scene() if path is None else gsplat_tools.load(path)
        judge = Judge(cloud) if {"conversion", "rate"} & set(parts) else None
        print(f"\n{name}: {len(cloud)} splats, SH degree {cloud.sh_degree}; PSNR of the worst view and on average, dB")
        for part in parts:
            if part == "conversion":
                measure_conversion(name, cloud, judge, options.palette, options.repeat)
            elif part == "palette":
                measure_palette(name, cloud, options.palette, options.repeat)
            elif part == "order":
                measure_order(name, cloud, options.palette)
            elif part == "effort":
                measure_effort(name, cloud)
            else:
                measure_rate(name, cloud, judge)


if __name__ == "__main__":
    main()
