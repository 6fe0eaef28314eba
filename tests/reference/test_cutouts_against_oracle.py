from __future__ import annotations

import itertools

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.cutouts import Cutout, apply_cutouts
from gsplat_tools.reference.global_sort import sort_scenes, split_entries
from gsplat_tools.reference.rasterizer import render
from tests.oracles import cutouts as oracle
from tests.oracles import scenes
from tests.oracles.brute_force import draw_order, render_oracle


def _matrix(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = rng.normal(size=(3, 3)) * 0.4 + np.eye(3) * 0.5
    matrix[:3, 3] = rng.normal(size=3) * 0.3
    return matrix


VOLUMES = [
    (_matrix(seed), kind, invert)
    for seed, (kind, invert) in enumerate(itertools.product(["ellipsoid", "box", "none"], [False, True]))
]


@pytest.mark.parametrize("chosen", [*itertools.combinations(range(6), 1), *itertools.combinations(range(6), 2)])
def test_apply_cutouts__keeps_what_no_volume_cuts(chosen: tuple[int, ...]) -> None:
    scene = scenes.as_float32(scenes.mixed(1))
    volumes = [VOLUMES[i] for i in chosen]

    found, bounds = apply_cutouts(GaussianCloud(**scene), [Cutout(*volume) for volume in volumes])

    expected = oracle.survivors(scene["means"].astype(np.float64), volumes)
    np.testing.assert_array_equal(found, expected)
    if len(expected):
        np.testing.assert_array_equal(bounds, [scene["means"][expected].min(axis=0), scene["means"][expected].max(axis=0)])
    else:
        assert bounds is None


@pytest.mark.parametrize("volume", [VOLUMES[0], VOLUMES[3]])
def test_render__hides_what_a_cutout_cuts(volume: tuple) -> None:
    scene, camera = scenes.as_float32(scenes.mixed(1)), scenes.camera()
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])

    found = render(
        GaussianCloud(**scene),
        Camera(camera.viewmat, K, camera.width, camera.height, camera.near, camera.far),
        model="unity",
        dtype="float64",
        cutouts=[Cutout(*volume)],
    )

    means = scene["means"].astype(np.float64)
    kept = oracle.survivors(means, [volume])
    order = [i for i in draw_order(means, camera, "unity") if i in set(kept)]
    assert 0 < len(order) < len(means)
    expected = render_oracle(scene, camera, "unity", order=order)
    is_clear = expected.margin > 1e-8
    np.testing.assert_allclose(found.image[is_clear], expected.image[is_clear], rtol=0, atol=1e-6)


def test_sort_scenes__is_one_order_by_depth_then_scene_then_splat() -> None:
    camera = scenes.camera()
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    clouds = [scenes.as_float32(scenes.mixed(seed)) for seed in (1, 2, 1)]
    # The first scene and the last are the same in the same place: every one of their depths is a tie.
    matrices = [_matrix(7), _matrix(8), _matrix(7)]

    found = sort_scenes(
        [GaussianCloud(**cloud) for cloud in clouds],
        matrices,
        Camera(camera.viewmat, K, camera.width, camera.height, camera.near, camera.far),
    )

    expected = oracle.merged_order([cloud["means"].astype(np.float64) for cloud in clouds], matrices, camera)
    assert list(zip(*(ids.tolist() for ids in split_entries(found)), strict=True)) == expected
