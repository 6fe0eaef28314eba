"""Write .sog, .spz and compressed.ply against splat-transform in the same run: seconds, bytes, pictures, and differences.

    scripts/peers
    python benchmarks/bench_interchange.py SCENE.ply [SCENE.ply ...] [--splats 843000] [--repeat 3]

Speed: the first scene's splats, without SH, are tiled to the number asked for, each copy with a little noise, so that
compressors find no repeats that a scene would not have. Ours are warm library calls (`save` and `load`, best of R);
splat-transform's time is the one that it reports for its own work, without a GPU, and whole commands are timed as well.
Pictures: every scene as .sog by both, compared as `gsplat-inspect compare` does. Differences: the largest between what two
readers make of the same file, for the last scene. Files stay in the page cache. About four minutes for three small scenes,
most of it splat-transform's clustering of SH.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine

sys.path.insert(0, str(Path(__file__).parents[1]))

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud, concatenate
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.ops.harmonics import with_sh_degree
from tests.interop import peers
from tests.interop.test_peers import largest_differences

THEIRS = ("scene.sog", "scene.spz", "scene.compressed.ply")
OURS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("scene.sog", {}),
    ("scene.sog", {"preset": "fast"}),
    ("scene.spz", {}),
    ("scene.spz", {"preset": "fast"}),
    ("scene.compressed.ply", {}),
    ("scene.compressed.ply", {"preset": "fast"}),
    ("scene.splat", {}),
)
DIFFERENCES = ("means", "log_scales", "rotations", "opacities", "sh0", "shN")


def main() -> None:
    """Print the three tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--splats", type=int, default=843_000)
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", GsplatWarning)
    print(describe_machine())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compare_speed(read_cloud(arguments.scenes[0]), folder, arguments.splats, arguments.repeat)
        compare_pictures(arguments.scenes, folder, arguments.repeat)
        compare_readers(read_cloud(arguments.scenes[-1]), folder)


def read_cloud(path: Path) -> GaussianCloud:
    """Return the splats of a file."""
    cloud = load(path)
    assert isinstance(cloud, GaussianCloud)
    return cloud


def tiled(cloud: GaussianCloud, splats: int) -> GaussianCloud:
    """Copies side by side, each with noise of a few percent."""
    rng = np.random.default_rng(0)

    def noisy(values: np.ndarray, sigma: float) -> np.ndarray:
        return values + rng.normal(0, sigma, values.shape).astype(np.float32)

    extent = np.ptp(np.percentile(cloud.means, [1, 99], axis=0), axis=0)
    copies = -(-splats // len(cloud))
    side = int(np.ceil(copies ** (1 / 3)))
    cells = np.array(np.unravel_index(np.arange(copies), (side,) * 3)).T
    tiles = [
        cloud.replace(
            means=noisy(cloud.means + (extent * cell).astype(np.float32), 1e-3),
            log_scales=noisy(cloud.log_scales, 0.05),
            quats=noisy(cloud.quats, 0.02),
            opacity_logits=noisy(cloud.opacity_logits, 0.05),
            sh0=noisy(cloud.sh0, 0.02),
        )
        for cell in cells
    ]
    return concatenate(tiles).take(slice(0, splats))


def best_of(repeat: int, function: Callable[[], object]) -> float:
    """Seconds of the fastest call, after one that does not count."""
    function()
    return min(seconds_of(function) for _ in range(repeat))


def seconds_of(function: Callable[[], object]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def run_theirs(source: Path, target: Path) -> tuple[float, float]:
    """Seconds that splat-transform reports for its own work, and those of the whole command."""
    start = time.perf_counter()
    done = subprocess.run([*peers.splat_transform_command(), source, target], capture_output=True, text=True, check=True)
    whole = time.perf_counter() - start
    number, unit = re.findall(r"done in ([0-9.]+) ?(ms|s)", done.stderr + done.stdout)[-1]
    return float(number) / (1000 if unit == "ms" else 1), whole


def run_ours(source: Path, target: Path, *options: str) -> float:
    """Seconds of the whole command."""
    command = [Path(sys.executable).parent / "gsplat-convert", source, target, "--overwrite", "--quiet", *options]
    return seconds_of(lambda: subprocess.run(command, check=True))


def compare_speed(cloud: GaussianCloud, folder: Path, splats: int, repeat: int) -> None:
    """Print seconds and bytes of the tiled scene."""
    scene = tiled(with_sh_degree(cloud, 0), splats)
    source = folder / "source.ply"
    save(scene, source)
    print(f"\nSpeed: {len(scene):,} splats without SH; ratios are of our warm call to splat-transform's own work, and of bytes")
    print(f"{'':38}{'seconds':>9}{'ratio':>7}{'command':>9}{'checked':>9}{'read':>8}{'bytes':>13}{'ratio':>7}")
    reports = {}
    for target in THEIRS:
        path = folder / f"theirs.{target}"
        runs = [run_theirs(source, path) for _ in range(min(repeat, 2))]
        work, whole = min(run[0] for run in runs), min(run[1] for run in runs)
        reports[target] = work, path.stat().st_size
        print(f"{'splat-transform ' + target:38}{work:>9.3f}{'':7}{whole:>9.2f}{'':17}{path.stat().st_size:>13,}")
    for target, options in OURS:
        path = folder / target
        seconds = best_of(repeat, lambda p=path, o=options: save(scene, p, overwrite=True, **o))
        reading = best_of(1, lambda p=path: load(p))
        size = path.stat().st_size
        flags = [word for key, value in options.items() for word in (f"--{key}", str(value))]
        whole, checked = run_ours(source, path, "--no-validate", *flags), run_ours(source, path, *flags)
        work, their_size = reports.get(target, (np.nan, np.nan))
        ratios = f"{seconds / work:>7.2f}", f"{size / their_size:>7.2f}"
        label = " ".join([target, *options.values()])
        print(
            f"{label:38}{seconds:>9.3f}{ratios[0]}{whole:>9.2f}{checked:>9.2f}{reading:>8.3f}{size:>13,}{ratios[1]}", flush=True
        )


def compare_pictures(scenes: list[Path], folder: Path, repeat: int) -> None:
    """Print bytes, seconds and rendered PSNR of .sog files."""
    print("\nPictures: .sog of both, PSNR against the source in dB (8 views, worst and mean)")
    print(f"{'':38}{'seconds':>9}{'command':>9}{'bytes':>11}{'worst':>8}{'mean':>8}{'gain':>14}")
    for scene in scenes:
        source = read_cloud(scene)
        print(f"{scene.name}, {len(source):,} splats, SH degree {source.sh_degree}")
        path = folder / "picture.sog"
        work, whole = run_theirs(scene, path)
        theirs = psnr(source, path)
        print(f"{'  splat-transform':38}{work:>9.2f}{whole:>9.2f}{path.stat().st_size:>11,}{theirs[0]:>8.2f}{theirs[1]:>8.2f}")
        for preset in ("fast", "balanced"):
            seconds = best_of(min(repeat, 2), lambda s=source, t=path, p=preset: save(s, t, preset=p, overwrite=True))
            whole = run_ours(scene, path, "--no-validate", "--preset", preset)
            ours = psnr(source, path)
            gain = f"{ours[0] - theirs[0]:+.2f} {ours[1] - theirs[1]:+.2f}"
            line = f"{'  ours ' + preset:38}{seconds:>9.2f}{whole:>9.2f}{path.stat().st_size:>11,}"
            print(f"{line}{ours[0]:>8.2f}{ours[1]:>8.2f}{gain:>14}", flush=True)


def psnr(source: GaussianCloud, path: Path) -> tuple[float, float]:
    """PSNR of the worst view and the mean, as the model that stands for .sog draws."""
    report = gsplat_tools.compare(source, load(path), model="spark")
    return report.psnr_min or np.inf, report.psnr_mean or np.inf


def compare_readers(cloud: GaussianCloud, folder: Path) -> None:
    """Print the largest difference of every attribute between two readers of the same file."""
    print(f"\nDifferences: {len(cloud):,} splats, SH degree {cloud.sh_degree}; rotations in radians")
    print(f"{'file':18}{'written by':18}{'read by us and':18}" + "".join(f"{name:>11}" for name in DIFFERENCES))
    source, back = folder / "readers.ply", folder / "back.ply"
    save(cloud, source, order="none")

    def theirs(path: Path) -> GaussianCloud:
        peers.splat_transform(path, back)
        return read_cloud(back)

    def row(path: Path, writer: str, reader: str, read: Callable[[Path], GaussianCloud | Mapping[str, np.ndarray]]) -> None:
        differences = largest_differences(read_cloud(path), read(path))
        values = "".join(f"{differences[name]:>11.1e}" for name in DIFFERENCES)
        print(f"{path.name[path.name.index('.') + 1 :]:18}{writer:18}{reader:18}{values}", flush=True)

    for version in (2, 3, 4):
        path = folder / f"a.v{version}.spz"
        save(cloud, path, version=version, order="none")
        row(path, "us", "splat-transform", theirs)
        row(path, "us", "gsply", peers.read_with_gsply)
        row(path, "us", "@adobe/spz", lambda p: peers.read_with_adobe_spz(p, "UNSPECIFIED"))
    for name in ("a.sog", "a.compressed.ply"):
        path = folder / name
        save(cloud, path, order="none")
        row(path, "us", "splat-transform", theirs)
        row(path, "us", "gsply", peers.read_with_gsply)
    # SH is left out of the .sog: clustering it takes splat-transform a minute, and its labels are read above.
    save(with_sh_degree(cloud, 0), folder / "plain.ply", order="none")
    for name in ("a.v4.spz", "a.compressed.ply", "a.sog"):
        path = folder / name.replace("a.", "theirs.", 1)
        peers.splat_transform(folder / "plain.ply" if name == "a.sog" else source, path)
        row(path, "splat-transform", "splat-transform", theirs)
    for version in (3, 4):
        path = folder / f"gsply.v{version}.spz"
        peers.write_spz_with_gsply(source, path, version)
        row(path, "gsply", "gsply", peers.read_with_gsply)


if __name__ == "__main__":
    main()
