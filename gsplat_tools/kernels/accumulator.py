"""What Spark does to every splat before it draws it: a pass that packs splats anew, relative to the camera.

Source: packSplatEncoding, packSplatExt and their inverses in the shaders of @sparkjsdev/spark 2.2.0.
"""

import math

import numpy as np

from gsplat_tools.kernels import rules as R
from gsplat_tools.kernels._jit import device, kernel
from gsplat_tools.kernels.half_floats import round_to_half

PACKED, EXTENDED = 0, 1

_LN_MIN = -12.0
_LN_RANGE = 21.0
_LN_STEPS = 254.0
_MIN_SIN = 1e-6


@device()
def _requantize_rotation(splats, row, axis_steps, angle_steps):
    """Round a unit quaternion through the octahedral code of its axis and the code of its angle."""
    f = splats.dtype.type
    one, two, half = f(1), f(2), f(0.5)
    w, x = splats[row, R.QUAT], splats[row, R.QUAT + 1]
    y, z = splats[row, R.QUAT + 2], splats[row, R.QUAT + 3]
    if w < f(0):
        w, x, y, z = -w, -x, -y, -z
    sine = np.sqrt(x * x + y * y + z * z)
    # Not acos of w: near the identity that is 1 - w, rounded.
    angle = f(2.0 * math.atan2(np.float64(sine), np.float64(w)))
    if sine < f(_MIN_SIN):
        x, y, z = one, f(0), f(0)
    total = abs(x) + abs(y) + abs(z)
    px, py = x / total, y / total
    if z < f(0):
        folded = (one - abs(py)) * (one if px >= f(0) else -one)
        py = (one - abs(px)) * (one if py >= f(0) else -one)
        px = folded
    px = two * (np.floor((px * half + half) * axis_steps + half) / axis_steps) - one
    py = two * (np.floor((py * half + half) * axis_steps + half) / axis_steps) - one
    angle = np.floor(angle / f(np.pi) * angle_steps + half) / angle_steps * f(np.pi)
    pz = one - abs(px) - abs(py)
    fold = max(-pz, f(0))
    px += -fold if px >= f(0) else fold
    py += -fold if py >= f(0) else fold
    scale = f(math.sin(0.5 * np.float64(angle))) / np.sqrt(px * px + py * py + pz * pz)
    splats[row, R.QUAT] = f(math.cos(0.5 * np.float64(angle)))
    splats[row, R.QUAT + 1] = px * scale
    splats[row, R.QUAT + 2] = py * scale
    splats[row, R.QUAT + 3] = pz * scale


@kernel()
def requantize(splats, eye, form):
    """Round splats to what an accumulator of Spark holds; their means become relative to the camera.

    splats  float (M, SPLAT_SIZE)  read and written
    eye     float (3,)             camera in the space of the means
    form    int                    PACKED: half centers, 8-bit colors, scales and angle, 8-8 axis;
                                   EXTENDED: float centers, half colors and log scales, 12-bit angle, 10-10 axis
    """
    f = splats.dtype.type
    zero, one, half, bytes_ = f(0), f(1), f(0.5), f(255)
    for row in range(len(splats)):
        if form == PACKED:
            for c in range(3):
                splats[row, R.MEAN + c] = f(round_to_half(splats[row, R.MEAN + c] - eye[c]))
                color = splats[row, R.COLOR + c]
                # Clamping would make a color of what is none; projection counts it as invalid.
                if color * zero == zero:
                    splats[row, R.COLOR + c] = np.floor(min(max(color, zero), one) * bytes_ + half) / bytes_
                scale = splats[row, R.SCALE + c]
                if scale > zero and scale < f(np.inf):
                    code = np.floor((math.log(np.float64(scale)) - _LN_MIN) * (_LN_STEPS / _LN_RANGE) + 0.5)
                    code = min(max(code, 0.0), _LN_STEPS)
                    splats[row, R.SCALE + c] = f(math.exp(_LN_MIN + code * (_LN_RANGE / _LN_STEPS)))
            # Half the opacity in 8 bits, so that opacities up to 2 fit.
            splats[row, R.OPACITY] = np.floor(half * splats[row, R.OPACITY] * bytes_ + half) / bytes_ * f(2)
            _requantize_rotation(splats, row, bytes_, bytes_)
        else:
            for c in range(3):
                splats[row, R.MEAN + c] -= eye[c]
                splats[row, R.COLOR + c] = f(round_to_half(splats[row, R.COLOR + c]))
                scale = splats[row, R.SCALE + c]
                if scale > zero and scale < f(np.inf):
                    splats[row, R.SCALE + c] = f(math.exp(np.float64(round_to_half(math.log(np.float64(scale))))))
            splats[row, R.OPACITY] = f(round_to_half(splats[row, R.OPACITY]))
            _requantize_rotation(splats, row, f(1023), f(4095))
