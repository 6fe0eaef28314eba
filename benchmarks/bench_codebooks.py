"""The engine behind palettes, alone and in whole conversions, against matrix products, scikit-learn and faiss.

Run: python benchmarks/bench_codebooks.py [SCENE.ply[=THEIRS.sog] ...] [--parts targets,engine,palette,curve,order] [--repeat R]

Without scenes the seeded one of bench_sog4d.py is used: 100,000 splats, SH degree 3, 64 materials with noise. Parts:

targets  load, convert and save as `gsplat-convert --no-validate` does, warm, best of R, with processor seconds; SH error of
         .sog against the source, and that of THEIRS
engine   the search for the nearest entry: exact, approximate, and as matrix products, against a product of the same shape
palette  whole palettes of --size entries: error and seconds, against MiniBatchKMeans and faiss where they are installed
curve    seconds of a palette by number of splats, entries and dimensions, with the exponents
order    bytes and seconds of arrangements of the splats (.sog4d), two of which are here alone
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from arrangements import chain_order, hilbert3d_order
from bench_sog4d import encode, make_scene
from machine import describe_machine

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.palette import fit_palette, nearest_labels
from gsplat_tools.codecs.vector_search import one_blas_thread
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats.sog4d.sampling import SAMPLE_ROWS
from gsplat_tools.ops.importance import importance
from gsplat_tools.ops.ordering import image_layout, splat_order
from gsplat_tools.parallel import map_ordered, num_jobs

try:
    from sklearn.cluster import MiniBatchKMeans
except ImportError:
    MiniBatchKMeans = None
try:
    import faiss
except ImportError:
    faiss = None

PARTS = ("targets", "engine", "palette", "curve", "order")

# What is asked of a conversion: target, options, seconds and bytes at most (None: no limit).
TARGETS: dict[str, list[tuple[str, dict[str, Any], float | None, int | None]]] = {
    "made": [
        ("sog4d", {"sh_palette_size": 4096}, 93 / 40, None),
        ("sog", {"sh_palette_size": 65536}, 60, None),
        ("sog", {"sh_palette_size": 65536, "preset": "fast"}, 10, None),
        ("sog", {}, None, None),
    ],
    "playbot_trained_sh3": [("sog4d", {"sh_palette_size": 4096}, 152 / 40, 1_900_110)],
    "fx_alti_sh3_native": [("sog4d", {"sh_palette_size": 4096}, 48.5 / 30, 689_823)],
    "fx_flowers_sh2": [("sog", {}, 72 / 12, 727_042)],
    "statue_massa": [("sog", {}, 2.1 / 2, 757_000), ("sog4d", {}, None, 650_000)],
}


def best_of(repeat: int, work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Return the least seconds and processor seconds of a call after one that does not count, and its result."""
    result = work()
    seconds = processor = np.inf
    for _ in range(repeat):
        start, start_processor = time.perf_counter(), time.process_time()
        result = work()
        seconds = min(seconds, time.perf_counter() - start)
        processor = min(processor, time.process_time() - start_processor)
    return seconds, processor, result


def sh_rows(cloud: GaussianCloud) -> np.ndarray:
    return np.ascontiguousarray(cloud.shN.reshape(len(cloud), -1))


def sh_error(source: GaussianCloud, path: Path) -> str:
    """Mean squared error of the SH of a file, plain and by importance, splats matched by their places."""
    loaded = gsplat_tools.load(path)
    candidate = loaded if isinstance(loaded, GaussianCloud) else loaded.frame(0)
    names, _ = nearest_labels(candidate.means, source.means)
    errors = ((sh_rows(candidate) - sh_rows(source)[names]) ** 2).sum(axis=1)
    return f"SH error {errors.mean():.5f}, weighted {np.average(errors, weights=importance(source)[names]):.5f}"


def measure_targets(name: str, cloud: GaussianCloud, theirs: str, repeat: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "source.ply"
        gsplat_tools.save(cloud, source)
        for extension, options, seconds_asked, bytes_asked in TARGETS.get(
            name, [("sog4d", {}, None, None), ("sog", {}, None, None)]
        ):
            path = Path(folder) / f"target.{extension}"
            seconds, processor, _ = best_of(
                repeat, lambda p=path, o=options: gsplat_tools.save(gsplat_tools.load(source), p, overwrite=True, **o)
            )
            size = path.stat().st_size
            limits = (f" (at most {seconds_asked:.2f})" if seconds_asked else "") + f" {processor:.2f} s of processors,"
            error = sh_error(cloud, path) if cloud.sh_degree else ""
            words = " ".join(f"{key}={value}" for key, value in options.items())
            most = f" (at most {bytes_asked:,})" if bytes_asked else ""
            print(f"{name} -> .{extension} {words}: {seconds:.2f} s{limits} {size:,} bytes{most} {error}", flush=True)
    if theirs:
        print(f"{name}, {Path(theirs).name}: {Path(theirs).stat().st_size:,} bytes {sh_error(cloud, Path(theirs))}")


def product_rate(dimensions: int) -> float:
    """Return GFLOP/s of float32 matrix products of 1,024 x (D + 1) x 1,024 on all processors, one thread each."""
    left, right = np.ones((1024, dimensions + 1), np.float32), np.ones((dimensions + 1, 1024), np.float32)
    count = 200

    def multiply(_: int) -> None:
        np.matmul(left, right)

    def run() -> None:
        with one_blas_thread():
            for _ in map_ordered(multiply, range(count)):
                pass

    return 2e-9 * count * left.size * 1024 / best_of(3, run)[0]


def measure_engine(name: str, cloud: GaussianCloud, repeat: int) -> None:
    points = sh_rows(cloud)
    rate = product_rate(points.shape[1])
    print(f"{name}: products of 1,024 x {points.shape[1] + 1} x 1,024 give {rate:.0f} GFLOP/s on {num_jobs()} threads")
    for size in (1024, 4096, 16384, 65536):
        if 2 * size > len(points) and size > 16384 and len(points) < 1.5 * size:
            continue
        entries = points[np.linspace(0, len(points) - 1, size).astype(np.int64)] * np.float32(0.99)
        flops = 2e-9 * len(points) * size * (points.shape[1] + 1)
        exact = 0.0
        for label, options in (
            ("exact", {}),
            ("64 probes", {"probes": 64}),
            ("16 probes", {"probes": 16}),
            ("4 probes", {"probes": 4}),
        ):
            seconds, _, (_, squares) = best_of(repeat, lambda e=entries, o=options: nearest_labels(points, e, **o))
            error = float(squares.mean(dtype=np.float64))
            exact = exact or error
            print(
                f"{name}: {size:6} entries, {label:10} {seconds:7.3f} s, as many as {flops / seconds:6.0f} GFLOP/s of "
                f"products ({flops / rate:6.3f} s at their rate), error {100 * (error / exact - 1):+6.2f} %",
                flush=True,
            )


def measure_palette(name: str, cloud: GaussianCloud, size: int) -> None:
    points, weights = sh_rows(cloud), importance(cloud)
    rows = np.sort(np.random.default_rng(0).permutation(len(points))[:SAMPLE_ROWS])
    sample = np.ascontiguousarray(points[rows])

    def ours(exponent: float, rounds: int) -> np.ndarray:
        centroids = fit_palette(sample, weights[rows] ** np.float32(exponent), size=size, max_rounds=rounds)
        return nearest_labels(points, centroids)[1]

    def mini_batch() -> np.ndarray:
        model = MiniBatchKMeans(size, batch_size=4096, random_state=0, n_init=1).fit(points)
        return ((model.cluster_centers_[model.predict(points)] - points) ** 2).sum(axis=1)

    def faiss_kmeans() -> np.ndarray:
        model = faiss.Kmeans(points.shape[1], size, niter=10, seed=0, max_points_per_centroid=len(points))
        model.train(points)
        return model.index.search(points, 1)[0][:, 0]

    jobs: list[tuple[str, Callable[[], np.ndarray]]] = [
        ("ours, weight^0.5, 5 rounds", lambda: ours(0.5, 5)),
        ("ours, weight^0.5, 1 round", lambda: ours(0.5, 1)),
        ("ours, no weights, 5 rounds", lambda: ours(0.0, 5)),
        ("ours, no weights, 10 rounds", lambda: ours(0.0, 10)),
    ]
    if MiniBatchKMeans is None:
        print("MiniBatchKMeans: not measured, scikit-learn is not installed (pip install scikit-learn)")
    else:
        jobs.append(("MiniBatchKMeans", mini_batch))
    if faiss is None:
        print("faiss: not measured, not installed (pip install faiss-cpu)")
    else:
        jobs.append(("faiss Kmeans, 10 rounds", faiss_kmeans))
    nearest_labels(points[:4096], points[:4096])  # compilation
    for label, work in jobs:
        start, processor = time.perf_counter(), time.process_time()
        squares = work().astype(np.float64)
        print(
            f"{name}: {size} entries, {label:28} {time.perf_counter() - start:7.2f} s, {time.process_time() - processor:7.2f} "
            f"of processors, error {squares.mean():.5f}, weighted {np.average(squares, weights=weights):.5f}",
            flush=True,
        )


def measure_curve(name: str, cloud: GaussianCloud) -> None:
    points = sh_rows(cloud)
    weights = np.ones(len(points), np.float32)

    def timed(count: int, size: int, dimensions: int) -> float:
        part = np.ascontiguousarray(points[:: max(1, len(points) // count), :dimensions])[:count]
        return best_of(2, lambda: nearest_labels(part, fit_palette(part, weights[: len(part)], size=size)))[1]

    most, full = len(points), points.shape[1]
    for label, values, work in (
        ("N", (most // 8, most // 4, most // 2, most), lambda x: timed(x, 2048, full)),
        ("K", (1024, 2048, 4096, 8192, 16384), lambda x: timed(most, x, full)),
        ("D", (9, 24, 45), lambda x: timed(most, 4096, x)),
    ):
        seconds = [work(value) for value in values]
        exponent = np.polyfit(np.log(values), np.log(seconds), 1)[0]
        row = ", ".join(f"{value}: {second:.2f}" for value, second in zip(values, seconds, strict=True))
        print(f"{name}: processor seconds by {label}: {row}; exponent {exponent:.2f}", flush=True)


def measure_order(name: str, cloud: GaussianCloud) -> None:
    methods: dict[str, Callable[[], np.ndarray]] = {
        "as it was": lambda: splat_order(cloud, "none"),
        "morton": lambda: splat_order(cloud, "morton"),
        "hilbert2d": lambda: splat_order(cloud, "hilbert2d", image_layout(len(cloud))),
        "hilbert in space": lambda: hilbert3d_order(cloud.means),
        "chain of 16": lambda: chain_order(cloud, 16),
        "chain of 64": lambda: chain_order(cloud, 64),
    }
    for label, work in methods.items():
        seconds, _, order = best_of(1, work)
        size = len(encode(cloud.take(order), sh_palette_size=1024))
        print(f"{name}: {label:18} {seconds:6.3f} s {size:9,} bytes {size / len(cloud):7.3f} a splat", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--parts", default="targets,engine,palette,curve")
    parser.add_argument("--size", type=int, default=4096)
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    parts = arguments.parts.split(",")
    if set(parts) - set(PARTS):
        parser.error(f"parts are {', '.join(PARTS)}")
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    for scene in arguments.scenes or ["made"]:
        path, _, theirs = scene.partition("=")
        cloud = make_scene() if scene == "made" else gsplat_tools.load(path)
        assert isinstance(cloud, GaussianCloud)
        name = Path(path).stem
        print(f"\n{name}: {len(cloud):,} splats, SH degree {cloud.sh_degree}")
        for part in parts:
            if part == "targets":
                measure_targets(name, cloud, theirs, arguments.repeat)
            elif part == "order":
                measure_order(name, cloud)
            elif cloud.sh_degree and part == "engine":
                measure_engine(name, cloud, arguments.repeat)
            elif cloud.sh_degree and part == "palette":
                measure_palette(name, cloud, arguments.size)
            elif cloud.sh_degree:
                measure_curve(name, cloud)


if __name__ == "__main__":
    main()
