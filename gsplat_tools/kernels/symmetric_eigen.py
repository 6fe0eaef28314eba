"""Symmetric 3x3 matrices: eigenvalues, and eigenvectors as quaternions.

Source: cyclic Jacobi rotations, Golub and Van Loan 2013, Matrix Computations, 8.5; the quaternion by Shepperd 1978.
"""

import math

import numpy as np

from gsplat_tools.kernels._jit import device, kernel

# Rotations converge quadratically; what is left of an entry below these shares, of the diagonal and of the largest
# entry, changes no bit of the result.
_NEGLIGIBLE = 2.0**-60
_NOTHING = 2.0**-200
_MAX_SWEEPS = 20


@device()
def _diagonalize(a, v):
    """Turn the matrix a (3, 3) with entries up to about 1 to its diagonal, and the columns of v (3, 3) along with it."""
    for _ in range(_MAX_SWEEPS):
        is_done = True
        for r in range(2, -1, -1):
            p, q = (0, 1) if r == 2 else ((0, 2) if r == 1 else (1, 2))
            entry = a[p, q]
            if abs(entry) <= max(_NOTHING, _NEGLIGIBLE * min(abs(a[p, p]), abs(a[q, q]))):
                continue
            is_done = False
            theta = (a[q, q] - a[p, p]) / (2.0 * entry)
            t = math.copysign(1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0)), theta)
            c = 1.0 / math.sqrt(t * t + 1.0)
            s = t * c
            tau = s / (1.0 + c)
            a[p, p] -= t * entry
            a[q, q] += t * entry
            a[p, q] = a[q, p] = 0.0
            first, second = a[r, p], a[r, q]
            a[r, p] = a[p, r] = first - s * (second + first * tau)
            a[r, q] = a[q, r] = second + s * (first - second * tau)
            for i in range(3):
                first, second = v[i, p], v[i, q]
                v[i, p] = first - s * (second + first * tau)
                v[i, q] = second + s * (first - second * tau)
        if is_done:
            return


@device()
def _write_quat(v, x, y, z, sign, quat):
    """Write the quaternion of the rotation with columns sign v[:, x], v[:, y], v[:, z]; its first nonzero is positive."""
    m00, m10, m20 = sign * v[0, x], sign * v[1, x], sign * v[2, x]
    m01, m11, m21 = v[0, y], v[1, y], v[2, y]
    m02, m12, m22 = v[0, z], v[1, z], v[2, z]
    ww, xx, yy, zz = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    # Four times the products of the components: the row of the largest square divides by no small number.
    if ww >= xx and ww >= yy and ww >= zz:
        qw, qx, qy, qz = ww, wx, wy, wz
    elif xx >= yy and xx >= zz:
        qw, qx, qy, qz = wx, xx, xy, xz
    elif yy >= zz:
        qw, qx, qy, qz = wy, xy, yy, yz
    else:
        qw, qx, qy, qz = wz, xz, yz, zz
    norm = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    is_negative = qw < 0 or (qw == 0 and (qx < 0 or (qx == 0 and (qy < 0 or (qy == 0 and qz < 0)))))
    if is_negative:
        norm = -norm
    quat[0], quat[1], quat[2], quat[3] = qw / norm, qx / norm, qy / norm, qz / norm


@kernel()
def decompose(triangles, values, exponents, quats):
    """Decompose symmetric matrices.

    triangles  float64 (N, 6)   read: xx xy xz yy yz zz, finite
    values     float64 (N, 3)   written: eigenvalues over 2^exponent, ascending
    exponents  int64 (N,)       written: that of the largest entry, so that nothing overflows or vanishes
    quats      float32 (N, 4)   written: wxyz, unit; turns the axes into the eigenvectors in the order of the values
    """
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    for i in range(len(triangles)):
        largest = 0.0
        for c in range(6):
            largest = max(largest, abs(triangles[i, c]))
        exponent = math.frexp(largest)[1]
        exponents[i] = exponent
        column = 0
        for row in range(3):
            for other in range(row, 3):
                entry = math.ldexp(triangles[i, column], -exponent)
                a[row, other] = a[other, row] = entry
                v[row, other] = v[other, row] = 1.0 if row == other else 0.0
                column += 1
        _diagonalize(a, v)
        x, y, z, sign = 0, 1, 2, 1.0
        if a[y, y] < a[x, x]:
            x, y, sign = y, x, -sign
        if a[z, z] < a[y, y]:
            y, z, sign = z, y, -sign
        if a[y, y] < a[x, x]:
            x, y, sign = y, x, -sign
        values[i, 0], values[i, 1], values[i, 2] = a[x, x], a[y, y], a[z, z]
        _write_quat(v, x, y, z, sign, quats[i])
