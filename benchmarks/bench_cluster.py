"""What tasks cost: seconds a frame against one machine's path, one and two workers, and a model of large clusters.

    python benchmarks/bench_cluster.py SCENE.ply [--splats 20000] [--frames 64] [--repeats 2]

Each task has one thread. Workers are warm: a short sequence is converted before the clock starts. The model takes seconds
and bytes a splat from the run with one worker, predicts two workers, and then 10^4 frames of 10^6 splats.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench_sequence import crop, moving
from machine import describe_machine

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.cluster.engines import open_engine
from gsplat_tools.cluster.sequences import convert_sequence
from gsplat_tools.convert import convert
from gsplat_tools.formats import load
from gsplat_tools.formats.saving import save
from gsplat_tools.parallel import use_jobs

SEGMENT = 32
CORES, PRICE, NETWORK, STORE_CONNECTION = 32, 1.43, 25e9 / 8, 90e6
"""Of a node: cores, dollars an hour, bytes a second; and bytes a second of one stream to or from a store (assumed)."""

GET, PUT = 0.4e-6, 5e-6
"""Dollars a request of an object store, inside one region (assumed; bytes are free there)."""


@dataclass(frozen=True)
class Costs:
    """What was measured with one worker, a splat of a frame; seconds of one core."""

    look: float
    encode: float
    fit: float
    assemble: float
    source: float
    bundle: float
    passes: int

    @staticmethod
    def of(cluster: dict[str, Any], frames: int, splats: int, size: int) -> Costs:
        stages, count = cluster["stages"], frames * splats
        look = sum(stages[name]["task_seconds"] for name in ("identify", "look"))
        # The stage "fit" waits for the samples, which are tasks too.
        draw = max(0.0, stages["fit"]["seconds"] - stages["fit"]["task_seconds"])
        return Costs(
            look=(look + draw) / count,
            encode=stages["encode"]["task_seconds"] / count,
            fit=stages["fit"]["task_seconds"],
            assemble=stages["assemble"]["seconds"] / size,
            source=stages["look"]["bytes_read"] / count,
            bundle=size / count,
            passes=3,
        )

    def seconds(self, frames: int, splats: int, workers: int, *, nodes: int = 0) -> dict[str, float]:
        """Return seconds of each stage; with nodes, no faster than their network allows."""
        count = frames * splats
        segments = math.ceil(frames / SEGMENT)
        rounds = math.ceil(segments / workers)
        wire = (lambda passes: passes * count * self.source / (nodes * NETWORK)) if nodes else (lambda _passes: 0.0)
        return {
            "look, draw": max(count * self.look / min(workers, frames), wire(2)),
            "fit": self.fit,
            "encode": max(rounds * min(SEGMENT, frames) * splats * self.encode, wire(1)),
            "assemble": count * self.bundle * (2 / STORE_CONNECTION if nodes else self.assemble),
        }


def measure(pattern: str, warm: str, scheduler: str, folder: Path, repeats: int) -> tuple[float, dict[str, Any]]:
    """Return the seconds of the best run, and its report."""
    if scheduler == "convert":
        best = math.inf
        with use_jobs(1):
            convert([warm], folder / "warm.sog4d", validation=None, overwrite=True)
            for _ in range(repeats):
                start = time.perf_counter()
                convert([pattern], folder / "out.sog4d", validation=None, overwrite=True)
                best = min(best, time.perf_counter() - start)
        return best, {}
    engine = open_engine(scheduler, 1)
    try:
        convert_sequence([warm], folder / "warm.sog4d", engine, validation=None, overwrite=True, delta_segment_length=2)
        runs = []
        for _ in range(repeats):
            start = time.perf_counter()
            report = convert_sequence([pattern], folder / "out.sog4d", engine, validation=None, overwrite=True)
            runs.append((time.perf_counter() - start, report.to_json()))
    finally:
        engine.close()
    return min(runs, key=lambda each: each[0])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    print(describe_machine())
    cloud = load(arguments.scene)
    assert isinstance(cloud, GaussianCloud)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part, frames in (("frames", arguments.frames), ("warm", 4)):
            (folder / part).mkdir()
            sequence = moving(crop(cloud, arguments.splats), frames)
            for index in range(frames):
                save(sequence.frame(index), folder / part / f"{index}.ply")
        pattern, warm = (str(folder / part / "*.ply") for part in ("frames", "warm"))
        print(
            f"{arguments.frames} frames of {arguments.splats:,} splats, SH degree {cloud.sh_degree}; no checks, 1 thread a task"
        )
        print(f"{'':18}{'seconds':>9}{'ms a frame':>12}{'over convert':>14}{'to convert':>12}")
        reports: dict[str, dict[str, Any]] = {}
        seconds: dict[str, float] = {}
        for scheduler in ("convert", "local", "local:1", "local:2", "local-cluster:1", "local-cluster:2"):
            seconds[scheduler], reports[scheduler] = measure(pattern, warm, scheduler, folder, arguments.repeats)
            each, base = seconds[scheduler], seconds["convert"]
            over = 1000 * (each - base) / arguments.frames
            print(
                f"{scheduler:18}{each:>9.2f}{1000 * each / arguments.frames:>12.1f}{over:>11.1f} ms{each / base:>12.2f}",
                flush=True,
            )
    for kind in ("local", "local-cluster"):
        print(f"{kind}: two workers are {seconds[f'{kind}:1'] / seconds[f'{kind}:2']:.2f} times as fast as one")
    one, two = reports["local-cluster:1"], reports["local-cluster:2"]
    costs = Costs.of(one["cluster"], arguments.frames, arguments.splats, one["target"]["bytes"])
    print(f"\none worker, a splat of a frame: look and draw {1e6 * costs.look:.2f} us, encode {1e6 * costs.encode:.2f} us")
    print(f"{costs.source:.0f} bytes read {costs.passes} times, {costs.bundle:.2f} written; codebooks {costs.fit:.1f} s")
    print(f"\n{'model':24}{'look, draw':>12}{'fit':>8}{'encode':>10}{'assemble':>10}{'sum s':>10}{'measured':>10}")
    for workers, report in ((1, one), (2, two)):
        predicted = costs.seconds(arguments.frames, arguments.splats, workers)
        measured = sum(stage["seconds"] for stage in report["cluster"]["stages"].values())
        row(f"{workers} here", predicted, f"{measured:>10.1f}")
    frames, splats = 10_000, 1_000_000
    requests = frames * (costs.passes + 1) * math.ceil(splats * costs.source / (8 << 20)) * GET + frames / SEGMENT * 40 * PUT
    for nodes in (1, 10, 100):
        predicted = costs.seconds(frames, splats, nodes * CORES, nodes=nodes)
        hours = sum(predicted.values()) / 3600
        row(f"10^4 x 10^6, {nodes} nodes", predicted, f"{hours:>9.2f} h  {nodes * hours * PRICE + requests:>8.0f} $")
    print(f"traffic: {frames * splats * costs.source * costs.passes / 1e12:.1f} TB read, "
          f"{2 * frames * splats * costs.bundle / 1e12:.2f} TB written (parts, bundle), requests {requests:.0f} $")  # fmt: skip
    print(
        f"a node: {CORES} cores, {PRICE} $ an hour, {NETWORK * 8 / 1e9:.0f} Gbit/s, {STORE_CONNECTION / 1e6:.0f} MB/s a stream"
    )


def row(label: str, predicted: dict[str, float], rest: str) -> None:
    cells = [
        f"{predicted[name]:>{width}.1f}" for name, width in (("look, draw", 12), ("fit", 8), ("encode", 10), ("assemble", 10))
    ]
    print(f"{label:24}{''.join(cells)}{sum(predicted.values()):>10.1f}{rest}")


if __name__ == "__main__":
    main()
