"""Other tools that read and write the same formats; tests are skipped with a reason where they are missing.

npm packages are looked for in tests/browser/node_modules, or in the folder that GSPLAT_TOOLS_NODE_MODULES names; gsply in
this interpreter, or in the one that GSPLAT_TOOLS_GSPLY names.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

NODE_MODULES = Path(os.environ.get("GSPLAT_TOOLS_NODE_MODULES", Path(__file__).parents[1] / "browser" / "node_modules"))
GSPLY_PYTHON = os.environ.get("GSPLAT_TOOLS_GSPLY", sys.executable)

_READ_WITH_GSPLY = """
import sys, numpy as np, gsply
source, target = sys.argv[1:]
data = gsply.read_spz(source) if source.endswith(".spz") else gsply.plyread(source)
rest = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else np.asarray(data.shN)
np.savez(target, means=data.means, log_scales=data.scales, quats=data.quats, opacity_logits=data.opacities, sh0=data.sh0,
         shN=rest.reshape(len(data.means), -1, 3))
"""


def _module(name: str) -> Path:
    """Folder of an npm package."""
    folder = NODE_MODULES / name
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    if not folder.is_dir():
        pytest.skip(f"{name} is not installed (npm install {name}, then GSPLAT_TOOLS_NODE_MODULES names its folder)")
    return folder


def splat_transform(*arguments: str | Path) -> None:
    """Run splat-transform without a GPU."""
    command = ["node", str(_module("@playcanvas/splat-transform") / "bin" / "cli.mjs"), "-q", "-w", "-g", "cpu"]
    done = subprocess.run([*command, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]


def read_with_adobe_spz(path: Path, system: str) -> dict[str, np.ndarray]:
    """Attributes of an SPZ file as the format's own library reads it, in the axes asked for; quaternions wxyz."""
    module = _module("@adobe/spz") / "dist" / "spz.js"
    output = path.with_suffix(".floats")
    script = Path(__file__).with_name("read_spz.mjs")
    done = subprocess.run(
        ["node", str(script), str(module), str(path), system, str(output)],
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


@cache
def _gsply_version() -> str | None:
    """Version of gsply, or None where there is none."""
    done = subprocess.run(
        [GSPLY_PYTHON, "-c", "import gsply, zstandard; print(gsply.__version__)"], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else None


def read_with_gsply(path: Path) -> dict[str, np.ndarray]:
    """Attributes of a file as gsply reads it."""
    if _gsply_version() is None:
        pytest.skip("gsply is not installed (pip install 'gsply[spz]', or GSPLAT_TOOLS_GSPLY)")
    output = path.with_suffix(".npz")
    done = subprocess.run(
        [GSPLY_PYTHON, "-c", _READ_WITH_GSPLY, str(path), str(output)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr[-500:]
    with np.load(output) as arrays:
        return dict(arrays)
