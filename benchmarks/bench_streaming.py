"""Peak memory and seconds of streaming conversions of a scene far larger than a chunk.

    python benchmarks/bench_streaming.py SCENE.ply [--splats 13600000] [--keep FOLDER]

The scene is tiled on a grid until it has the number of splats asked for, written as PLY, and converted by the command
in a process of its own; peak anonymous memory is sampled from /proc while it runs.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats import load, save


def tiled(cloud: GaussianCloud, splats: int) -> CloudChunks:
    """Copies of a cloud on a cubic grid, `splats` of them."""
    extent = np.ptp(np.percentile(cloud.means, [1, 99], axis=0), axis=0)
    copies = -(-splats // len(cloud))
    side = int(np.ceil(copies ** (1 / 3)))

    def iterate() -> Iterator[GaussianCloud]:
        left = splats
        for cell in itertools.islice(itertools.product(range(side), repeat=3), copies):
            tile = cloud.take(slice(0, min(left, len(cloud))))
            left -= len(tile)
            yield tile.replace(means=tile.means + (extent * cell).astype(np.float32))

    return CloudChunks(splats, cloud.take(slice(0, 0)), iterate)


def run_watched(command: list[str]) -> tuple[float, int, str]:
    """Seconds, peak RssAnon in bytes, and the last line that the command printed."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    peak = 0
    while process.poll() is None:
        try:
            status = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
            peak = max(peak, int(status.split("RssAnon:")[1].split()[0]) * 1024)
        except (OSError, IndexError):
            pass
        time.sleep(0.02)
    assert process.stderr is not None
    words = process.stderr.read().strip().splitlines()
    return time.perf_counter() - start, peak, " | ".join(words[-12:]) if process.returncode else (words or [""])[-1]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splats", type=int, default=13_600_000)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--to", action="append", help="only these targets")
    arguments = parser.parse_args()
    print(describe_machine())
    with tempfile.TemporaryDirectory(dir=arguments.keep) as folder:
        source = Path(folder) / "tiled.ply"
        cloud = load(arguments.scene)
        assert isinstance(cloud, GaussianCloud)
        start = time.perf_counter()
        report = save(tiled(cloud, arguments.splats), source)
        seconds = time.perf_counter() - start
        print(f"{report.splats:,} splats of SH degree {report.sh_degree}, {report.bytes:,} bytes, tiled in {seconds:.1f} s")
        print(f"{'target':30}{'seconds':>10}{'peak MB':>10}{'bytes':>16}")
        for name, extra in (
            ("spark", ["--no-validate"]),
            ("spark", []),
            ("uncompressed", ["--no-validate"]),
            ("uncompressed", []),
            ("gscc", ["--no-validate", "--source-coordinates", "RUB"]),
            ("ply", ["--no-validate"]),
        ):
            if arguments.to and name not in arguments.to:
                continue
            target = Path(folder) / "out.bin"
            command = [
                str(Path(sys.executable).parent / "gsplat-convert"), str(source), str(target), "--to", name,
                "--overwrite", "--no-progress", *extra,
            ]  # fmt: skip
            seconds, peak, words = run_watched(command)
            label = name + ("" if extra else " with validation")
            size = target.stat().st_size if target.exists() else 0
            print(f"{label:30}{seconds:>10.1f}{peak / 1e6:>10.0f}{size:>16,}  {words}")


if __name__ == "__main__":
    main()
