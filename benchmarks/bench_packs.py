"""Pack and unpack splats in Spark's layout, against numpy, and against Spark's own encoder in node where it is installed.

Run: python benchmarks/bench_packs.py [--splats N] [--repeat R]

Spark's encoder takes part after `npm ci` in tools/golden_spark. Times are the best of R; first runs (compilation) are left out.
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import quaternion_u8
from gsplat_tools.formats import FORMATS
from gsplat_tools.formats.pack import spark, uncompressed

SPARK = Path(__file__).parents[1] / "tools" / "golden_spark"
NODE = """
import { setPackedSplat, utils } from "@sparkjsdev/spark";
const n = 200000, a = new Float32Array(n * 14), p = new Uint32Array(n * 4), w = new Uint32Array(n * 4), sh = new Float32Array(45);
for (let i = 0; i < a.length; i++) a[i] = Math.sin(i * 12.9898) * 0.5 + 0.5;
for (let i = 0; i < 45; i++) sh[i] = Math.sin(i);
const best = (f) => { let t = 1e9; for (let k = 0; k < 7; k++) { const s = performance.now(); f(); t = Math.min(t, performance.now() - s); } return n / t * 1e3; };
const pack = () => { for (let i = 0, j = 0; i < n; i++, j += 14) setPackedSplat(p, i, a[j], a[j+1], a[j+2], a[j+3], a[j+4], a[j+5], a[j+6], a[j+7], a[j+8], a[j+9], a[j+10], a[j+11], a[j+12], a[j+13]); };
const bands = () => { w.fill(0); for (let i = 0; i < n; i++) { utils.encodeSh1Rgb(w, i >> 1, sh); utils.encodeSh2Rgb(w, i, sh); utils.encodeSh3Rgb(w, i, sh); } };
console.log(best(pack), best(bands));
"""  # noqa: E501


def make_cloud(count: int, degree: int) -> GaussianCloud:
    rng = np.random.default_rng(0)

    def normal(*shape: int, scale: float = 1.0, center: float = 0.0) -> np.ndarray:
        return rng.standard_normal(shape, np.float32) * np.float32(scale) + np.float32(center)

    return GaussianCloud(
        means=normal(count, 3, scale=5),
        log_scales=normal(count, 3, center=-5),
        quats=normal(count, 4),
        opacity_logits=normal(count, scale=3),
        sh0=normal(count, 3, scale=0.7),
        shN=normal(count, (degree + 1) ** 2 - 1, 3, scale=0.15),
    )


def numpy_words(cloud: GaussianCloud) -> np.ndarray:
    """The same words in vectorized numpy: the yardstick."""

    def rounded(values: np.ndarray) -> np.ndarray:
        return np.floor(values + 0.5)

    color = np.clip(rounded((cloud.sh0.astype(np.float64) * 0.28209479177387814 + 0.5) * 255), 0, 255).astype(np.uint32)
    alpha = rounded(255 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))).astype(np.uint32)
    q = cloud.quats.astype(np.float64)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q *= np.where(q[:, :1] < 0, -1, 1)
    axis = q[:, 1:] / np.abs(q[:, 1:]).sum(axis=1, keepdims=True)
    p = axis[:, :2]
    p = np.where(axis[:, 2:] < 0, (1 - np.abs(p[:, ::-1])) * np.where(p >= 0, 1, -1), p)
    uv = rounded((p / 2 + 0.5) * 255).astype(np.uint32)
    angle = rounded(2 * np.arccos(np.minimum(q[:, 0], 1)) * (255 / np.pi)).astype(np.uint32)
    scales = (np.clip(rounded((cloud.log_scales.astype(np.float64) + 12) * (254 / 21)), 0, 254) + 1).astype(np.uint32)
    half = cloud.means.astype(np.float16).view(np.uint16).astype(np.uint32)
    return np.stack(
        [
            color[:, 0] | color[:, 1] << 8 | color[:, 2] << 16 | alpha << 24,
            half[:, 0] | half[:, 1] << 16,
            half[:, 2] | uv[:, 0] << 16 | uv[:, 1] << 24,
            scales[:, 0] | scales[:, 1] << 8 | scales[:, 2] << 16 | angle << 24,
        ],
        axis=1,
    )


def best_seconds(function: Callable[[], object], repeat: int) -> float:
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def node_rates() -> tuple[float, float] | None:
    if shutil.which("node") is None or not (SPARK / "node_modules").is_dir():
        return None
    script = ["node", "--input-type=module", "-e", NODE]
    done = subprocess.run(script, cwd=SPARK, capture_output=True, text=True, check=False)
    return (float(done.stdout.split()[0]), float(done.stdout.split()[1])) if done.returncode == 0 else None


def written(cloud: GaussianCloud, layout: str, **options: object) -> io.BytesIO:
    stream = io.BytesIO()
    record = FORMATS[layout]
    assert record.write is not None
    record.write(cloud, stream, record.write_options(**options))
    return stream


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=7)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    count, repeat = given.splats, given.repeat
    plain, full = make_cloud(count, 0), make_cloud(count, 3)
    expected = numpy_words(plain)
    assert (spark.encode(plain).packed == expected).mean() > 0.99999, "the yardstick computes something else"

    yardstick = count / best_seconds(lambda: numpy_words(plain), min(repeat, 3))
    node = node_rates()
    pack, arrays = spark.encode(full), uncompressed.encode(full)
    rows: list[tuple[str, float]] = [("numpy, 16 bytes", yardstick)]
    if node is not None:
        rows += [("Spark in node, 16 bytes", node[0]), ("Spark in node, SH bands 1-3", node[1])]
    rows += [
        (f"encode {rotation}, 16 bytes", count / best_seconds(lambda r=rotation: spark.encode(plain, rotation=r), repeat))
        for rotation in ("reference", "small", "best")
    ]
    rows += [
        (f"encode {rotation}, degree 3", count / best_seconds(lambda r=rotation: spark.encode(full, rotation=r), repeat))
        for rotation in ("reference", "best")
    ]
    rows += [
        ("decode, degree 3", count / best_seconds(lambda: spark.decode(pack), repeat)),
        ("uncompressed encode, degree 3", count / best_seconds(lambda: uncompressed.encode(full), repeat)),
        ("uncompressed decode, degree 3", count / best_seconds(lambda: uncompressed.decode(arrays), repeat)),
        ("quaternion bytes, best scale", count / best_seconds(lambda: quaternion_u8.encode(plain.quats), repeat)),
    ]
    for layout in ("spark", "uncompressed"):
        for codec in ("none", "zstd"):
            stream = written(full, layout, codec=codec)
            rows += [
                (
                    f"write {layout} {codec}, degree 3",
                    count / best_seconds(lambda a=layout, c=codec: written(full, a, codec=c), 3),
                ),
                (f"read {layout} {codec}, degree 3", count / best_seconds(lambda s=stream: FORMATS["spark"].read(s, None), 3)),
            ]
    print(f"{count} splats, {describe_machine()}\n")
    print(f"{'what':34}{'M splats/s':>12}{'x numpy':>9}")
    for name, rate in rows:
        print(f"{name:34}{rate / 1e6:12.2f}{rate / yardstick:9.1f}")


if __name__ == "__main__":
    main()
