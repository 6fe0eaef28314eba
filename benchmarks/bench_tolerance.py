"""The rate curve of --visual-tolerance: bytes, PSNR and seconds by scene and tolerance, and where the bytes are.

Run: python benchmarks/bench_tolerance.py SCENE.ply ... [--format sog4d] [--tolerances 0,0.02,0.05] [--streams]

The yardstick is the same setting without a tolerance, in the same run. The last line of a scene is the bytes that are
saved where the worst view has lost 0.1 dB, by interpolation between the tolerances that were measured.
"""

from __future__ import annotations

import argparse
import tempfile
import zipfile
from collections import Counter
from pathlib import Path

from machine import describe_machine

from gsplat_tools.formats.loading import load
from gsplat_tools.formats.registry import find_format
from gsplat_tools.formats.saving import save
from gsplat_tools.tuning.measuring import Point, Setting, Workbench

ALLOWED_LOSS = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--format", default="sog4d", choices=["sog4d", "sog"])
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--tolerances", default="0,0.005,0.01,0.02,0.03,0.05,0.1", help="pixels, the first is the yardstick")
    parser.add_argument("--streams", action="store_true", help="profile the files of the first and the last tolerance")
    arguments = parser.parse_args()
    print(describe_machine(), flush=True)
    tolerances = [float(part) for part in arguments.tolerances.split(",")]
    for scene in arguments.scenes:
        measure(scene, tolerances, arguments.format, arguments.preset, arguments.streams)


def measure(scene: Path, tolerances: list[float], name: str, preset: str, shows_streams: bool) -> None:
    """Print the curve of one scene."""
    bench = Workbench(load(scene))
    extension = find_format(name).extensions[0]
    points: list[Point] = []
    print(f"\n{scene.stem}, {name} {preset}")
    print("     px      bytes   ratio   min dB  mean dB    lost   encode")
    with tempfile.TemporaryDirectory() as folder:
        for tolerance in tolerances:
            setting = Setting(format=name, preset=preset, options={"visual_tolerance": tolerance})
            point = bench.measure(setting)
            points.append(point)
            assert point.likeness is not None
            lost = points[0].likeness.level - point.likeness.level
            print(
                f"{tolerance:7.3f} {point.bytes:10,} {point.bytes / points[0].bytes:7.3f} {point.likeness.level:8.2f} "
                f"{point.likeness.psnr_mean or float('inf'):8.2f} {lost:7.2f} {point.encode_seconds:6.1f} s",
                flush=True,
            )
        if shows_streams:
            for tolerance in (tolerances[0], tolerances[-1]):
                path = Path(folder) / f"candidate{extension}"
                report = save(bench.scene, path, overwrite=True, preset=preset, visual_tolerance=tolerance)
                print(f"{tolerance:7.3f} bytes a splat: {streams(path, report.splats * report.frames)}", flush=True)
    print(f"saved at a loss of {ALLOWED_LOSS} dB: {saved_at(points)}", flush=True)


def streams(path: Path, splats: int) -> str:
    """Return the bytes of every stream of an archive, a splat."""
    sizes: Counter[str] = Counter()
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            sizes[Path(entry.filename).stem] += entry.compress_size
    return " ".join(f"{name} {size / splats:.2f}" for name, size in sorted(sizes.items()))


def saved_at(points: list[Point]) -> str:
    """Return the share of bytes that is saved where the loss reaches what is allowed, or the best that was measured."""
    levels = [point.likeness.level if point.likeness else float("nan") for point in points]
    goal = levels[0] - ALLOWED_LOSS
    for before, after, high, low in zip(points, points[1:], levels, levels[1:], strict=False):
        if high >= goal > low:
            size = before.bytes + (after.bytes - before.bytes) * (high - goal) / (high - low)
            tolerance = f"{before.setting.options['visual_tolerance']} to {after.setting.options['visual_tolerance']}"
            return f"{1 - size / points[0].bytes:.1%} (tolerance {tolerance})"
    return f"more than {1 - points[-1].bytes / points[0].bytes:.1%}" if levels[-1] >= goal else "nothing"


if __name__ == "__main__":
    main()
