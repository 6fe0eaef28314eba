"""--target-psnr against the presets: bytes of the search, and of the smallest preset that reaches the same level.

Run: python benchmarks/bench_targets.py SCENE.ply ... [--to sog4d,sog,spz] [--levels 35,40,45] [--presets fast,balanced,best]
    [--views 8] [--size 640x360] [--auto]

Levels are PSNR of the worst of the automatic views against the source; where no setting reaches one, the ceiling is
printed. Seconds of a search include what levels before it measured. With --auto, what `--auto` saves against
`--preset best`.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

from machine import describe_machine

import gsplat_tools
from gsplat_tools.errors import GsplatError, ValidationError
from gsplat_tools.formats.registry import find_format
from gsplat_tools.remembering import remembering
from gsplat_tools.tuning.search import Budget, Searcher
from gsplat_tools.tuning.trials import Trials

DEFAULT_FORMATS = "sog4d,sog,spz,splat4d,spark,compressed-ply,gscc,splat"


def measure_presets(searcher: Searcher, presets: list[str]) -> dict[str, tuple[int, float]]:
    """Return bytes and level of every preset."""
    found = {}
    for preset in presets:
        if preset in searcher.whole.record.presets:
            trials = Trials(searcher.whole.bench, searcher.whole.record, preset, {})
            trial = trials.encode({})
            found[preset] = trial.bytes, trial.level
    return found


def describe(options: dict[str, object]) -> str:
    return " ".join(f"{name}={value:.3g}" if isinstance(value, float) else f"{name}={value}" for name, value in options.items())


def bench_levels(searcher: Searcher, presets: dict[str, tuple[int, float]], levels: list[float], name: str) -> None:
    for wanted in levels:
        reaching = {preset: size for preset, (size, reached) in presets.items() if reached >= wanted}
        smallest = min(reaching, key=lambda preset: reaching[preset], default=None)
        beside = "| none |" if smallest is None else f"| {reaching[smallest]:,} {smallest} |"
        start = time.perf_counter()
        try:
            found = searcher.find(Budget(min_psnr=wanted))
        except ValidationError as error:
            print(
                f"{name} | {wanted:g} | {error.message.split(';')[0]} {beside} | | {time.perf_counter() - start:.1f} |",
                flush=True,
            )
            continue
        ratio = "" if smallest is None else f"{found.bytes / reaching[smallest]:.2f}"
        print(
            f"{name} | {wanted:g} | {found.bytes:,} {beside} {ratio} | {found.psnr_min:.2f} | {found.seconds:.1f} |"
            f" {describe(dict(found.options))} |",
            flush=True,
        )


def bench_auto(searcher: Searcher, presets: dict[str, tuple[int, float]], name: str) -> None:
    from gsplat_tools.tuning.auto import VISIBLE_PSNR

    size, reached = presets["best"]
    found = searcher.find(Budget(min_psnr=min(reached, VISIBLE_PSNR)))
    print(
        f"{name} | {size:,} | {reached:.2f} | {found.bytes:,} | {found.psnr_min:.2f} | {1 - found.bytes / size:.0%} |"
        f" {found.seconds:.1f} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--to", default=DEFAULT_FORMATS)
    parser.add_argument("--levels", default="35,40,45")
    parser.add_argument("--presets", default="fast,balanced,best")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--auto", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print(describe_machine())
    if arguments.auto:
        print("| scene | format | best, bytes | dB | auto, bytes | dB | saved | s |")
    else:
        print("| scene | format | dB asked | bytes | smallest preset that reaches it | ratio | dB | s | options |")
    width, height = map(int, arguments.size.split("x"))
    for path in arguments.scenes:
        scene = gsplat_tools.load(path)
        for format_id in arguments.to.split(","):
            record = find_format(format_id)
            name = f"| {path.stem} | {record.id}"
            try:
                with remembering():
                    searcher = Searcher(scene, record, views=arguments.views, size=(width, height))
                    presets = measure_presets(searcher, ["best"] if arguments.auto else arguments.presets.split(","))
                    if arguments.auto:
                        bench_auto(searcher, presets, name)
                    else:
                        bench_levels(searcher, presets, [float(each) for each in arguments.levels.split(",")], name)
            except GsplatError as error:
                print(f"{name} | {error}", flush=True)


if __name__ == "__main__":
    main()
