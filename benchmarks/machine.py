"""What the figures were measured on."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import numba
import numpy as np


def describe_machine() -> str:
    """One line: processor, threads, and versions."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text(encoding="utf-8").splitlines()
            if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cpu}, {threads} threads, Python {platform.python_version()}, numpy {np.__version__}, numba {numba.__version__}"
