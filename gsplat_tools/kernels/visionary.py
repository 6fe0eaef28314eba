"""Visionary's preprocess pass: Gaussians with covariances to splat records and depth keys.

Source: preprocess.wgsl of Visionary-Laboratory/visionary @ c5d7070; steps in the order of docs/visionary.md.
"""

import math

import numpy as np

from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.half_floats import round_to_half

# UNIFORMS: camera and model, in the space of the means
VIEW = 0  # 12 numbers: rows of view times model, each followed by its translation
ROTATION = 12  # 9 numbers: rows of the view
LINEAR = 21  # 9 numbers: rows of the model matrix
FX, FY = 30, 31  # px
SHIFT_X, SHIFT_Y = 32, 33  # third column of the projection, zero for a centered principal point
WIDTH, HEIGHT = 34, 35  # px
CLIP_SLOPE, CLIP_SHIFT, Z_FAR = 36, 37, 38  # clip z = slope z + shift; the far plane as the shader recovers it
KERNEL_SIZE = 39  # px^2
GAUSSIAN_SCALING, OPACITY_SCALE, CUTOFF_SCALE = 40, 41, 42
MAX_WORLD_TRACE = 43  # infinity: nothing is discarded
MIP = 44  # 0 or 1
RENDER_MODE = 45
UNIFORMS_SIZE = 46

MODE_COLOR, MODE_NORMAL, MODE_DEPTH = 0, 1, 2

COVARIANCE = R.MEAN + 3  # six columns of a splat that holds its covariance in the place of scales and quaternion

# Columns of the values of a record
VAL_V1, VAL_V2, VAL_POS, VAL_POSZ, VAL_COLOR, VAL_OPACITY = 0, 2, 4, 6, 7, 10
VALUES_SIZE = 11

_FRUSTUM = 1.2
_OPACITY_CULL = 0.02
_TINY = 1e-6
_LEAST_LAMBDA2 = 0.1
_TINY_DETERMINANT = 1e-12
# Spans come from other arithmetic than the test of a pixel; this keeps them on the safe side.
_SLACK = 1e-4


@device()
def _fill_normal(xx, xy, xz, yy, yz, zz, values):
    """Write the smallest eigenvector of a covariance as a color: three power iterations on its inverse."""
    zero, one, half = values.dtype.type(0), values.dtype.type(1), values.dtype.type(0.5)
    c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c11, c12, c22 = xx * zz - xz * xz, xz * xy - xx * yz, xx * yy - xy * xy
    det = xx * c00 + xy * c01 + xz * c02
    tiny = values.dtype.type(_TINY_DETERMINANT)
    inverse = one / tiny if abs(det) < tiny else one / det
    c00, c01, c02, c11, c12, c22 = c00 * inverse, c01 * inverse, c02 * inverse, c11 * inverse, c12 * inverse, c22 * inverse
    x, y, z = c00 + c01 + c02, c01 + c11 + c12, c02 + c12 + c22
    for iteration in range(4):
        if iteration > 0:
            x, y, z = c00 * x + c01 * y + c02 * z, c01 * x + c11 * y + c12 * z, c02 * x + c12 * y + c22 * z
        # By the largest component first: squares of an inverse covariance overflow float32.
        largest = max(abs(x), abs(y), abs(z))
        x, y, z = x / largest, y / largest, z / largest
        norm = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / norm, y / norm, z / norm
    if (x + y + z) * zero != zero:
        # normalize(0, 0, 0), which the device leaves open: the direction that the shader means for this case.
        x, y, z = zero, zero, one
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        is_flipped = x < zero
    elif abs(y) >= abs(z):
        is_flipped = y < zero
    else:
        is_flipped = z < zero
    sign = -one if is_flipped else one
    values[VAL_COLOR] = min(max(half * (sign * x + one), zero), one)
    values[VAL_COLOR + 1] = min(max(half * (sign * y + one), zero), one)
    values[VAL_COLOR + 2] = min(max(half * (sign * z + one), zero), one)


@kernel()
def activate(means, center, log_scales, quats, opacity_logits, weights, is_single, start, stop, splats):
    """Turn stored values into splats with covariances about a center; colors are left out.

    means           float (N, 3)    read
    center          float64 (3,)    read; subtracted in float64
    log_scales      float32 (N, 3)  read
    quats           float32 (N, 4)  read, wxyz; of norm 0: the splat becomes NaN
    opacity_logits  float32 (N,)    read
    weights         float (N,)      read; factor of the opacity. Empty: 1
    is_single       bool            opacities and covariances are rounded to float32, as buffers hold them
    start, stop     int             range of splats
    splats          float (stop - start, SPLAT_SIZE)  written, but for the colors
    """
    f = splats.dtype.type
    halves = np.empty((3, 3), np.float64)
    for i in range(start, stop):
        row = i - start
        w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / norm, x / norm, y / norm, z / norm
        sx, sy, sz = (
            math.exp(np.float64(log_scales[i, 0])),
            math.exp(np.float64(log_scales[i, 1])),
            math.exp(np.float64(log_scales[i, 2])),
        )
        halves[0, 0], halves[0, 1], halves[0, 2] = (
            (1.0 - 2.0 * (y * y + z * z)) * sx,
            2.0 * (x * y - w * z) * sy,
            2.0 * (x * z + w * y) * sz,
        )
        halves[1, 0], halves[1, 1], halves[1, 2] = (
            2.0 * (x * y + w * z) * sx,
            (1.0 - 2.0 * (x * x + z * z)) * sy,
            2.0 * (y * z - w * x) * sz,
        )
        halves[2, 0], halves[2, 1], halves[2, 2] = (
            2.0 * (x * z - w * y) * sx,
            2.0 * (y * z + w * x) * sy,
            (1.0 - 2.0 * (x * x + y * y)) * sz,
        )
        column = COVARIANCE
        for a in range(3):
            for b in range(a, 3):
                entry = halves[a, 0] * halves[b, 0] + halves[a, 1] * halves[b, 1] + halves[a, 2] * halves[b, 2]
                splats[row, column] = f(np.float32(entry)) if is_single else f(entry)
                column += 1
        for c in range(3):
            splats[row, R.MEAN + c] = f(np.float64(means[i, c]) - center[c])
        opacity = 1.0 / (1.0 + math.exp(-np.float64(opacity_logits[i])))
        if is_single:
            opacity = np.float64(np.float32(opacity))
        splats[row, R.OPACITY] = f(opacity) if len(weights) == 0 else f(opacity) * f(weights[i])


@kernel()
def round_values(values):
    """Round the values of records to what their halves hold; the depth stays.

    values  float (M, VALUES_SIZE)  read and written
    """
    f = values.dtype.type
    for i in range(len(values)):
        for c in range(VALUES_SIZE):
            if c != VAL_POSZ:
                values[i, c] = f(round_to_half(values[i, c]))


@kernel()
def preprocess(splats, uniforms, values, differences, states):
    """Turn splats into the values of records; culled and invalid ones get a state only.

    splats       float (M, SPLAT_SIZE)    read: mean, covariance xx xy xz yy yz zz, opacity, color
    uniforms     float (UNIFORMS_SIZE,)   read
    values       float (M, VALUES_SIZE)   written: v1 / viewport, v2 / viewport, ndc, ndc z, color, opacity
    differences  float (M,)               written: far plane - clip z, whose bits are the key
    states       uint8 (M,)               written, as in rules.py
    """
    f = uniforms.dtype.type
    zero, one, two, half, tiny = f(0), f(1), f(2), f(0.5), f(_TINY)
    fx, fy, width, height = uniforms[FX], uniforms[FY], uniforms[WIDTH], uniforms[HEIGHT]
    k = uniforms[KERNEL_SIZE]
    scaling = uniforms[GAUSSIAN_SCALING] * uniforms[GAUSSIAN_SCALING]
    mode = int(uniforms[RENDER_MODE])
    a = uniforms[LINEAR : LINEAR + 9]
    r = uniforms[ROTATION : ROTATION + 9]
    for i in range(len(splats)):
        total = zero
        for c in range(9):
            total += splats[i, c] * zero
        for c in range(R.OPACITY, R.COLOR + 3):
            total += splats[i, c] * zero
        if total != zero:
            states[i] = R.INVALID
            continue
        states[i] = R.CULLED
        wx, wy, wz = splats[i, R.MEAN], splats[i, R.MEAN + 1], splats[i, R.MEAN + 2]
        opacity = splats[i, R.OPACITY] * uniforms[OPACITY_SCALE]
        x = uniforms[VIEW] * wx + uniforms[VIEW + 1] * wy + uniforms[VIEW + 2] * wz + uniforms[VIEW + 3]
        y = uniforms[VIEW + 4] * wx + uniforms[VIEW + 5] * wy + uniforms[VIEW + 6] * wz + uniforms[VIEW + 7]
        z = uniforms[VIEW + 8] * wx + uniforms[VIEW + 9] * wy + uniforms[VIEW + 10] * wz + uniforms[VIEW + 11]
        clip_x = two * fx / width * x + uniforms[SHIFT_X] * z
        # The packer negates this row of the projection: up is positive.
        clip_y = -(two * fy / height * y + uniforms[SHIFT_Y] * z)
        clip_z = uniforms[CLIP_SLOPE] * z + uniforms[CLIP_SHIFT]
        ndc_z = clip_z / z
        bound = f(_FRUSTUM) * z
        if not (ndc_z > zero and ndc_z < one and abs(clip_x) <= bound and abs(clip_y) <= bound):
            continue
        if opacity < f(_OPACITY_CULL):
            continue

        s00, s01, s02 = (
            splats[i, COVARIANCE] * scaling,
            splats[i, COVARIANCE + 1] * scaling,
            splats[i, COVARIANCE + 2] * scaling,
        )
        s11, s12, s22 = (
            splats[i, COVARIANCE + 3] * scaling,
            splats[i, COVARIANCE + 4] * scaling,
            splats[i, COVARIANCE + 5] * scaling,
        )
        # Sigma_world = A Sigma A^T
        p00, p01, p02 = (
            a[0] * s00 + a[1] * s01 + a[2] * s02,
            a[0] * s01 + a[1] * s11 + a[2] * s12,
            a[0] * s02 + a[1] * s12 + a[2] * s22,
        )
        p10, p11, p12 = (
            a[3] * s00 + a[4] * s01 + a[5] * s02,
            a[3] * s01 + a[4] * s11 + a[5] * s12,
            a[3] * s02 + a[4] * s12 + a[5] * s22,
        )
        p20, p21, p22 = (
            a[6] * s00 + a[7] * s01 + a[8] * s02,
            a[6] * s01 + a[7] * s11 + a[8] * s12,
            a[6] * s02 + a[7] * s12 + a[8] * s22,
        )
        xx = p00 * a[0] + p01 * a[1] + p02 * a[2]
        xy = p00 * a[3] + p01 * a[4] + p02 * a[5]
        xz = p00 * a[6] + p01 * a[7] + p02 * a[8]
        yy = p10 * a[3] + p11 * a[4] + p12 * a[5]
        yz = p10 * a[6] + p11 * a[7] + p12 * a[8]
        zz = p20 * a[6] + p21 * a[7] + p22 * a[8]
        if xx + yy + zz > uniforms[MAX_WORLD_TRACE]:
            continue

        # Rows of J R; the second one is negated, as y is.
        slope_x, slope_y, jx, jy = x / z, y / z, fx / z, -fy / z
        t00, t01, t02 = jx * (r[0] - slope_x * r[6]), jx * (r[1] - slope_x * r[7]), jx * (r[2] - slope_x * r[8])
        t10, t11, t12 = jy * (r[3] - slope_y * r[6]), jy * (r[4] - slope_y * r[7]), jy * (r[5] - slope_y * r[8])
        u0, u1, u2 = t00 * xx + t01 * xy + t02 * xz, t00 * xy + t01 * yy + t02 * yz, t00 * xz + t01 * yz + t02 * zz
        cov00 = u0 * t00 + u1 * t01 + u2 * t02
        cov01 = u0 * t10 + u1 * t11 + u2 * t12
        cov11 = (
            (t10 * xx + t11 * xy + t12 * xz) * t10
            + (t10 * xy + t11 * yy + t12 * yz) * t11
            + (t10 * xz + t11 * yz + t12 * zz) * t12
        )
        if uniforms[MIP] != zero:
            det0 = max(tiny, cov00 * cov11 - cov01 * cov01)
            det1 = max(tiny, (cov00 + k) * (cov11 + k) - cov01 * cov01)
            opacity *= zero if det0 <= tiny or det1 <= tiny else np.sqrt(det0 / (det1 + tiny) + tiny)

        diagonal1, diagonal2 = cov00 + k, cov11 + k
        mid = half * (diagonal1 + diagonal2)
        difference = half * (diagonal1 - diagonal2)
        spread = np.sqrt(difference * difference + cov01 * cov01)
        lambda1 = mid + spread
        lambda2 = max(mid - spread, f(_LEAST_LAMBDA2))
        # The direction (cov01, lambda1 - diagonal1), without the cancellation in the second component.
        is_undefined = cov01 == zero and difference >= zero
        if is_undefined:
            ex, ey = one, zero
        elif difference > zero:
            ex, ey = difference + spread, cov01
            if cov01 < zero:
                ex, ey = -ex, -ey
        else:
            ex, ey = cov01, spread - difference
        norm = np.sqrt(ex * ex + ey * ey)
        ex, ey = ex / norm, ey / norm
        axis1 = np.sqrt(two * lambda1) * uniforms[CUTOFF_SCALE]
        axis2 = np.sqrt(two * lambda2) * uniforms[CUTOFF_SCALE]
        if (axis1 * ex + axis1 * ey + axis2 * ex + opacity) * zero != zero:
            states[i] = R.INVALID
            continue

        states[i] = R.DRAWN + R.EIGENVECTOR_UNDEFINED if is_undefined else R.DRAWN
        values[i, VAL_V1], values[i, VAL_V1 + 1] = axis1 * ex / width, axis1 * ey / height
        values[i, VAL_V2], values[i, VAL_V2 + 1] = axis2 * ey / width, -(axis2 * ex) / height
        values[i, VAL_POS], values[i, VAL_POS + 1] = clip_x / z, clip_y / z
        values[i, VAL_POSZ] = ndc_z
        values[i, VAL_OPACITY] = opacity
        if mode == MODE_NORMAL:
            _fill_normal(xx, xy, xz, yy, yz, zz, values[i])
        else:
            for c in range(3):
                values[i, VAL_COLOR + c] = one - ndc_z if mode == MODE_DEPTH else max(zero, splats[i, R.COLOR + c])
        differences[i] = uniforms[Z_FAR] - clip_z


@kernel()
def place(values, cutoff, width, height, records, bounds, states):
    """Turn the values of records into splats of a picture, as blending reads them; what shows nothing gets a state only.

    values   float (M, VALUES_SIZE)   read
    cutoff   float                    nothing is drawn beyond this q
    width    float                    px
    height   float                    px
    records  float (M, RECORD_SIZE)   written
    bounds   int32 (M, 4)             written: x start, x stop, y start, y stop of the pixels that can be touched
    states   uint8 (M,)               written: DRAWN, CULLED, or INVALID where the axes span no area
    """
    f = records.dtype.type
    zero, one, half = f(0), f(1), f(0.5)
    q = cutoff * (one + f(_SLACK)) + f(_SLACK)
    for i in range(len(values)):
        states[i] = R.CULLED
        opacity = f(values[i, VAL_OPACITY])
        if opacity == zero:
            continue
        # Rows of pixels go down, ndc goes up.
        center_x = (f(values[i, VAL_POS]) + one) * half * width
        center_y = (one - f(values[i, VAL_POS + 1])) * half * height
        v1x, v1y = f(values[i, VAL_V1]) * width, -f(values[i, VAL_V1 + 1]) * height
        v2x, v2y = f(values[i, VAL_V2]) * width, -f(values[i, VAL_V2 + 1]) * height
        area = v1x * v2y - v2x * v1y
        ux, uy, vx, vy = v2y / area, -v2x / area, -v1y / area, v1x / area
        # q = (s dx + k dy)^2 + (h dy)^2: for a row of pixels, one square in dx.
        s = np.sqrt(ux * ux + vx * vx)
        k = (ux * uy + vx * vy) / s
        h = abs(ux * vy - uy * vx) / s
        reach_x = np.sqrt(q * (v1x * v1x + v2x * v2x))
        reach_y = np.sqrt(q * (v1y * v1y + v2y * v2y))
        total = s + k + h + center_x + center_y + reach_x + reach_y + opacity
        for c in range(3):
            total += f(values[i, VAL_COLOR + c])
        if not (s > zero and h > zero and total * zero == zero):
            states[i] = R.INVALID
            continue
        low_x, high_x = center_x - reach_x, center_x + reach_x
        low_y, high_y = center_y - reach_y, center_y + reach_y
        x_start = np.int32(min(max(low_x, zero), width))
        y_start = np.int32(min(max(low_y, zero), height))
        x_stop = np.int32(min(np.ceil(high_x), width)) if high_x > zero else np.int32(0)
        y_stop = np.int32(min(np.ceil(high_y), height)) if high_y > zero else np.int32(0)
        if x_start >= x_stop or y_start >= y_stop:
            continue
        states[i] = R.DRAWN
        bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = x_start, x_stop, y_start, y_stop
        records[i, R.REC_X], records[i, R.REC_Y] = center_x, center_y
        records[i, R.REC_S], records[i, R.REC_K], records[i, R.REC_H] = s, k, h
        records[i, R.REC_Q], records[i, R.REC_OPACITY] = q, opacity
        for c in range(3):
            records[i, R.REC_R + c] = f(values[i, VAL_COLOR + c])
        records[i, R.REC_UX], records[i, R.REC_UY] = ux, uy
        records[i, R.REC_VX], records[i, R.REC_VY] = vx, vy
        records[i, R.REC_BOX] = one + one
