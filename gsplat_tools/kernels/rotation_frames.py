"""The 24 frames of one Gaussian: its axes relabelled and flipped in pairs, which does not change the covariance.

Frame f turns quaternion q into q FRAME_QUATS[f] and log scales s into s[FRAME_AXES[f]]. SH live in world space and stay.
"""

import numpy as np

from gsplat_tools.kernels._jit import device, kernel

_H = np.sqrt(0.5)
FRAME_QUATS = np.array(
    [
        (1, 0, 0, 0),
        (0, 1, 0, 0),
        (0, 0, 1, 0),
        (0, 0, 0, 1),
        *[(_H, s * _H, 0, 0) for s in (1, -1)],
        *[(_H, 0, s * _H, 0) for s in (1, -1)],
        *[(_H, 0, 0, s * _H) for s in (1, -1)],
        *[(0, _H, s * _H, 0) for s in (1, -1)],
        *[(0, _H, 0, s * _H) for s in (1, -1)],
        *[(0, 0, _H, s * _H) for s in (1, -1)],
        *[(0.5, a * 0.5, b * 0.5, c * 0.5) for a in (1, -1) for b in (1, -1) for c in (1, -1)],
    ],
    np.float64,
)
"""(24, 4) wxyz: the rotations that take a cube to itself, one of each pair of signs, the identity first."""


def _axes_of(quat):
    """Return for each new axis the old axis that it lies on: the nonzero row of each column of the rotation matrix."""
    w, x, y, z = quat
    matrix = np.array(
        [
            (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
        ]
    )
    return np.abs(matrix).argmax(axis=0)


FRAME_AXES = np.array([_axes_of(quat) for quat in FRAME_QUATS], np.int64)
"""(24, 3): new axis k is the old axis FRAME_AXES[f, k], up to sign."""

_QUATS_F32 = FRAME_QUATS.astype(np.float32)
LANES = 64


@device()
def fitting_scale(w, x, y, z):
    """Return the power of two that leaves room in float32 for sums of these; 1.0 for all but the longest and shortest."""
    longest = max(abs(np.float64(w)), abs(np.float64(x)), abs(np.float64(y)), abs(np.float64(z)))
    if longest >= 2.0**125:
        return 2.0**-100
    return 2.0**100 if longest < 2.0**-60 else 1.0


@kernel()
def frames_of_largest_w(quats, frames):
    """The frame whose quaternion has the largest |w|, the smallest turn; ties take the first frame.

    quats   float32 (N, 4)  read, wxyz, any length
    frames  uint8 (N,)      written
    """
    best = np.empty(LANES, np.float32)
    best_frame = np.empty(LANES, np.int32)
    lanes = np.empty((4, LANES), np.float32)
    for start in range(0, quats.shape[0], LANES):
        count = min(LANES, quats.shape[0] - start)
        for j in range(LANES):
            i = start + (j if j < count else 0)
            scale = np.float32(fitting_scale(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]))
            for k in range(4):
                lanes[k, j] = quats[i, k] * scale
            best[j] = np.float32(-1)
            best_frame[j] = np.int32(0)
        for f in range(24):
            w, x, y, z = _QUATS_F32[f, 0], _QUATS_F32[f, 1], _QUATS_F32[f, 2], _QUATS_F32[f, 3]
            frame = np.int32(f)
            for j in range(LANES):
                value = abs(lanes[0, j] * w - lanes[1, j] * x - lanes[2, j] * y - lanes[3, j] * z)
                is_better = value > best[j] * np.float32(1.000001)  # ties by rounding stay with the first frame
                best[j] = value if is_better else best[j]
                best_frame[j] = frame if is_better else best_frame[j]
        for j in range(count):
            frames[start + j] = np.uint8(best_frame[j])


@kernel()
def apply_frames(quats, log_scales, frames, out_quats, out_log_scales):
    """Turn quaternions and permute log scales.

    quats           float32 (N, 4)  read, wxyz, any length; the longest and shortest come out in another
    log_scales      float32 (N, 3)  read
    frames          uint8 (N,)      read, 0..23
    out_quats       float32 (N, 4)  written; may alias quats
    out_log_scales  float32 (N, 3)  written; may alias log_scales
    """
    for i in range(quats.shape[0]):
        f = np.int64(frames[i])
        w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
        scale = fitting_scale(w, x, y, z)
        w, x, y, z = w * scale, x * scale, y * scale, z * scale
        a, b, c, d = FRAME_QUATS[f, 0], FRAME_QUATS[f, 1], FRAME_QUATS[f, 2], FRAME_QUATS[f, 3]
        out_quats[i, 0] = np.float32(w * a - x * b - y * c - z * d)
        out_quats[i, 1] = np.float32(w * b + x * a + y * d - z * c)
        out_quats[i, 2] = np.float32(w * c - x * d + y * a + z * b)
        out_quats[i, 3] = np.float32(w * d + x * c - y * b + z * a)
        s0 = log_scales[i, FRAME_AXES[f, 0]]
        s1 = log_scales[i, FRAME_AXES[f, 1]]
        s2 = log_scales[i, FRAME_AXES[f, 2]]
        out_log_scales[i, 0] = s0
        out_log_scales[i, 1] = s1
        out_log_scales[i, 2] = s2
