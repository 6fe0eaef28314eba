"""Colors from spherical harmonics.

The real basis with the signs of the 3DGS PLY, bands 0 to 4 (Ramamoorthi and Hanrahan 2001; band 4 as in SPZ).
"""

import numpy as np

from gsplat_tools.constants import SH_C0
from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel

BAND_4_FIRST = 2.5033429417967046
"""First constant of band 4, sqrt(315 / (16 pi))."""


@device()
def fill_basis(basis, x, y, z, degree, band_4_first):
    """Write the (degree + 1)^2 values of the basis in the unit direction (x, y, z).

    basis         float (K,)  written
    x, y, z       float       unit vector
    degree        int         0 to 4
    band_4_first  float       the first constant of band 4, which gsplat-unity has wrong
    """
    f = basis.dtype.type
    basis[0] = f(0.28209479177387814)
    if degree < 1:
        return
    basis[1] = f(-0.4886025119029199) * y
    basis[2] = f(0.4886025119029199) * z
    basis[3] = f(-0.4886025119029199) * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    basis[4] = f(1.0925484305920792) * xy
    basis[5] = f(-1.0925484305920792) * yz
    basis[6] = f(0.31539156525252005) * (f(2) * zz - xx - yy)
    basis[7] = f(-1.0925484305920792) * xz
    basis[8] = f(0.5462742152960396) * (xx - yy)
    if degree < 3:
        return
    basis[9] = f(-0.5900435899266435) * y * (f(3) * xx - yy)
    basis[10] = f(2.890611442640554) * xy * z
    basis[11] = f(-0.4570457994644658) * y * (f(4) * zz - xx - yy)
    basis[12] = f(0.3731763325901154) * z * (f(2) * zz - f(3) * xx - f(3) * yy)
    basis[13] = f(-0.4570457994644658) * x * (f(4) * zz - xx - yy)
    basis[14] = f(1.445305721320277) * z * (xx - yy)
    basis[15] = f(-0.5900435899266435) * x * (xx - f(3) * yy)
    if degree < 4:
        return
    basis[16] = band_4_first * xy * (xx - yy)
    basis[17] = f(-1.7701307697799304) * yz * (f(3) * xx - yy)
    basis[18] = f(0.9461746957575601) * xy * (f(6) * zz - xx - yy)
    basis[19] = f(-0.6690465435572892) * yz * (f(4) * zz - f(3) * xx - f(3) * yy)
    basis[20] = f(0.10578554691520431) * (f(35) * zz * zz - f(30) * zz + f(3))
    basis[21] = f(-0.6690465435572892) * xz * (f(4) * zz - f(3) * xx - f(3) * yy)
    basis[22] = f(0.47308734787878004) * (xx - yy) * (f(6) * zz - xx - yy)
    basis[23] = f(-1.7701307697799304) * xz * (xx - f(3) * yy)
    basis[24] = f(0.6258357354491761) * (xx * xx - f(6) * xx * yy + yy * yy)


@kernel()
def evaluate_colors(sh0, shN, eye, degree, band_4_first, first, splats):
    """Evaluate SH in the direction from the camera to each splat; the constant 0.5 is added, nothing is clamped.

    sh0           float32 (N, 3)       read
    shN           float32 (N, K-1, 3)  read, basis-major
    eye           float (3,)           camera in the space of the means
    degree        int                  highest band used
    band_4_first  float                see fill_basis
    first         int                  index of the first splat in sh0 and shN
    splats        float (M, SPLAT_SIZE)  means read, colors written
    """
    f = splats.dtype.type
    basis = np.empty(25, splats.dtype)
    num_rest = (degree + 1) * (degree + 1) - 1
    half = f(0.5)
    c0 = f(SH_C0)
    for row in range(len(splats)):
        i = first + row
        red = f(sh0[i, 0]) * c0 + half
        green = f(sh0[i, 1]) * c0 + half
        blue = f(sh0[i, 2]) * c0 + half
        if num_rest > 0:
            # In float64, where the squares of float32 distances neither overflow nor vanish.
            x = np.float64(splats[row, R.MEAN]) - np.float64(eye[0])
            y = np.float64(splats[row, R.MEAN + 1]) - np.float64(eye[1])
            z = np.float64(splats[row, R.MEAN + 2]) - np.float64(eye[2])
            length = np.sqrt(x * x + y * y + z * z)
            # A splat in the eye has no direction; it is seen along +z.
            if length > 0.0:
                fill_basis(basis, f(x / length), f(y / length), f(z / length), degree, band_4_first)
            else:
                fill_basis(basis, f(0), f(0), f(1), degree, band_4_first)
            for k in range(num_rest):
                weight = basis[k + 1]
                red += weight * f(shN[i, k, 0])
                green += weight * f(shN[i, k, 1])
                blue += weight * f(shN[i, k, 2])
        splats[row, R.COLOR] = red
        splats[row, R.COLOR + 1] = green
        splats[row, R.COLOR + 2] = blue


@kernel()
def evaluate_basis(directions, degree, band_4_first, values):
    """Evaluate the basis in unit directions.

    directions    float (N, 3)  read, unit vectors
    degree        int           0 to 4
    band_4_first  float         see fill_basis
    values        float (N, K)  written, K = (degree + 1)^2
    """
    for i in range(len(directions)):
        fill_basis(values[i], directions[i, 0], directions[i, 1], directions[i, 2], degree, band_4_first)
