"""A .sog4d sequence against the sum of its single frames: bytes by kind, seconds, PSNR per frame, peak memory.

    python benchmarks/bench_sequence.py SCENE.ply [--splats 60000] [--frames 60] [--memory 10,100,500]

The scene is cropped to splats that lie together and set in motion: every splat drifts with the part of the scene that it
belongs to, one in twenty fades in or out, and one in a hundred changes its SH on its way. Frames are made when they are
asked for, so that memory is the encoder's. Each memory figure is a process of its own.
"""

from __future__ import annotations

import argparse
import io
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
from machine import describe_machine

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import compare
from gsplat_tools.formats import load
from gsplat_tools.formats.sog4d import Sog4dOptions, Sog4dReadOptions, read, write
from gsplat_tools.ops.ordering import splat_order
from gsplat_tools.sequence import GaussianSequence

FADING, CHANGING = 20, 100
"""One splat in so many."""


def moving(cloud: GaussianCloud, frames: int, seed: int = 0) -> GaussianSequence:
    """The cloud in motion over `frames` frames; splat i stays splat i."""
    rng = np.random.default_rng(seed)
    count = len(cloud)
    extent = float(np.ptp(np.percentile(cloud.means, [5, 95], axis=0), axis=0).max())
    phase = (cloud.means @ rng.normal(size=(3, 3)).astype(np.float32)) * (4 / extent)
    fading, changing = rng.permutation(count)[: count // FADING], rng.permutation(count)[: count // CHANGING]
    shift = rng.normal(0, 0.1, (len(changing), *cloud.shN.shape[1:])).astype(np.float32)

    def frame(i: int) -> GaussianCloud:
        t = i / max(frames - 1, 1)
        drift = 0.02 * extent * (np.sin(phase + 2 * np.pi * t) - np.sin(phase))
        logits = cloud.opacity_logits.copy()
        logits[fading] -= np.float32(8 * abs(np.sin(np.pi * t)))
        shN = cloud.shN.copy()
        shN[changing] += shift * np.float32(t)
        return cloud.replace(means=cloud.means + drift.astype(np.float32), opacity_logits=logits, shN=shN)

    return GaussianSequence(frame, num_splats=count, sh_degree=cloud.sh_degree, num_frames=frames)


def crop(cloud: GaussianCloud, splats: int) -> GaussianCloud:
    """Splats that lie together, in Morton order."""
    ordered = cloud.take(splat_order(cloud, "morton"))
    start = max(0, (len(ordered) - splats) // 2)
    return ordered.take(slice(start, start + splats))


def bytes_by_kind(bundle: bytes) -> Counter[str]:
    """Stored bytes of a bundle by the kind of entry."""
    kinds: Counter[str] = Counter()
    with zipfile.ZipFile(io.BytesIO(bundle)) as archive:
        for entry in archive.infolist():
            kinds[Path(entry.filename).name] += entry.compress_size
    kinds["zip"] = len(bundle) - sum(kinds.values())
    return kinds


def encode(scene: GaussianSequence | GaussianCloud) -> tuple[bytes, float]:
    stream = io.BytesIO()
    start = time.perf_counter()
    write(scene, stream, Sog4dOptions())
    return stream.getvalue(), time.perf_counter() - start


def measure_memory(scene: Path, splats: int, frames: int) -> None:
    """Write a sequence to a file and print peak memory in MB."""
    cloud = load(scene)
    assert isinstance(cloud, GaussianCloud)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    with tempfile.TemporaryFile() as stream:
        write(moving(crop(cloud, splats), frames), stream, Sog4dOptions())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{frames:>6}{peak / 1024:>12.0f}{(peak - before) / 1024:>14.0f}{time.perf_counter() - start:>10.1f}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splats", type=int, default=60_000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--memory", default="10,100,500")
    parser.add_argument("--memory-splats", type=int, default=20_000)
    parser.add_argument("--only-memory", type=int)
    arguments = parser.parse_args()
    if arguments.only_memory:
        measure_memory(arguments.scene, arguments.memory_splats, arguments.only_memory)
        return
    print(describe_machine())
    cloud = load(arguments.scene)
    assert isinstance(cloud, GaussianCloud)
    sequence = moving(crop(cloud, arguments.splats), arguments.frames)
    encode(sequence.frame(0))  # compiles
    bundle, seconds = encode(sequence)
    singles = [encode(sequence.frame(i)) for i in range(len(sequence))]
    total, kinds = len(bundle), bytes_by_kind(bundle)
    sum_total, sum_kinds = sum(len(b) for b, _ in singles), Counter[str]()
    for one, _ in singles:
        sum_kinds += bytes_by_kind(one)
    payload, sum_payload = (sum(n for name, n in k.items() if name not in ("meta.json", "zip")) for k in (kinds, sum_kinds))
    print(f"{len(sequence)} frames of {sequence.num_splats:,} splats, SH degree {sequence.sh_degree}")
    print(f"{'':34}{'sequence':>14}{'sum of frames':>16}{'ratio':>8}")
    rows = [("all bytes", total, sum_total), ("images, palettes, deltas", payload, sum_payload)]
    rows += [(name, kinds[name], sum_kinds[name]) for name in sorted(kinds | sum_kinds)]
    for name, ours, theirs in rows:
        print(f"{name:34}{ours:>14,}{theirs:>16,}{ours / theirs if theirs else float('nan'):>8.2f}")
    print(f"{'bytes a frame':34}{total / len(sequence):>14,.0f}{sum_total / len(sequence):>16,.0f}")
    print(f"{'seconds a frame':34}{seconds / len(sequence):>14.2f}{sum(s for _, s in singles) / len(sequence):>16.2f}")
    decoded = read(io.BytesIO(bundle), Sog4dReadOptions())
    print(f"\n{'frame':>6}{'sequence dB':>13}{'single dB':>11}   (PSNR of the worst of 2 views, unity fork-4d)")
    levels = []
    for i in range(0, len(sequence), max(1, len(sequence) // 12)):
        alone = read(io.BytesIO(singles[i][0]), Sog4dReadOptions()).frame(0)
        pair = [
            compare(sequence.frame(i), other, views=2, size=(320, 180), model="unity", variant="fork-4d").psnr_min
            for other in (decoded.frame(i), alone)
        ]
        levels.append(pair)
        print(f"{i:>6}{pair[0]:>13.2f}{pair[1]:>11.2f}")
    print(f"{'mean':>6}{np.mean([a for a, _ in levels]):>13.2f}{np.mean([b for _, b in levels]):>11.2f}")
    print(f"\npeak memory, frames of {arguments.memory_splats:,} splats")
    print(f"{'frames':>6}{'peak MB':>12}{'above start':>14}{'seconds':>10}")
    for frames in arguments.memory.split(","):
        command = [sys.executable, __file__, str(arguments.scene), "--only-memory", frames]
        subprocess.run([*command, "--memory-splats", str(arguments.memory_splats)], check=True)


if __name__ == "__main__":
    main()
