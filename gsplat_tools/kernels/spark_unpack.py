"""Spark's 16-byte splats back to values.

Source: docs/formats/spark.md, from unpackSplat and decodeQuatOctXy88R8 of @sparkjsdev/spark 2.2.0 (tools/golden_spark).
"""

import numpy as np

from gsplat_tools.kernels._jit import device, kernel

_HALF_ANGLES = np.arange(256) / 255.0 * np.pi * 0.5
_SINES = np.sin(_HALF_ANGLES)
_COSINES = np.cos(_HALF_ANGLES)


@device()
def unpack_rotation(u, v, angle, quat):
    """Write the unit quaternion, wxyz with w >= 0, of three codes.

    u, v, angle  int          0..255
    quat         float32 (4,) written
    """
    x = (np.float64(u) / 255.0 - 0.5) * 2.0
    y = (np.float64(v) / 255.0 - 0.5) * 2.0
    z = 1.0 - (abs(x) + abs(y))
    t = max(-z, 0.0)
    x += -t if x >= 0.0 else t
    y += -t if y >= 0.0 else t
    factor = _SINES[angle] / np.sqrt(x * x + y * y + z * z)
    quat[0] = np.float32(_COSINES[angle])
    quat[1] = np.float32(x * factor)
    quat[2] = np.float32(y * factor)
    quat[3] = np.float32(z * factor)


@kernel()
def decode_cloud(packed, scale_table, logit_table, sh0_table, log_scales, quats, opacity_logits, sh0):
    """Values of splats, but for the positions.

    packed          uint32 (N, 4)   read
    scale_table     float32 (256,)  read: log scale of a code
    logit_table     float32 (256,)  read: opacity logit of a code
    sh0_table       float32 (256,)  read: constant term of a code
    log_scales      float32 (N, 3)  written
    quats           float32 (N, 4)  written, wxyz
    opacity_logits  float32 (N,)    written
    sh0             float32 (N, 3)  written
    """
    for i in range(packed.shape[0]):
        color, rotation, scales = np.int64(packed[i, 0]), np.int64(packed[i, 2]), np.int64(packed[i, 3])
        for k in range(3):
            sh0[i, k] = sh0_table[(color >> (8 * k)) & 255]
            log_scales[i, k] = scale_table[(scales >> (8 * k)) & 255]
        opacity_logits[i] = logit_table[(color >> 24) & 255]
        unpack_rotation((rotation >> 16) & 255, (rotation >> 24) & 255, (scales >> 24) & 255, quats[i])
