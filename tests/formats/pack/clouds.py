"""Clouds for the tests of packs."""

import numpy as np

from gsplat_tools.cloud import GaussianCloud


def make_cloud(count, degree, seed=0, *, has_motion=False, **metadata):
    """Ordinary values: nothing that a pack clamps with the default ranges."""
    rng = np.random.default_rng(seed)
    motion = {}
    if has_motion:
        motion = {
            "velocities": rng.normal(0, 0.5, (count, 3)),
            "times": rng.uniform(0, 1, count),
            "durations": rng.uniform(0, 1, count),
        }
    return GaussianCloud(
        means=rng.normal(0, 20, (count, 3)),
        log_scales=rng.uniform(-11, 2, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        opacity_logits=rng.normal(0, 3, count),
        sh0=rng.uniform(-1.7, 1.7, (count, 3)),
        shN=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2 - 1, 3)),
        **motion,
        **metadata,
    )


def relative_covariance_errors(a, b):
    """||Sigma_b - Sigma_a|| / ||Sigma_a|| for two clouds, in float64."""

    def covariances(cloud):
        w, x, y, z = (cloud.quats.astype(np.float64) / np.linalg.norm(cloud.quats.astype(np.float64), axis=1, keepdims=True)).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        axes = np.array(rows).transpose(2, 0, 1) * np.exp(cloud.log_scales.astype(np.float64))[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    first = covariances(a)
    return np.linalg.norm(covariances(b) - first, axis=(1, 2)) / np.linalg.norm(first, axis=(1, 2))
