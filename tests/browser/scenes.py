"""Cameras and scenes of the browser tests."""

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.reference.camera import Camera


def looking_at_origin(width: int, height: int) -> Camera:
    """Return a camera four units from the origin, a little above it."""
    return Camera.look_at((0.6, -0.8, -4.0), (0.0, 0.0, 0.0), fov_y=45.0, width=width, height=height)


def make_scene(degree):
    """Return a cloud that looks like something: a ground, a ball on it and a tuft of needles, opaque to faint."""
    rng = np.random.default_rng(20260601)
    ground = np.stack([rng.uniform(-2, 2, 1200), np.full(1200, 0.6), rng.uniform(-2, 2, 1200)], 1)
    ball = rng.normal(size=(1200, 3))
    ball *= 0.6 / np.linalg.norm(ball, axis=1, keepdims=True)
    needles = np.array([0.9, 0.5, -0.3]) + rng.normal(0, [0.15, 0.3, 0.15], (300, 3))
    means = np.concatenate([ground, ball, needles])
    flat, thin = rng.uniform(-4, -2.5, (2400, 3)), rng.uniform(-6.5, -5, (300, 3))
    flat[:1200, 1], thin[:, 0] = -7, rng.uniform(-2.5, -1.5, 300)
    colors = np.concatenate([0.3 + 0.1 * np.sin(4 * ground), 0.5 + ball / 1.3, np.tile([0.2, 0.7, 0.15], (300, 1))])
    return GaussianCloud(
        means=means.astype(np.float32),
        log_scales=np.concatenate([flat, thin]).astype(np.float32),
        quats=np.where(np.arange(2700)[:, None] < 1200, [1.0, 0, 0, 0], rng.normal(size=(2700, 4))).astype(np.float32),
        opacity_logits=rng.uniform(-3, 8, 2700).astype(np.float32),
        sh0=((colors - 0.5) / 0.28209479177387814).astype(np.float32),
        shN=rng.normal(0, 0.15, (2700, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    )
