"""Splats to image space: local linearization of the perspective (EWA), with the rules of a rendering model.

Source: Zwicker et al. 2002, EWA Splatting; Kerbl et al. 2023, 3D Gaussian Splatting.
"""

import math

import numpy as np

from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel

# Tiles of the 3DGS rasterizer, px.
_TILE = 16
# Spans come from other arithmetic than the test of a pixel; this keeps them on the safe side.
_SLACK = 1e-4


@kernel()
def activate(means, eye, log_scales, quats, opacity_logits, weights, start, stop, splats):
    """Turn stored values into splats about the camera: centers relative to it, exp, sigmoid, unit quaternions.

    means           float (N, 3)    read
    eye             float64 (3,)    read; camera in the space of the means. Far from zero, float32 would lose what is near it
    log_scales      float32 (N, 3)  read
    quats           float32 (N, 4)  read, wxyz
    opacity_logits  float32 (N,)    read
    weights         float (N,)      read; factor of the opacity. Empty: 1
    start, stop     int             range of splats
    splats          float (stop - start, SPLAT_SIZE)  written, but for the colors
    """
    f = splats.dtype.type
    for i in range(start, stop):
        row = i - start
        norm = 0.0
        for c in range(4):
            norm += np.float64(quats[i, c]) * np.float64(quats[i, c])
        # A quaternion of norm 0 gives NaN, which projection counts as invalid.
        norm = math.sqrt(norm)
        for c in range(3):
            splats[row, R.MEAN + c] = f(np.float64(means[i, c]) - eye[c])
            splats[row, R.SCALE + c] = f(math.exp(np.float64(log_scales[i, c])))
        for c in range(4):
            splats[row, R.QUAT + c] = f(np.float64(quats[i, c]) / norm)
        opacity = f(1.0 / (1.0 + math.exp(-np.float64(opacity_logits[i]))))
        splats[row, R.OPACITY] = opacity if len(weights) == 0 else opacity * f(weights[i])


@device()
def _length(x, y):
    """Return the length of a vector whose squares may overflow or vanish."""
    largest = max(abs(x), abs(y))
    # Zero and infinity have no ratio to themselves.
    if not 0.0 < largest < np.inf:
        return largest
    x, y = x / largest, y / largest
    return largest * np.sqrt(x * x + y * y)


@device()
def _compensation(choices, rules, area, lambda1, lambda2):
    """Return the factor of the opacity that makes up for the low-pass filter.

    area is the root of the determinant before the filter, the lambdas are the eigenvalues after it: products of them may
    overflow, so that ratios are taken first.
    """
    f = rules.dtype.type
    kind = choices[R.COMPENSATION]
    if kind == R.COMPENSATION_RATIO:
        return np.sqrt(max(rules[R.COMPENSATION_FLOOR], (area / lambda1) * (area / lambda2)))
    return f(1)


@device()
def _to_linear(value, rules):
    """Return the approximation of sRGB decoding in UnityCG.cginc."""
    f = rules.dtype.type
    return value * (value * (value * f(0.305306011) + f(0.682171111)) + f(0.012522878))


@kernel()
def project(splats, lens, rules, choices, first, records, bounds, states):
    """Project splats; culled ones get a state and no record.

    splats   float (M, SPLAT_SIZE)   read
    lens     float (LENS_SIZE,)      read
    rules    float (RULES_SIZE,)     read
    choices  int64 (CHOICES_SIZE,)   read
    first    int                     index of the first splat in the outputs
    records  float (N, RECORD_SIZE)  written at first + row
    bounds   int32 (N, 4)            written: x start, x stop, y start, y stop of the pixels that can be touched
    states   uint8 (N,)              written
    """
    f = rules.dtype.type
    zero, one, two, half = f(0), f(1), f(2), f(0.5)
    fx, fy = lens[R.FX], lens[R.FY]
    width, height = lens[R.WIDTH], lens[R.HEIGHT]
    jacobian_fy = fx if choices[R.SQUARE_PIXELS] else fy
    low_pass = rules[R.LOW_PASS]
    limit_x = rules[R.SLOPE_LIMIT] * lens[R.SLOPE_X]
    limit_y = rules[R.SLOPE_LIMIT] * lens[R.SLOPE_Y]
    for row in range(len(splats)):
        i = first + row
        total = zero
        for c in range(R.SPLAT_SIZE):
            total += splats[row, c] * zero
        if total != zero:
            states[i] = R.INVALID
            continue
        states[i] = R.CULLED
        wx, wy, wz = splats[row, R.MEAN], splats[row, R.MEAN + 1], splats[row, R.MEAN + 2]
        x = lens[0] * wx + lens[1] * wy + lens[2] * wz + lens[3]
        y = lens[4] * wx + lens[5] * wy + lens[6] * wz + lens[7]
        z = lens[8] * wx + lens[9] * wy + lens[10] * wz + lens[11]
        if not (z > lens[R.Z_MIN] and z < lens[R.Z_MAX]):
            continue
        opacity = splats[row, R.OPACITY]
        slope_x, slope_y = x / z, y / z
        center_x = fx * slope_x + lens[R.CX]
        center_y = fy * slope_y + lens[R.CY]
        ndc_x = two * center_x / width - one
        ndc_y = two * center_y / height - one
        if abs(ndc_x) > rules[R.CENTER_LIMIT] or abs(ndc_y) > rules[R.CENTER_LIMIT]:
            continue

        # Rows m1, m2 of M = J W R S; cov2d = M M^T.
        slope_x = min(max(slope_x, -limit_x), limit_x)
        slope_y = min(max(slope_y, -limit_y), limit_y)
        jx, jy = fx / z, jacobian_fy / z
        t1x = jx * (lens[0] - slope_x * lens[8])
        t1y = jx * (lens[1] - slope_x * lens[9])
        t1z = jx * (lens[2] - slope_x * lens[10])
        t2x = jy * (lens[4] - slope_y * lens[8])
        t2y = jy * (lens[5] - slope_y * lens[9])
        t2z = jy * (lens[6] - slope_y * lens[10])
        sx, sy, sz = splats[row, R.SCALE], splats[row, R.SCALE + 1], splats[row, R.SCALE + 2]
        qw, qx, qy, qz = splats[row, R.QUAT], splats[row, R.QUAT + 1], splats[row, R.QUAT + 2], splats[row, R.QUAT + 3]
        r00, r01, r02 = one - two * (qy * qy + qz * qz), two * (qx * qy - qw * qz), two * (qx * qz + qw * qy)
        r10, r11, r12 = two * (qx * qy + qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz - qw * qx)
        r20, r21, r22 = two * (qx * qz - qw * qy), two * (qy * qz + qw * qx), one - two * (qx * qx + qy * qy)
        m11 = (t1x * r00 + t1y * r10 + t1z * r20) * sx
        m12 = (t1x * r01 + t1y * r11 + t1z * r21) * sy
        m13 = (t1x * r02 + t1y * r12 + t1z * r22) * sz
        m21 = (t2x * r00 + t2y * r10 + t2z * r20) * sx
        m22 = (t2x * r01 + t2y * r11 + t2z * r21) * sy
        m23 = (t2x * r02 + t2y * r12 + t2z * r22) * sz
        a = m11 * m11 + m12 * m12 + m13 * m13
        b = m11 * m21 + m12 * m22 + m13 * m23
        c = m21 * m21 + m22 * m22 + m23 * m23
        # The determinant by the cross product of the rows: a c - b^2 loses everything for needles in float32.
        cross_x = m12 * m23 - m13 * m22
        cross_y = m13 * m21 - m11 * m23
        cross_z = m11 * m22 - m12 * m21
        # Its root, because the determinant itself overflows where the eigenvalues are far from it.
        area = _length(_length(cross_x, cross_y), cross_z)
        trace = a + c
        a += low_pass
        c += low_pass
        difference = half * (a - c)
        spread = _length(difference, b)
        lambda1 = half * (a + c) + spread
        lambda2 = area * (area / lambda1) + low_pass * ((trace + low_pass) / lambda1)
        if not lambda2 > zero or lambda1 * zero != zero:
            states[i] = R.INVALID
            continue
        if lambda1 < rules[R.SMALLEST]:
            continue
        opacity *= _compensation(choices, rules, area, lambda1, lambda2)

        # Unit eigenvector of lambda1, without the cancellation in lambda1 - a.
        kind = choices[R.AXES]
        is_undefined = kind == R.AXES_UNDEFINED and b == zero and a >= c
        if (kind == R.AXES_ALIGNED and abs(b) <= f(0.001)) or spread == zero:
            ex, ey = (one, zero) if a >= c else (zero, one)
        elif difference >= zero:
            ex, ey = difference + spread, b
        else:
            ex, ey = b, spread - difference
        norm = _length(ex, ey)
        ex, ey = ex / norm, ey / norm
        axis1 = min(np.sqrt(two * lambda1), rules[R.AXIS_CAP])
        axis2 = min(np.sqrt(two * lambda2), rules[R.AXIS_CAP])
        if choices[R.CULLS_EXTENT]:
            # Quads reach to q = 4, twice sqrt(2 lambda).
            reach = two * two * axis1
            if abs(ndc_x) - reach / width > one or abs(ndc_y) - reach / height > one:
                continue
        red = max(splats[row, R.COLOR], rules[R.COLOR_FLOOR])
        green = max(splats[row, R.COLOR + 1], rules[R.COLOR_FLOOR])
        blue = max(splats[row, R.COLOR + 2], rules[R.COLOR_FLOOR])
        ux, uy = ex / axis1, ey / axis1
        vx, vy = ey / axis2, -ex / axis2
        if not opacity >= rules[R.ALPHA_FLOOR] or opacity == zero:
            continue
        if choices[R.GAMMA]:
            red, green, blue = _to_linear(red, rules), _to_linear(green, rules), _to_linear(blue, rules)

        # q = (s dx + k dy)^2 + (h dy)^2: for a row of pixels, one square in dx.
        s = np.sqrt(ux * ux + vx * vx)
        k = (ux * uy + vx * vy) / s
        h = abs(ux * vy - uy * vx) / s
        if not (s > zero and h > zero and (s + h + k) * zero == zero):
            states[i] = R.INVALID
            continue
        q = rules[R.CUTOFF]
        if rules[R.ALPHA_FLOOR] > zero:
            q = min(q, np.log(opacity * (one + f(_SLACK)) / rules[R.ALPHA_FLOOR]))
        q = q * (one + f(_SLACK)) + f(_SLACK)
        reach_y = np.sqrt(q) / h
        reach_x = np.sqrt(q) / s * np.sqrt(one + (k / h) * (k / h))
        low_x, high_x = center_x - reach_x, center_x + reach_x
        low_y, high_y = center_y - reach_y, center_y + reach_y
        if choices[R.FOOTPRINT] == R.FOOTPRINT_TILES:
            tile = f(_TILE)
            radius = np.ceil(f(3) * np.sqrt(half * (a + c) + max(np.sqrt(f(0.1)), spread)))
            # That rasterizer numbers pixels by their centers, half a pixel less than ours.
            low_x = max(low_x, np.floor((center_x - half - radius) / tile) * tile)
            low_y = max(low_y, np.floor((center_y - half - radius) / tile) * tile)
            high_x = min(high_x, np.floor((center_x - half + radius + tile - one) / tile) * tile)
            high_y = min(high_y, np.floor((center_y - half + radius + tile - one) / tile) * tile)
        x_start = np.int32(min(max(low_x, zero), width))
        y_start = np.int32(min(max(low_y, zero), height))
        x_stop = np.int32(min(np.ceil(high_x), width)) if high_x > zero else np.int32(0)
        y_stop = np.int32(min(np.ceil(high_y), height)) if high_y > zero else np.int32(0)
        if x_start >= x_stop or y_start >= y_stop:
            continue
        states[i] = R.DRAWN + R.EIGENVECTOR_UNDEFINED if is_undefined else R.DRAWN
        bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = x_start, x_stop, y_start, y_stop
        records[i, R.REC_X], records[i, R.REC_Y] = center_x, center_y
        records[i, R.REC_S], records[i, R.REC_K], records[i, R.REC_H] = s, k, h
        records[i, R.REC_Q] = q
        records[i, R.REC_OPACITY] = opacity
        records[i, R.REC_R] = red * rules[R.BRIGHTNESS]
        records[i, R.REC_G] = green * rules[R.BRIGHTNESS]
        records[i, R.REC_B] = blue * rules[R.BRIGHTNESS]
        records[i, R.REC_UX], records[i, R.REC_UY] = ux, uy
        records[i, R.REC_VX], records[i, R.REC_VY] = vx, vy
        clip = one
        if rules[R.ALPHA_FLOOR] > zero:
            clip = min(one, half * np.sqrt(max(zero, np.log(opacity / rules[R.ALPHA_FLOOR]))))
        records[i, R.REC_BOX] = two * clip * rules[R.SCALE_FACTOR]
