"""Drawing Visionary's records: against quads in plain numpy, and against the model of the rasterizer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.visionary import merge_models, preprocess, sort_records
from gsplat_tools.reference.visionary_drawing import draw_records
from tests.clouds import random_cloud
from tests.oracles import oracle_projection, scenes, visionary
from tests.reference import splats as hand


def _camera(camera: oracle_projection.Camera) -> Camera:
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return Camera(camera.viewmat, K, camera.width, camera.height, camera.near, camera.far)


@pytest.mark.parametrize("name", ["mixed", "needles", "discs", "isotropic", "tiny", "huge", "edges"])
def test_draw_records__agrees_with_plain_quads(name: str) -> None:
    scene, view = GaussianCloud(**scenes.as_float32(scenes.SCENES[name](6))), _camera(scenes.camera())
    found = preprocess(scene, view)

    image, alphas = draw_records(found, view, dtype="float64")
    expected = visionary.draw(found.records, sort_records(found)[1], view.width, view.height)

    assert alphas.max() > 0.1
    # The same halves go in: only pixels at the very rim of a splat, q = 4.708, may part.
    is_close = (np.abs(alphas - expected[1]) < 1e-9) & (np.abs(image - expected[0]) < 1e-7).all(axis=2)
    assert np.count_nonzero(~is_close) <= 1
    single = draw_records(found, view)
    assert np.median(np.abs(single[1] - alphas)) < 1e-6


@pytest.mark.parametrize("framebuffer", ["float", "unorm8"])
def test_draw_records__shows_the_picture_of_the_model(framebuffer: Any) -> None:
    scene, view = GaussianCloud(**scenes.as_float32(scenes.mixed(7))), _camera(scenes.camera())
    options: dict[str, Any] = {"background": (0.2, 0.4, 0.6), "framebuffer": framebuffer, "dtype": "float64"}

    image, alphas = draw_records(preprocess(scene, view, dtype="float64"), view, **options)
    expected = render(scene, view, model="visionary", **options)

    # Numbers close to a tie of halves, and of 255ths after every blend.
    bound = 5e-3 if framebuffer == "float" else 3 / 255
    assert np.abs(image - expected.image).max() < bound
    assert np.abs(alphas - expected.alphas).max() < bound


def test_draw_records__of_one_splat_by_hand() -> None:
    view = hand.camera()
    found = preprocess(hand.splats([0, 0, 2], opacities=0.5, colors=(1, 0.5, 0)), view, mip=False)

    image, alphas = draw_records(found, view, dtype="float64")

    dx, dy = hand.pixel_offsets(view, 32, 24)
    axis = found.records["v_0"][0, 0].astype(float) * 64, found.records["v_1"][0, 1].astype(float) * 48
    q = (dx / axis[0]) ** 2 + (dy / axis[1]) ** 2
    expected = np.where(q <= 2 * np.sqrt(np.log(255)), 0.5 * np.exp(-q), 0.0)
    assert np.abs(alphas - expected).max() < 1e-12
    assert np.abs(image - expected[..., None] * [1, 0.5, 0]).max() < 1e-3


def test_draw_records__shows_nothing_for_axes_that_halves_lose() -> None:
    view = hand.camera()
    found = preprocess(hand.splats([[0, 0, 2], [0, 0, 3]]), view)
    found.records["v_1"][:] = 0

    image, alphas = draw_records(found, view, background=(0.25, 0.5, 1))

    assert (alphas == 0).all()
    assert (image == [0.25, 0.5, 1]).all()


def test_draw_records__of_nothing_is_the_background() -> None:
    view = hand.camera()

    image, alphas = draw_records(preprocess(hand.splats([0, 0, -1]), view), view, background=(0.25, 0.5, 1))

    assert (alphas == 0).all()
    assert (image == [0.25, 0.5, 1]).all()


@pytest.mark.parametrize("options", [{"dtype": "float16"}, {"framebuffer": "srgb"}, {"background": (0, 0)}], ids=str)
def test_draw_records__refuses_what_no_option_means(options: dict[str, Any]) -> None:
    view = hand.camera()
    with pytest.raises(ValueError, match=next(iter(options))):
        draw_records(preprocess(hand.splats([0, 0, 2]), view), view, **options)


@pytest.mark.parametrize("count", [0, 1, 400])
def test_render__is_the_picture_of_the_records_to_the_bit(count: int) -> None:
    cloud, view = random_cloud(count), _camera(scenes.camera())

    image, alphas = draw_records(preprocess(cloud, view), view)
    expected = render(cloud, view, model="visionary")

    assert image.tobytes() == expected.image.tobytes()
    assert alphas.tobytes() == expected.alphas.tobytes()


def test_draw_records__of_merged_models_is_the_picture_of_all_splats() -> None:
    cloud, view = random_cloud(300, sh_degree=1), _camera(scenes.camera())
    parts = [preprocess(cloud.take(slice(*ends)), view) for ends in ((0, 120), (120, 120), (120, 300))]

    merged, whole = merge_models(parts), preprocess(cloud, view)

    assert merged.records.tobytes() == whole.records.tobytes()
    for name in ("keys", "payload", "splat_ids"):
        assert np.array_equal(getattr(merged, name), getattr(whole, name)), name
    assert merged.counters == whole.counters
    assert merged.culled == whole.culled
    assert draw_records(merged, view)[0].tobytes() == draw_records(whole, view)[0].tobytes()


def test_merge_models__of_nothing_is_an_empty_frame() -> None:
    merged = merge_models([])

    assert len(merged.records) == merged.counters.dispatch_x == 0
