"""Depth of every splat as a number to sort by."""

import numpy as np

from gsplat_tools.kernels._jit import kernel

METRIC_DEPTH, METRIC_RADIAL = 0, 1


@kernel()
def fill_depths(means, view, metric, sign, start, stop, depths):
    """Compute the depth of splats in a camera.

    means        float (N, 3)  read; sums are float64, because scene and camera may both lie far from zero
    view         float64 (12,)  read; rows of the rotation, each followed by its translation
    metric       int           METRIC_DEPTH: along the view; METRIC_RADIAL: distance from the camera
    sign         float64       factor; -1 makes ascending keys go from far to near
    start, stop  int           range
    depths       float32 (N,)  written
    """
    for i in range(start, stop):
        wx, wy, wz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = view[8] * wx + view[9] * wy + view[10] * wz + view[11]
        if metric == METRIC_RADIAL:
            x = view[0] * wx + view[1] * wy + view[2] * wz + view[3]
            y = view[4] * wx + view[5] * wy + view[6] * wz + view[7]
            z = np.sqrt(x * x + y * y + z * z)
        depths[i] = np.float32(sign * z)
