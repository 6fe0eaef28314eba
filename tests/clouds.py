"""Clouds for tests: small, seeded, with the awkward values that real scenes have."""

from __future__ import annotations

import numpy as np

from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud


def random_cloud(count: int, *, sh_degree: int = 3, seed: int = 0, motion: bool = False) -> GaussianCloud:
    """A blob of splats: needles, discs and balls, flat axes, opacities from faint to saturated, non-unit quaternions."""
    rng = np.random.default_rng(seed)
    log_scales = rng.uniform(-7.0, -1.0, (count, 3)).astype(np.float32)
    log_scales[rng.random(count) < 0.1, 2] = -12.5
    logits = rng.normal(0.0, 3.0, count).astype(np.float32)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    quats *= rng.uniform(0.5, 2.0, (count, 1)).astype(np.float32)
    moving = {
        "velocities": rng.normal(0, 0.2, (count, 3)).astype(np.float32),
        "times": rng.uniform(0, 0.5, count).astype(np.float32),
        "durations": rng.uniform(0.1, 0.5, count).astype(np.float32),
    }
    return GaussianCloud(
        means=rng.normal(0.0, 1.0, (count, 3)).astype(np.float32),
        log_scales=log_scales,
        quats=quats,
        opacity_logits=logits,
        sh0=rng.normal(0.0, 0.9, (count, 3)).astype(np.float32),
        shN=rng.normal(0.0, 0.15, (count, REST_COEFFICIENTS[sh_degree], 3)).astype(np.float32),
        **(moving if motion else {}),
    )
