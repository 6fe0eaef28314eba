"""Choice of one of the 24 frames of a Gaussian so that scales fall and the quaternion turns as little as possible."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import kernel
from gsplat_tools.kernels.rotation_frames import FRAME_AXES, FRAME_QUATS


@kernel()
def frames_of_falling_scales(quats, log_scales, frames):
    """The frame whose scales fall (x largest), and of the four that do, the one with the largest |w|.

    quats       float32 (N, 4)  read, wxyz, any length
    log_scales  float32 (N, 3)  read; equal scales keep their order
    frames      uint8 (N,)      written
    """
    order = np.empty(3, np.int64)
    for i in range(quats.shape[0]):
        a, b, c = log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]
        # Rank of each axis among the three; ties go to the earlier axis.
        order[np.int64(b > a) + np.int64(c > a)] = 0
        order[np.int64(a >= b) + np.int64(c > b)] = 1
        order[np.int64(a >= c) + np.int64(b >= c)] = 2
        best, best_frame = -1.0, 0
        for f in range(24):
            if FRAME_AXES[f, 0] != order[0] or FRAME_AXES[f, 1] != order[1] or FRAME_AXES[f, 2] != order[2]:
                continue
            w = abs(
                quats[i, 0] * FRAME_QUATS[f, 0]
                - quats[i, 1] * FRAME_QUATS[f, 1]
                - quats[i, 2] * FRAME_QUATS[f, 2]
                - quats[i, 3] * FRAME_QUATS[f, 3]
            )
            if w > best * 1.000001:  # ties by rounding stay with the first frame
                best, best_frame = w, f
        frames[i] = best_frame
