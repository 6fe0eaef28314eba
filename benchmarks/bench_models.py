"""One asset drawn as four targets: how far do models that are each right differ by design?

python benchmarks/bench_models.py SCENE... [--views 8] [--size 640x360]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats import load
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.image_metrics import compare_images
from gsplat_tools.reference.rasterizer import render

MODELS = ("inria", "unity", "spark", "visionary")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", default="640x360")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    print(describe_machine())
    for scene in arguments.scenes:
        cloud = load(scene)
        assert isinstance(cloud, GaussianCloud)
        cameras = auto_cameras(cloud, views=arguments.views, size=(width, height))
        images = {model: [render(cloud, camera, model=model).image for camera in cameras] for model in MODELS}
        print(f"\n{scene.stem}: PSNR in dB, lowest / mean over {arguments.views} views of {width}x{height}")
        print(f"{'':12}" + "".join(f"{model:>18}" for model in MODELS[1:]))
        for row, first in enumerate(MODELS[:-1]):
            cells = [f"{'':>18}"] * row
            for second in MODELS[row + 1 :]:
                levels = [compare_images(a, b).psnr or np.inf for a, b in zip(images[first], images[second], strict=True)]
                cells.append(f"{min(levels):>9.2f} /{np.mean(levels):>7.2f}")
            print(f"{first:12}" + "".join(cells))


if __name__ == "__main__":
    main()
