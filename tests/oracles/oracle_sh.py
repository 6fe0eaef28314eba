"""Spherical harmonics, one formula a line, in float64."""

import numpy as np


def basis(direction, degree, *, quarter_bug=False):
    """Return the (K,) basis values of one unit direction; `quarter_bug` is gsplat-unity's first degree-4 term."""
    x, y, z = (float(value) for value in direction)
    values = [0.28209479177387814]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree >= 3:
        values += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    if degree >= 4:
        values += [
            (0.6258357354491761 if quarter_bug else 2.5033429417967046) * x * y * (x * x - y * y),
            -1.7701307697799304 * y * z * (3 * x * x - y * y),
            0.9461746957575601 * x * y * (6 * z * z - x * x - y * y),
            -0.6690465435572892 * y * z * (4 * z * z - 3 * x * x - 3 * y * y),
            0.10578554691520431 * (35 * z**4 - 30 * z * z + 3),
            -0.6690465435572892 * x * z * (4 * z * z - 3 * x * x - 3 * y * y),
            0.47308734787878004 * (x * x - y * y) * (6 * z * z - x * x - y * y),
            -1.7701307697799304 * x * z * (x * x - 3 * y * y),
            0.6258357354491761 * (x**4 - 6 * x * x * y * y + y**4),
        ]
    return np.array(values)


def color(sh0, shN, offset, degree, *, quarter_bug=False):
    """Return SH + 0.5 seen along `offset`, from the camera to the splat; a zero offset looks along +z."""
    length = np.linalg.norm(offset)
    direction = offset / length if length > 0 else np.array([0.0, 0.0, 1.0])
    coefficients = np.concatenate([np.asarray(sh0, np.float64)[None], np.asarray(shN, np.float64)])
    values = basis(direction, degree, quarter_bug=quarter_bug)
    return values @ coefficients[: len(values)] + 0.5
