"""Arithmetic of 60 digits that oracles are made of, and float32's half step, which bounds are derived from."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np

HALF_STEP = 2.0**-24
"""Largest relative error of one rounding to float32."""

MP = mpmath.mp.clone()
MP.dps = 60


def mp_matrix(quat: np.ndarray) -> Any:
    """Rotation matrix of a quaternion of any length."""
    w, x, y, z = (MP.mpf(float(c)) for c in quat)
    n = w * w + x * x + y * y + z * z
    s = 2 / n
    return MP.matrix(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )
