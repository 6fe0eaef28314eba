"""What each target shows of one splat: opacity over the whole image, and how close every decision was.

Every function takes the splat (a dict), the camera, the pixel centers px, py (H, W) and options, and returns a
Fragment, or None where the splat lies at or behind the camera. `margin` (H, W) is the smallest relative distance to a
threshold of any decision that changes the pixel.
"""

from dataclasses import dataclass

import numpy as np

from tests.oracles import oracle_accumulator, oracle_sh
from tests.oracles.oracle_projection import Projected


@dataclass
class Fragment:
    """One splat over the image."""

    color: np.ndarray
    alpha: np.ndarray
    margin: np.ndarray
    has_axes: bool = True


def _distance(value, threshold):
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        return np.abs(np.asarray(value) / threshold - 1)


def _view(splat, camera):
    return camera.rotation @ splat["mean"] + camera.viewmat[:3, 3]


def _color(splat, camera, degree, *, quarter_bug=False):
    return oracle_sh.color(splat["sh0"], splat["shN"], splat["mean"] - camera.position, degree, quarter_bug=quarter_bug)


def _fragment(color, raw, shown, is_visible, pixel_margin, splat_margin, floor, *, has_axes=True):
    """Assemble: margins count only where the splat would change the pixel by more than nothing."""
    matters = raw >= floor
    margin = np.where(matters, np.minimum(pixel_margin, splat_margin), np.inf)
    return Fragment(color, np.where(shown & is_visible, raw, 0.0), margin, has_axes)


def inria(splat, camera, px, py, options):
    """The original 3DGS rasterizer."""
    view = _view(splat, camera)
    if view[2] <= 0:
        return None
    p = Projected(camera, view, np.exp(splat["log_scales"]), splat["quat"], 0.3, tangent_limit=1.3)
    opacity = splat["opacity"]
    if options["antialiased"]:
        opacity *= np.sqrt(max(0.000025, p.det_raw / p.det))
    lambda1 = p.mid + np.sqrt(max(0.1, p.mid**2 - p.det))
    radius = np.ceil(3 * np.sqrt(lambda1))
    lows, highs = (p.center - 0.5 - radius) / 16, (p.center - 0.5 + radius + 15) / 16
    shown = np.ones(px.shape, bool)
    for pixels, low, high in zip((px, py), lows, highs, strict=True):
        tiles = np.floor(pixels / 16)
        shown &= (tiles >= np.floor(low)) & (tiles < np.floor(high))
    raw = np.minimum(0.99, opacity * np.exp(-p.mahalanobis(px - p.center[0], py - p.center[1]) / 2))
    shown &= raw >= 1 / 255
    edges = np.concatenate([lows, highs, [3 * np.sqrt(lambda1)]])
    splat_margin = min(_distance(view[2], 0.2), np.min(np.abs(edges - np.round(edges))))
    color = np.maximum(0, _color(splat, camera, options["degree"]))
    return _fragment(color, raw, shown, view[2] > 0.2, _distance(raw, 1 / 255), splat_margin, 0.5 / 255)


def unity(splat, camera, px, py, options):
    """gsplat-unity; variants "1.0", "1.2.1" and "fork-4d"."""
    view = _view(splat, camera)
    if view[2] <= 0:
        return None
    p = Projected(camera, view, np.exp(splat["log_scales"]), splat["quat"], 0.075, shared_focal=True)
    opacity = splat["opacity"]
    if options["antialiased"]:
        opacity *= np.sqrt(max(0.0, p.det_raw / p.det))
    cap = min(1024, camera.width, camera.height)
    major = min(2 * np.sqrt(2 * p.lambda1), cap)
    minor = min(2 * np.sqrt(2 * max(p.lambda2, 0.025)), cap)
    axis, has_axes = p.major_axis()
    dx, dy = px - p.center[0], py - p.center[1]
    u = (dx * axis[0] + dy * axis[1]) / major
    v = (dx * axis[1] - dy * axis[0]) / minor
    a = u * u + v * v
    m = np.maximum(np.abs(u), np.abs(v))
    s = options["scale_factor"]
    if options["variant"] == "1.0":
        falloff = np.exp(-4 * a)
    elif options["variant"] == "1.2.1":
        # Clamped beyond the quad, where nothing is shown and the second term overflows.
        falloff = np.exp(-4 * a) - np.exp((np.minimum(m, 2.0) - 1.16 * s) * 25 * s)
    else:
        falloff = np.maximum(np.exp(-4 * a) - np.exp(-4), 0) / (1 - np.exp(-4))
    clip = min(1.0, np.sqrt(np.log(255 * opacity)) / 2) if 255 * opacity >= 1 else 1.0
    raw = opacity * falloff
    shown = (a <= 1) & (m <= clip * s) & (raw >= 1 / 255)
    extent = 2 * major / np.array([camera.width, camera.height])
    is_visible = view[2] <= camera.far and (np.abs(p.ndc) - extent <= 1).all() and not (major < 1 and minor < 1)
    splat_margin = min(_distance(view[2], camera.far), _distance(p.lambda1, 0.125))
    pixel_margin = np.minimum(np.minimum(_distance(raw, 1 / 255), _distance(a, 1)), _distance(m, clip * s))
    color = _color(splat, camera, options["degree"], quarter_bug=True) * options["brightness"]
    return _fragment(color, raw, shown, is_visible, pixel_margin, splat_margin, 0.5 / 255, has_axes=has_axes)


def spark(splat, camera, px, py, options):
    """Spark 2; variants name the accumulator: "packed", "ext" and "none"."""
    # Negative colors are cut as wherever SH are decoded; a stock target, 8 bits deep, cuts them at the latest.
    color = np.maximum(0, _color(splat, camera, min(options["degree"], 3)))
    offset, scales, quat, opacity, color, ties = oracle_accumulator.requantize(
        options["variant"],
        splat["mean"] - camera.position,
        splat["log_scales"],
        splat["quat"],
        splat["opacity"],
        color,
    )
    view = camera.rotation @ offset
    if view[2] <= 0:
        return None
    p = Projected(camera, view, scales, quat, 0.3)
    opacity *= np.sqrt(max(0.0, p.det_raw / p.det))
    if abs(p.b) <= 0.001:
        axis = np.array([1.0, 0.0]) if p.a >= p.c else np.array([0.0, 1.0])
    else:
        axis, _ = p.major_axis()
    major, minor = (min(512.0, np.sqrt(8 * max(value, 0))) for value in (p.lambda1, p.lambda2))
    dx, dy = px - p.center[0], py - p.center[1]
    u = (dx * axis[0] + dy * axis[1]) / major
    v = (dx * axis[1] - dy * axis[0]) / minor
    d2 = 8 * (u * u + v * v)
    raw = opacity * np.exp(-d2 / 2)
    shown = (d2 <= 8) & (raw >= 0.5 / 255)
    is_visible = camera.near < view[2] < camera.far and (np.abs(p.ndc) <= 1.4).all()
    splat_margin = min(
        ties,
        _distance(view[2], camera.near),
        _distance(view[2], camera.far),
        np.min(_distance(np.abs(p.ndc), 1.4)),
        _distance(abs(p.b), 0.001),
    )
    pixel_margin = np.minimum(_distance(raw, 0.5 / 255), _distance(d2, 8))
    return _fragment(color, raw, shown, is_visible, pixel_margin, splat_margin, 0.25 / 255)


CUTOFF = np.sqrt(np.log(255))


def visionary(splat, camera, px, py, options):
    """Visionary's WebGPU pipeline; variant "half" stores the 24-byte record on the way, "float" does not."""
    view = _view(splat, camera)
    if view[2] <= 0:
        return None
    k = options["kernel_size"]
    p = Projected(camera, view, np.exp(splat["log_scales"]), splat["quat"], k)
    d0, d1 = max(1e-6, p.det_raw), max(1e-6, p.det)
    compensation = 0.0 if d0 <= 1e-6 or d1 <= 1e-6 else np.sqrt(d0 / (d1 + 1e-6) + 1e-6)
    opacity = splat["opacity"] * compensation
    axis, has_axes = p.major_axis()
    v1 = np.sqrt(2 * p.lambda1) * axis
    v2 = np.sqrt(2 * max(p.lambda2, 0.1)) * np.array([axis[1], -axis[0]])
    color = np.maximum(0, _color(splat, camera, min(options["degree"], 3)))
    center = p.center
    ties = oracle_accumulator.Ties()
    if options["variant"] == "half":
        size = np.array([camera.width, camera.height])
        half = np.vectorize(ties.half)
        v1, v2 = half(v1 / size) * size, half(v2 / size) * size
        center = (half(p.ndc) + 1) / 2 * size
        color, opacity = half(color), ties.half(opacity)
    dx, dy = px - center[0], py - center[1]
    area = v1[0] * v2[1] - v1[1] * v2[0]
    p1, p2 = (dx * v2[1] - dy * v2[0]) / area, (dy * v1[0] - dx * v1[1]) / area
    q = p1 * p1 + p2 * p2
    raw = np.minimum(0.99, opacity * np.exp(-q))
    shown = (q <= 2 * CUTOFF) & (np.abs(p1) <= CUTOFF) & (np.abs(p2) <= CUTOFF)
    is_visible = camera.near < view[2] < camera.far and (np.abs(p.ndc) <= 1.2).all() and splat["opacity"] >= 0.02
    splat_margin = min(
        ties.margin,
        _distance(view[2], camera.near),
        _distance(view[2], camera.far),
        np.min(_distance(np.abs(p.ndc), 1.2)),
        _distance(splat["opacity"], 0.02),
        # sqrt(1e-6) of the opacity comes and goes at this determinant.
        _distance(p.det_raw, 1e-6),
    )
    return _fragment(color, raw, shown, is_visible, _distance(q, 2 * CUTOFF), splat_margin, 1e-7, has_axes=has_axes)


MODELS = {"inria": inria, "unity": unity, "spark": spark, "visionary": visionary}
MAX_DEGREE = {"inria": 4, "unity": 4, "spark": 3, "visionary": 3}
