"""Every scene to every target, by the command as a user runs it: bytes, seconds, and what rendering says.

    python benchmarks/bench_conversions.py SCENE... [--to ID ...] [--views 4]

Each conversion is a process of its own with compiled kernels on disk; seconds are those of its report (start-up is not
in them). PSNR is of the worst and of the mean view under the target's own model.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import describe_machine

from gsplat_tools.formats.registry import FORMATS

COLUMNS = f"{'scene':32}{'target':16}{'splats':>9}{'bytes':>13}{'B/splat':>9}{'read':>7}{'encode':>8}{'valid.':>8}{'wall s':>8}"


def convert(scene: Path, target: str, folder: Path, views: int) -> dict[str, Any]:
    """Run one conversion and return its report, with the seconds of the whole process as `wall`."""
    path = folder / f"out{FORMATS[target].extensions[0]}"
    command = [
        str(Path(sys.executable).parent / "gsplat-convert"), str(scene), str(path), "--to", target,
        "--views", str(views), "--overwrite", "--json", "--quiet",
    ]  # fmt: skip
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - start
    if done.returncode:
        return {"error": done.stderr.strip()}
    return {**json.loads(done.stdout), "wall": wall}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--to", action="append", choices=list(FORMATS))
    parser.add_argument("--views", type=int, default=4)
    arguments = parser.parse_args()
    print(describe_machine())
    print(f"{COLUMNS}{'PSNR min':>10}{'mean':>8}{'SSIM':>9}  dropped, warnings")
    for scene in arguments.scenes:
        for target in arguments.to or list(FORMATS):
            with tempfile.TemporaryDirectory() as folder:
                report = convert(scene, target, Path(folder), arguments.views)
            if "error" in report:
                print(f"{scene.stem:32}{target:16}  {report['error']}")
                continue
            size, seconds, found = report["target"]["bytes"], report["seconds"], report["validation"]
            level = "identical" if found["psnr_min"] is None else f"{found['psnr_min']:.2f}"
            mean = "" if found["psnr_mean"] is None else f"{found['psnr_mean']:.2f}"
            words = ", ".join([*(f"{k} {v}" for k, v in report["dropped"].items()), *(w["code"] for w in report["warnings"])])
            print(
                f"{scene.stem:32}{target:16}{report['splats']:>9,}{size:>13,}{size / max(report['splats'], 1):>9.2f}"
                f"{seconds['read']:>7.2f}{seconds['encode']:>8.2f}{seconds['validate']:>8.2f}{report['wall']:>8.2f}"
                f"{level:>10}{mean:>8}{found['ssim_mean']:>9.5f}  {words}"
            )


if __name__ == "__main__":
    main()
