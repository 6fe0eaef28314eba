"""What leaving out splats costs: by opacity against by the light that they can add (`prune_faint`), the same number of each.

Run: python benchmarks/bench_faint.py SCENE.ply ... [--shares 0.05,0.1,0.2,0.3]

PSNR of the worst and of the mean of 8 views of 640x360, drawn as a .sog4d is; nothing is encoded.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools import load
from gsplat_tools.formats.registry import find_format
from gsplat_tools.ops.visibility import lit_pixels, viewpoint
from gsplat_tools.tuning.measuring import Workbench


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--shares", default="0.05,0.1,0.2,0.3")
    arguments = parser.parse_args()
    shares = [float(part) for part in arguments.shares.split(",")]
    model = find_format("sog4d").model
    print(describe_machine())
    print("| scene | by | " + " | ".join(f"{share:.0%}" for share in shares) + " |")
    for path in arguments.scenes:
        scene = load(path)
        bench = Workbench(scene, views=8, size=(640, 360))
        keys = {"opacity": scene.opacity_logits, "light": lit_pixels(scene, viewpoint(scene))}
        for name, key in keys.items():
            order = np.argsort(key, kind="stable")
            cells = []
            for share in shares:
                kept = np.sort(order[int(share * len(scene)) :])
                errors = bench.squared_errors([scene.take(kept)], model)
                cells.append(f"{-10 * np.log10(max(errors)):.1f} / {-10 * np.log10(np.mean(errors)):.1f}")
            print(f"| {path.stem} | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
