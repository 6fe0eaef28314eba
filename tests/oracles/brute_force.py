"""Every splat at every pixel: what a target would show, slowly and plainly, in float64."""

from dataclasses import dataclass

import numpy as np

from tests.oracles.oracle_models import MAX_DEGREE, MODELS
from tests.oracles.oracle_projection import Camera

DEFAULT_VARIANTS = {"inria": None, "unity": "1.2.1", "spark": "packed", "visionary": "half"}


@dataclass
class Picture:
    """Image (H, W, 3), alphas (H, W), and per pixel the smallest relative distance to any threshold.

    num_undefined counts the drawn splats whose axes a GPU leaves undefined; order lists the splats as they were drawn.
    """

    image: np.ndarray
    alphas: np.ndarray
    margin: np.ndarray
    num_undefined: int
    order: np.ndarray


def render_oracle(
    splats,
    camera: Camera,
    model,
    variant=None,
    *,
    background=(0.0, 0.0, 0.0),
    sh_degree=None,
    scale_factor=1.0,
    brightness=1.0,
    kernel_size=0.1,
    antialiased=False,
    framebuffer="float",
    order=None,
    t=None,
):
    """Render a dict of arrays: means, log_scales, quats, opacity_logits, sh0, shN, and motion where t is given."""
    means = np.asarray(splats["means"], np.float64)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-np.asarray(splats["opacity_logits"], np.float64)))
    if t is not None:
        means, opacities = _at_time(splats, means, opacities, t)
    if order is None:
        order = draw_order(means, camera, model)
    degree = min(int(np.sqrt(splats["shN"].shape[1] + 1)) - 1, MAX_DEGREE[model])
    options = {
        "variant": DEFAULT_VARIANTS[model] if variant is None else variant,
        "degree": degree if sh_degree is None else min(sh_degree, degree),
        "scale_factor": scale_factor,
        "brightness": brightness,
        "kernel_size": kernel_size,
        "antialiased": antialiased,
    }
    px, py = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    fragments = []
    for i in order:
        splat = {
            "mean": means[i],
            "log_scales": np.asarray(splats["log_scales"][i], np.float64),
            "quat": np.asarray(splats["quats"][i], np.float64),
            "opacity": opacities[i],
            "sh0": splats["sh0"][i],
            "shN": splats["shN"][i],
        }
        fragments.append(MODELS[model](splat, camera, px, py, options) if opacities[i] > 0 else None)
    fragments = [fragment for fragment in fragments if fragment is not None]
    background = np.asarray(background, np.float64)
    if model == "inria":
        # The draw order is far first, as for the others; this model goes through it from the other end.
        image, alphas, margin = _front_to_back(fragments[::-1], px.shape, background)
    else:
        image, alphas, margin = _back_to_front(fragments, px.shape, background, framebuffer)
    drawn = [fragment for fragment in fragments if fragment.alpha.any()]
    return Picture(image, alphas, margin, sum(not fragment.has_axes for fragment in drawn), np.asarray(order))


def draw_order(means, camera, model):
    """Return splat indices, far first; ties keep the index order of the model's own direction."""
    if model == "spark":
        keys = np.linalg.norm(means - camera.position, axis=1)
    else:
        keys = means @ camera.rotation[2] + camera.viewmat[2, 3]
    if model == "inria":
        return np.argsort(keys.astype(np.float32), kind="stable")[::-1]
    return np.argsort(-keys.astype(np.float32), kind="stable")


def _at_time(splats, means, opacities, t):
    """Return means and opacities at a normalized time; hidden splats get opacity 0."""
    since = t - np.asarray(splats["times"], np.float64)
    spans = np.asarray(splats["durations"], np.float64)
    means = means + np.asarray(splats["velocities"], np.float64) * since[:, None]
    if splats.get("time_model", "window") == "window":
        return means, np.where((since >= 0) & (since <= spans), opacities, 0.0)
    weights = np.exp(-0.5 * (since / spans) ** 2)
    return means, np.where(weights >= 0.01, opacities * weights, 0.0)


def _front_to_back(fragments, shape, background):
    """Composite near splats first; a pixel stops before the splat that would leave less than 1e-4."""
    image, transmittance = np.zeros((*shape, 3)), np.ones(shape)
    is_open, margin = np.ones(shape, bool), np.full(shape, np.inf)
    for fragment in fragments:
        margin = np.where(is_open, np.minimum(margin, fragment.margin), margin)
        after = transmittance * (1 - fragment.alpha)
        is_hit = is_open & (fragment.alpha > 0)
        margin = np.where(is_hit, np.minimum(margin, np.abs(after / 1e-4 - 1)), margin)
        is_open &= ~(is_hit & (after < 1e-4))
        is_hit &= is_open
        image += np.where(is_hit, fragment.alpha * transmittance, 0)[..., None] * fragment.color
        transmittance = np.where(is_hit, after, transmittance)
    return image + transmittance[..., None] * background, 1 - transmittance, margin


def _back_to_front(fragments, shape, background, framebuffer):
    """Composite far splats first, premultiplied over; "unorm8" clamps and rounds as an 8-bit target does."""
    quantizes = framebuffer == "unorm8"
    image, alphas, margin = np.tile(background, (*shape, 1)), np.zeros(shape), np.full(shape, np.inf)
    if quantizes:
        image = _to_8_bits(image)
    for fragment in fragments:
        margin = np.minimum(margin, fragment.margin)
        source = fragment.color * fragment.alpha[..., None]
        source_alpha = fragment.alpha
        if quantizes:
            source, source_alpha = np.clip(source, 0, 1), np.clip(source_alpha, 0, 1)
        image = source + image * (1 - source_alpha)[..., None]
        alphas = source_alpha + alphas * (1 - source_alpha)
        if quantizes:
            # Where nothing is drawn, nothing is blended and rounding again changes nothing.
            image, alphas = _to_8_bits(image), _to_8_bits(alphas)
    return image, alphas, margin


def _to_8_bits(values):
    return np.round(np.clip(values, 0, 1) * 255) / 255
