"""A keyframe sequence at a time, splat by splat, as the rules of the .sog4d format read."""

import bisect
import math

import numpy as np


def evaluate(frames, t, times=None, interpolation="linear"):
    """Evaluate a list of dicts of arrays at normalized time t; opacities come after the sigmoid."""
    first, second, fraction = _bracket(len(frames), t, times)
    if interpolation == "nearest":
        fraction = 0.0
    a, b = frames[first], frames[second]
    if fraction == 0.0:
        b = a
    result = {name: [] for name in ("means", "log_scales", "quats", "opacities", "sh0", "shN")}
    for i in range(len(a["means"])):
        for name in ("means", "sh0", "shN"):
            result[name].append((1 - fraction) * a[name][i].astype(float) + fraction * b[name][i].astype(float))
        result["log_scales"].append(_scales(a["log_scales"][i], b["log_scales"][i], fraction))
        result["quats"].append(_rotation(a["quats"][i].astype(float), b["quats"][i].astype(float), fraction))
        opacity = (1 - fraction) * _sigmoid(a["opacity_logits"][i]) + fraction * _sigmoid(b["opacity_logits"][i])
        result["opacities"].append(0.0 if opacity < 1 / 255 - 1e-8 else opacity)
    return {name: np.array(values) for name, values in result.items()}


def _bracket(count, t, times):
    """Keyframes before and after t, and how far t is between them."""
    last = count - 1
    if last == 0:
        return 0, 0, 0.0
    if times is None:
        u = min(max(t, 0.0), 1.0) * last
        first = min(math.floor(u), last)
        return first, min(first + 1, last), u - first
    if t <= times[0]:
        return 0, 0, 0.0
    if t >= times[-1]:
        return last, last, 0.0
    second = bisect.bisect_right(times, t)
    span = times[second] - times[second - 1]
    return second - 1, second, (t - times[second - 1]) / span if span > 0 else 0.0


def _scales(a, b, fraction):
    """Logs of scales of at least 1e-8, interpolated; a stored frame stays as it is."""
    if fraction == 0.0:
        return a.astype(float)
    floor = math.log(1e-8)
    return (1 - fraction) * np.maximum(a.astype(float), floor) + fraction * np.maximum(b.astype(float), floor)


def _rotation(a, b, fraction):
    """Normalized interpolation on the hemisphere of the first."""
    if np.dot(a, b) < 0:
        b = -b
    mixed = (1 - fraction) * a + fraction * b
    norm = np.linalg.norm(mixed)
    return mixed / norm if norm >= 1e-8 else np.array([1.0, 0, 0, 0])


def _sigmoid(logit):
    logit = float(logit)
    if logit == -math.inf:
        return 0.0
    return 1 / (1 + math.exp(-logit)) if logit > -700 else 0.0
