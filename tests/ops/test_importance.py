"""Weights grow with opacity and area, within a range."""

import numpy as np

from gsplat_tools.ops.importance import WEIGHT_RANGE, importance, log_weights, top_weight, weights_of
from tests.clouds import random_cloud


def test_importance__is_opacity_times_the_two_largest_scales() -> None:
    cloud = random_cloud(4).replace(
        log_scales=np.log(np.float32([(1, 2, 4), (4, 1, 2), (0.001, 2, 4), (1, 1, 1)])),
        opacity_logits=np.float32([0, 0, 0, 0]),
    )

    weights = importance(cloud)

    assert np.allclose(weights / weights[0], [1, 1, 1, 1 / 8], rtol=1e-5)


def test_importance__halves_with_the_opacity() -> None:
    logits = np.float32([np.log(3), np.log(0.6)])  # opacities 0.75 and 0.375
    cloud = random_cloud(2).replace(log_scales=np.zeros((2, 3)), opacity_logits=logits)

    weights = importance(cloud)

    assert weights.max() == 1
    assert np.isclose(weights.min(), 0.5) or np.isclose(weights[0], weights[1])


def test_importance__stays_in_range_whatever_comes() -> None:
    cloud = random_cloud(300)
    log_scales, logits = cloud.log_scales.copy(), cloud.opacity_logits.copy()
    log_scales[0], logits[1], logits[2], log_scales[3] = -np.inf, -np.inf, np.inf, 80

    weights = importance(cloud.replace(log_scales=log_scales, opacity_logits=logits))

    assert np.isfinite(weights).all()
    assert weights.max() == 1
    assert weights.min() >= 1 / WEIGHT_RANGE * 0.999
    assert weights[3] == 1
    assert importance(cloud.take(slice(0, 0))).size == 0


def test_weights_of_pieces__are_those_of_all() -> None:
    cloud = random_cloud(3000)
    logs = [log_weights(cloud.take(slice(start, start + 700))) for start in range(0, 3000, 700)]
    top = top_weight(np.concatenate(logs[::-1]))
    assert np.array_equal(np.concatenate([weights_of(part, top) for part in logs]), importance(cloud))
