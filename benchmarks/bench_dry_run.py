"""Estimates of `gsplat-convert --dry-run` against what the conversions then give, on every scene and target.

    python benchmarks/bench_dry_run.py SCENE... [--to ID ...]

Ratios are estimate / real; PSNR differences in dB, two views of 320x180 as `gsplat-convert` validates.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools import load
from gsplat_tools.errors import GsplatError, GsplatWarning
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.tuning.measuring import Setting, Workbench
from gsplat_tools.tuning.prediction import predict

VIEWS, SIZE = 2, (320, 180)
WIDTHS = (12, 8, 10, 8, 10, 7, 11)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--to", action="append", choices=list(FORMATS))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    names = ("bytes", "ratio", "encode s", "ratio", "PSNR min", "diff", "dry-run s")
    print(f"{'scene':28}{'target':16}" + "".join(f"{name:>{width}}" for name, width in zip(names, WIDTHS, strict=True)))
    sizes, levels = list[float](), list[float]()
    for path in arguments.scenes:
        scene = load(path)
        for target in arguments.to or [name for name, record in FORMATS.items() if record.write and record.read]:
            setting = Setting(format=target)
            try:
                start = time.perf_counter()
                guess = predict(scene, setting, views=VIEWS, size=SIZE)
                spent = time.perf_counter() - start
                bench = Workbench(scene, views=VIEWS, size=SIZE)
                real = bench.measure(setting)
            except GsplatError as error:
                print(f"{path.stem:28}{target:16}  {error}")
                continue
            assert real.likeness is not None
            level = real.likeness.psnr_min
            off = None if level is None or guess.psnr_min is None else guess.psnr_min - level
            if not guess.is_exact:
                sizes.append(guess.bytes / real.bytes)
                levels += [] if off is None else [off]
            print(
                f"{path.stem:28}{target:16}{real.bytes:>12,}{guess.bytes / real.bytes:>8.3f}{real.encode_seconds:>10.2f}"
                f"{guess.encode_seconds / real.encode_seconds:>8.2f}{'-' if level is None else f'{level:.2f}':>10}"
                f"{'-' if off is None else f'{off:+.2f}':>7}{spent:>11.2f}{'  whole' if guess.is_exact else ''}"
            )
    if sizes:
        away = np.abs(np.array(sizes) - 1)
        print(f"bytes of estimates: off by {away.mean():.1%} on average, {away.max():.1%} at most")
    if levels:
        print(f"PSNR of estimates: off by {np.mean(np.abs(levels)):.2f} dB on average, {np.max(np.abs(levels)):.2f} at most")


if __name__ == "__main__":
    main()
