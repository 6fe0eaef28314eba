"""What the figures were measured on."""

from __future__ import annotations

import numba

from gsplat_tools.tuning.machine import describe_machine as describe_without_compiler


def describe_machine() -> str:
    """One line: processor, threads, and versions."""
    return f"{describe_without_compiler()}, numba {numba.__version__}"
