"""What a visual tolerance decides besides codes: entries of the color codebook and steps of rotations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsplat_tools.formats.sog4d import Sog4dOptions, balancing
from gsplat_tools.formats.sog4d.codebooks import fit_shared
from gsplat_tools.formats.sog4d.sampling import draw_sample
from gsplat_tools.ops.ordering import order_splats
from gsplat_tools.ops.visibility import VisibleCosts
from tests.clouds import random_cloud


def chosen(**options: Any) -> tuple[int, int]:
    """Return entries of colors, counted in the codebook, and steps of rotations that a scene is written with."""
    cloud = random_cloud(1500, sh_degree=0)
    cloud = order_splats(cloud.replace(log_scales=np.maximum(cloud.log_scales, -9.0)), "morton")
    shared = fit_shared(draw_sample([cloud], 1, 0), cloud, Sog4dOptions(**options), (39, 39))
    assert shared.options.rotation_steps is not None
    return len(np.unique(shared.sh0_codebook)), shared.options.rotation_steps


def costs(count: int, **changes: float) -> VisibleCosts:
    names = ("position", "scale", "opacity", "color", "harmonics")
    values = {name: np.full(count, changes.get(name, 1.0)) for name in names}
    return VisibleCosts(**values, rotation=np.full((count, 3), changes.get("rotation", 1.0)))


def test_sizes__are_the_defaults_without_a_tolerance_and_with_a_tiny_one() -> None:
    assert chosen() == chosen(visual_tolerance=1e-4) == (128, 64)


def test_sizes__are_the_smallest_with_a_large_tolerance_unless_they_are_given() -> None:
    assert chosen(visual_tolerance=2.0) == (48, 40)
    assert chosen(visual_tolerance=2.0, sh0_entries=100, rotation_steps=90) == (100, 90)
    assert chosen(visual_tolerance=2.0, rotation="best")[1] == 64


@pytest.mark.parametrize("cost", [1.0, 3e3, 3e4, 1e9])
def test_color_entries__are_the_fewest_whose_rounding_shows_at_most_the_limit(cost: float) -> None:
    values = np.random.default_rng(3).uniform(-1, 1, (4000, 3)).astype(np.float32)

    def fit(count: int) -> np.ndarray:
        return np.linspace(-1, 1, count, dtype=np.float32)

    def shown(count: int) -> float:
        errors = np.abs(values[..., None] - fit(count)).min(axis=-1)
        return float(np.minimum(cost * np.square(errors), 16).mean())

    found = balancing.color_entries(fit, values, costs(4000, color=cost))

    coarser = [count for count in (48, 64, 80, 96, 128) if count < found]
    assert found == 128 or shown(found) <= 2.5
    assert all(shown(count) > 2.5 for count in coarser)


@pytest.mark.parametrize("cost", [1.0, 1.5e4, 4e4, 1e9])
def test_rotation_steps__are_the_fewest_whose_rounding_shows_at_most_the_limit(cost: float) -> None:
    rng = np.random.default_rng(4)
    quats = np.concatenate([np.ones((4000, 1)), rng.uniform(-0.5, 0.5, (4000, 3))], axis=1).astype(np.float32)

    def shown(steps: int) -> float:
        stored = np.concatenate([np.full((4000, 1), steps), np.rint(quats[:, 1:] * steps)], axis=1)
        cosines = np.einsum("nc,nc->n", stored, quats) / np.linalg.norm(stored, axis=1) / np.linalg.norm(quats, axis=1)
        return float(np.minimum(cost * 4 * (1 - np.square(cosines)), 16).mean())  # (2 sin of half the angle)^2

    found = balancing.rotation_steps(quats, costs(4000, rotation=cost))

    coarser = [steps for steps in (40, 48, 56, 64) if steps < found]
    assert found == 64 or shown(found) <= 5
    assert all(shown(steps) > 5 for steps in coarser)
