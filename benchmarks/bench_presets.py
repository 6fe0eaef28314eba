"""Every preset of every target on one scene of each class: the table of docs/tradeoffs.md.

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
    heads, rows = list[str](), dict[tuple[str, str], dict[int, str]]()
    for column, path in enumerate(arguments.scenes):
        scene = load(path)
        splats = len(scene) if isinstance(scene, GaussianCloud) else scene.num_splats
        heads.append(f"{path.stem}, {splats:,}: bytes a splat | PSNR min / mean, dB | encode / decode, s")
        for point in measure_tradeoff(scene, formats=arguments.to or ()).points:
            if point.setting.options or point.likeness is None:
                continue
            likeness = point.likeness
            level = "identical" if likeness.psnr_min is None else f"{likeness.psnr_min:.1f} / {likeness.psnr_mean:.1f}"
            cells = f"{point.bytes_per_splat:.2f} | {level} | {point.encode_seconds:.3f} / {point.decode_seconds:.3f}"
            rows.setdefault((point.setting.format, point.setting.preset), {})[column] = cells
    print(describe_machine())
    print(f"| target | preset | {' | '.join(heads)} |")
    print("|" + "---|" * (2 + 3 * len(heads)))
    for (target, preset), cells in rows.items():
        print(f"| {target} | {preset} | {' | '.join(cells.get(column, ' | | ') for column in range(len(heads)))} |")


if __name__ == "__main__":
    main()
