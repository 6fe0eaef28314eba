"""Every preset of every target on one scene of each class, as the rows of docs/tradeoffs.md.

    python benchmarks/bench_presets.py SCENE... [--to ID ...]

Bytes a splat, PSNR of the worst of four views of 480x270 against the source under the target's own model, and seconds to
encode and decode, each the median of three runs with compiled kernels.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from machine import describe_machine

from gsplat_tools import load
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.tuning.tradeoff import measure_tradeoff


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--to", action="append", choices=list(FORMATS))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    for path in arguments.scenes:
        scene = load(path)
        splats = len(scene) if isinstance(scene, GaussianCloud) else scene.num_splats
        print(f"\n{path.stem}, {splats:,} splats, SH degree {scene.sh_degree}\n")
        print("| target | preset | bytes a splat | PSNR min / mean dB | encode s | decode s |")
        print("|---|---|---|---|---|---|")
        found = measure_tradeoff(scene, formats=arguments.to or ())
        for point in found.points:
            if point.setting.options or point.likeness is None:
                continue
            likeness = point.likeness
            level = "identical" if likeness.psnr_min is None else f"{likeness.psnr_min:.1f} / {likeness.psnr_mean:.1f}"
            print(
                f"| {point.setting.format} | {point.setting.preset} | {point.bytes_per_splat:.2f} | {level} "
                f"| {point.encode_seconds:.3f} | {point.decode_seconds:.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
