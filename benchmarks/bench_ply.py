"""Read and write a PLY of SH degree 3, against plyfile, gsply (where it is installed) and copying memory.

Run: python benchmarks/bench_ply.py [--splats N] [--repeat R] [--gsply PYTHON]

PYTHON is an interpreter that has gsply, when this one has not. Files stay in the page cache: disks are not measured.
Times are the best of R; each reader runs in a process of its own, first runs (compilation) are left out.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from gsplat_tools.parallel import num_jobs

COMMON = """
import json, sys, time, threading
path, repeat = sys.argv[1], int(sys.argv[2])
def anonymous():
    try:
        with open("/proc/self/status") as status:
            return next(int(line.split()[1]) * 1024 for line in status if line.startswith("RssAnon"))
    except OSError:
        return 0
class Peak(threading.Thread):
    def __init__(self):
        super().__init__(daemon=True)
        self.peak, self.stop = 0, threading.Event()
    def run(self):
        while not self.stop.wait(0.001):
            self.peak = max(self.peak, anonymous())
def measure(function):
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
        del result
    before, watch = anonymous(), Peak()
    watch.start()
    result = function()
    watch.stop.set()
    watch.join()
    print(json.dumps({"seconds": min(times), "peak": max(watch.peak, anonymous()) - before}))
"""

READERS = {
    "gsplat_tools read": """
from gsplat_tools.formats import ply
def function():
    with open(path, "rb") as stream:
        return ply.read(stream)
""",
    "gsplat_tools read, in chunks": """
from gsplat_tools.formats import ply
def function():
    with open(path, "rb") as stream:
        return sum(len(chunk) for chunk in ply.read_chunks(stream))
""",
    "gsplat_tools read, one thread": """
from gsplat_tools.formats import ply
from gsplat_tools.parallel import use_jobs
def function():
    with open(path, "rb") as stream, use_jobs(1):
        return ply.read(stream)
""",
    "gsplat_tools write": """
from gsplat_tools.formats import ply
with open(path, "rb") as stream:
    cloud = ply.read(stream)
def function():
    with open(path + ".out", "wb") as stream:
        ply.write(cloud, stream)
""",
    "plyfile read, to columns": """
import numpy as np, plyfile
def function():
    vertex = plyfile.PlyData.read(path)["vertex"]
    stack = lambda names: np.stack([vertex[name] for name in names], axis=1)
    rest = stack([f"f_rest_{i}" for i in range(45)]).reshape(-1, 3, 15).transpose(0, 2, 1)
    return [stack("xyz"), stack([f"f_dc_{i}" for i in range(3)]), np.ascontiguousarray(rest), np.array(vertex["opacity"]),
            stack([f"scale_{i}" for i in range(3)]), stack([f"rot_{i}" for i in range(4)])]
""",
    "gsply read": """
import gsply
def function():
    return gsply.plyread(path)
""",
    "copying the file's bytes in memory": """
import numpy as np
source = np.fromfile(path, np.uint8)
def function():
    return source.copy()
""",
}


def processor() -> str:
    """Name the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def write_scene(path: Path, count: int) -> None:
    """Write random splats with normals, as the 3DGS code does, in pieces."""
    names = ["x", "y", "z", "nx", "ny", "nz", *[f"f_dc_{i}" for i in range(3)], *[f"f_rest_{i}" for i in range(45)]]
    names += ["opacity", *[f"scale_{i}" for i in range(3)], *[f"rot_{i}" for i in range(4)]]
    rng = np.random.default_rng(0)
    with path.open("wb") as stream:
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *[f"property float {n}" for n in names]]
        stream.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        for start in range(0, count, 1 << 18):
            rows = rng.standard_normal((min(1 << 18, count - start), len(names)), np.float32)
            rows[:, 3:6] = 0
            stream.write(rows.data)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--gsply", default=sys.executable, help="interpreter that has gsply")
    options = parser.parse_args()
    arrays = options.splats * 4 * 59
    machine = f"{num_jobs()} processors, {processor()}, Python {platform.python_version()}"
    print(f"{options.splats:,} splats, SH degree 3, {machine}")
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        write_scene(path, options.splats)
        for name, code in READERS.items():
            python = options.gsply if name.startswith("gsply") else sys.executable
            repeat = 1 if name.startswith("plyfile") else options.repeat
            command = [python, "-c", COMMON + code + "measure(function)", str(path), str(repeat)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
                print(f"{name}: not measured ({reason})")
                continue
            rows[name] = json.loads(done.stdout.splitlines()[-1])
    yardstick = rows["gsplat_tools read"]["seconds"]
    print(f"{'':36}{'seconds':>9}{'M splats/s':>12}{'x our read':>12}{'peak MiB':>10}{'over arrays':>13}")
    for name, row in rows.items():
        seconds, peak = row["seconds"], row["peak"]
        rate = options.splats / seconds / 1e6
        over = f"{(peak - arrays) / 2**20:.1f}" if "read" in name and "chunks" not in name else ""
        print(f"{name:36}{seconds:>9.4f}{rate:>12.1f}{seconds / yardstick:>12.2f}{peak / 2**20:>10.1f}{over:>13}")


if __name__ == "__main__":
    main()
