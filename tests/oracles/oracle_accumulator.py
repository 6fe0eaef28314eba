"""Spark's accumulator: every splat as it is re-packed before drawing, and how close each rounding was to a tie."""

import numpy as np

LN_MIN, LN_MAX = -12.0, 9.0


class Ties:
    """Smallest distance of any rounded number to a tie, in steps."""

    def __init__(self):
        self.margin = np.inf

    def round(self, value, low, high):
        """Round half up and clamp."""
        if low < value < high:
            self.margin = min(self.margin, abs(value - np.floor(value) - 0.5))
        return float(np.clip(np.floor(value + 0.5), low, high))

    def half(self, value):
        """Round to float16, ties to even."""
        with np.errstate(over="ignore"):
            rounded = np.float16(value)
        if np.isfinite(rounded):
            step = 2.0 ** (max(np.frexp(value)[1] - 1, -14) - 10) if value else 1.0
            self.margin = min(self.margin, abs(value / step - np.floor(value / step) - 0.5))
            if np.float16(np.float32(value)) != rounded:
                self.margin = 0.0  # a target that computes in float32 rounds twice
        return float(rounded)


def requantize(accumulator, offset, log_scales, quat, opacity, color):
    """Return (offset, scales, unit quat, opacity, color, tie margin) after packing and unpacking one splat.

    offset        center minus camera, world axes
    accumulator   "packed": half centers, 8-bit color, opacity (times 0.5), ln scale and rotation;
                  "ext": half color, opacity and ln scale, 10-10-12 rotation; "none": nothing
    """
    scales = np.exp(np.asarray(log_scales, np.float64))
    quat = np.asarray(quat, np.float64)
    length = np.linalg.norm(quat)
    quat = quat / length if length > 0 else np.array([1.0, 0, 0, 0])
    ties = Ties()
    if accumulator == "packed":
        offset = np.array([ties.half(value) for value in offset])
        color = np.array([ties.round(value * 255, 0, 255) / 255 for value in color])
        opacity = ties.round(opacity * 0.5 * 255, 0, 255) / 255 * 2
        scales = np.array([_log_byte(scale, ties) for scale in scales])
        quat = _octahedral(quat, 255, 255, ties)
    elif accumulator == "ext":
        color = np.array([ties.half(value) for value in color])
        opacity = ties.half(opacity)
        scales = np.array([np.exp(ties.half(np.log(scale))) if scale > 0 else 0.0 for scale in scales])
        quat = _octahedral(quat, 1023, 4095, ties)
    return np.asarray(offset), scales, quat, opacity, np.asarray(color), ties.margin


def _log_byte(scale, ties):
    """Return a scale through the 8-bit logarithm; byte 0 is flat."""
    if scale < np.exp(-30.0):
        return 0.0
    byte = np.clip(ties.round((np.log(scale) - LN_MIN) * 254 / (LN_MAX - LN_MIN), -1e9, 1e9) + 1, 1, 255)
    return float(np.exp(LN_MIN + (byte - 1) * (LN_MAX - LN_MIN) / 254))


def _octahedral(quat, axis_steps, angle_steps, ties):
    """Return a unit quaternion through the octahedral axis and the angle."""
    if quat[0] < 0:
        quat = -quat
    angle = ties.round(2 * np.arctan2(np.linalg.norm(quat[1:]), quat[0]) * angle_steps / np.pi, 0, angle_steps)
    if angle == 0:
        return np.array([1.0, 0, 0, 0])
    ties.margin = min(ties.margin, abs(quat[0]))
    axis = quat[1:] / np.linalg.norm(quat[1:])
    px, py = axis[:2] / np.abs(axis).sum()
    if axis[2] < 0:
        ties.margin = min(ties.margin, abs(px), abs(py))
        px, py = (1 - abs(py)) * (1 if px >= 0 else -1), (1 - abs(px)) * (1 if py >= 0 else -1)
    u = ties.round((px / 2 + 0.5) * axis_steps, 0, axis_steps)
    v = ties.round((py / 2 + 0.5) * axis_steps, 0, axis_steps)

    fx, fy = 2 * u / axis_steps - 1, 2 * v / axis_steps - 1
    fz = 1 - abs(fx) - abs(fy)
    t = max(-fz, 0)
    fx += -t if fx >= 0 else t
    fy += -t if fy >= 0 else t
    axis = np.array([fx, fy, fz]) / np.linalg.norm([fx, fy, fz])
    theta = np.pi * angle / angle_steps
    return np.concatenate([[np.cos(theta / 2)], axis * np.sin(theta / 2)])
