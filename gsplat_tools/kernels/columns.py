"""Rows of a PLY to attribute arrays and back: one pass, every value moved once."""

from __future__ import annotations

import numpy as np

from gsplat_tools.kernels._jit import kernel


@kernel()
def scatter_rows(rows, columns, normal_columns, means, log_scales, quats, opacity_logits, sh0, shN):
    """Move the columns of rows to attribute arrays; returns whether any normal is not zero.

    rows            float32 (n, C)     read
    columns         int64 (14 + 3 R,)  read; columns of x y z, scale 0..2, rot 0..3, opacity, f_dc 0..2, then of f_rest
                                       channel by channel; a negative one gives -inf
    normal_columns  int64 (0..3,)      read; columns that are only looked at
    means           float32 (n, 3)     written
    log_scales      float32 (n, 3)     written
    quats           float32 (n, 4)     written
    opacity_logits  float32 (n,)       written
    sh0             float32 (n, 3)     written
    shN             float32 (n, R, 3)  written, basis-major
    """
    num_rest = shN.shape[1]
    has_normals = False
    flat = columns[5] < 0
    for i in range(rows.shape[0]):
        row = rows[i]
        for a in range(3):
            means[i, a] = row[columns[a]]
            sh0[i, a] = row[columns[11 + a]]
        log_scales[i, 0] = row[columns[3]]
        log_scales[i, 1] = row[columns[4]]
        log_scales[i, 2] = np.float32(-np.inf) if flat else row[columns[5]]
        for a in range(4):
            quats[i, a] = row[columns[6 + a]]
        opacity_logits[i] = row[columns[10]]
        for k in range(num_rest):
            shN[i, k, 0] = row[columns[14 + k]]
            shN[i, k, 1] = row[columns[14 + num_rest + k]]
            shN[i, k, 2] = row[columns[14 + 2 * num_rest + k]]
        for a in range(normal_columns.shape[0]):
            has_normals |= row[normal_columns[a]] != 0
    return has_normals


@kernel()
def gather_rows(means, log_scales, quats, opacity_logits, sh0, shN, num_scales, rows):
    """Lay attributes out as rows: x y z, f_dc, f_rest channel by channel, opacity, scales, rot.

    means           float32 (n, 3)     read
    log_scales      float32 (n, 3)     read
    quats           float32 (n, 4)     read
    opacity_logits  float32 (n,)       read
    sh0             float32 (n, 3)     read
    shN             float32 (n, R, 3)  read, basis-major
    num_scales      int                3, or 2 for flat splats
    rows            float32 (n, 11 + num_scales + 3 R)  written
    """
    num_rest = shN.shape[1]
    tail = 6 + 3 * num_rest
    for i in range(means.shape[0]):
        row = rows[i]
        for a in range(3):
            row[a] = means[i, a]
            row[3 + a] = sh0[i, a]
        for k in range(num_rest):
            row[6 + k] = shN[i, k, 0]
            row[6 + num_rest + k] = shN[i, k, 1]
            row[6 + 2 * num_rest + k] = shN[i, k, 2]
        row[tail] = opacity_logits[i]
        for a in range(num_scales):
            row[tail + 1 + a] = log_scales[i, a]
        for a in range(4):
            row[tail + 1 + num_scales + a] = quats[i, a]
