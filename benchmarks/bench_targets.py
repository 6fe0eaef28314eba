"""--target-psnr against the presets: bytes of the search, and of the smallest preset that reaches the same level.

Run: python benchmarks/bench_targets.py SCENE.ply ... [--to sog4d,sog,spz] [--levels 35,40,45] [--presets fast,balanced,best]
    [--views 8] [--size 640x360] [--auto yes|no|only]

Levels are PSNR of the worst of the automatic views against the source; where no setting reaches one, the ceiling is
printed. What one level measured serves the next. With --auto, also what `--auto` saves against `--preset best`.
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
from gsplat_tools.formats.saving import DEFAULT_PRESET
from gsplat_tools.remembering import remembering
from gsplat_tools.tuning.search import Budget, Searcher

DEFAULT_FORMATS = "sog4d,sog,spz,splat4d,spark,compressed-ply,gscc,splat"


def measure_presets(searcher: Searcher, names: list[str], wanted: float) -> tuple[str, int, float] | None:
    """Return name, bytes and level of the smallest preset that reaches a level.

    Of large scenes, a preset is not encoded after a coarser one that reaches it: finer ones are larger and take minutes.
    """
    reaching: list[tuple[int, str, float]] = []
    for name in names:
        changes = (searcher.whole.record.presets or {DEFAULT_PRESET: {}}).get(name)
        if changes is None or (reaching and searcher.is_large and name == "best"):
            continue
        trial = searcher.whole.encode(changes)
        if trial.level >= wanted:
            reaching.append((trial.bytes, name, trial.level))
    size, name, reached = min(reaching, default=(0, "", 0.0))
    return (name, size, reached) if name else None


def describe(options: dict[str, object]) -> str:
    return " ".join(f"{name}={value:.3g}" if isinstance(value, float) else f"{name}={value}" for name, value in options.items())


def bench_levels(searcher: Searcher, presets: list[str], levels: list[float], name: str) -> None:
    for wanted in levels:
        start = time.perf_counter()
        try:
            found = searcher.find(Budget(min_psnr=wanted))
        except ValidationError as error:
            seconds = time.perf_counter() - start
            print(f"{name} | {wanted:g} | {error.message.split(';')[0]} | none | | | {seconds:.1f} |", flush=True)
            continue
        smallest = measure_presets(searcher, presets, wanted)
        beside, ratio = (
            ("none", "") if smallest is None else (f"{smallest[1]:,} {smallest[0]}", f"{found.bytes / smallest[1]:.3f}")
        )
        print(
            f"{name} | {wanted:g} | {found.bytes:,} | {beside} | {ratio} | {found.psnr_min:.2f} | {found.seconds:.1f} |"
            f" {describe(dict(found.options))} |",
            flush=True,
        )


def bench_auto(searcher: Searcher, name: str) -> None:
    from gsplat_tools.tuning.auto import VISIBLE_PSNR

    usual = searcher.whole.encode(searcher.whole.record.presets.get("best", {}))
    found = searcher.find(Budget(min_psnr=min(usual.level, VISIBLE_PSNR)))
    print(
        f"{name} | auto | {usual.bytes:,} | {usual.level:.2f} | {found.bytes:,} | {found.psnr_min:.2f} |"
        f" {1 - found.bytes / usual.bytes:.0%} | {found.seconds:.1f} |",
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
    parser.add_argument("--auto", choices=("yes", "no", "only"), default="no")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print(describe_machine())
    print("| scene | format | dB asked | bytes | smallest preset that reaches it | ratio | dB | s | options |")
    print("| scene | format | auto | best, bytes | dB | auto, bytes | dB | saved | s |")
    width, height = map(int, arguments.size.split("x"))
    for path in arguments.scenes:
        scene = gsplat_tools.load(path)
        for format_id in arguments.to.split(","):
            record = find_format(format_id)
            name = f"| {path.stem} | {record.id}"
            try:
                with remembering():
                    searcher = Searcher(scene, record, views=arguments.views, size=(width, height))
                    if arguments.auto != "only":
                        levels = [float(each) for each in arguments.levels.split(",")]
                        bench_levels(searcher, arguments.presets.split(","), levels, name)
                    if arguments.auto != "no":
                        bench_auto(searcher, name)
            except GsplatError as error:
                print(f"{name} | {error}", flush=True)


if __name__ == "__main__":
    main()
