"""The real Spark renderer against our model of it: the same words, the same camera, two pictures."""

from pathlib import Path

import numpy as np
import pytest

import gsplat_tools
from gsplat_tools.formats.pack import spark
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.sorting import sort_by_depth
from tests.browser.gspk_builder import make_words
from tests.browser.scenes import looking_at_origin, make_scene
from tests.browser.spark_renderer import draw_pack, draw_with_spark, psnr
from tests.browser.spark_words import unpack_splats
from tests.oracles.brute_force import render_oracle
from tests.oracles.oracle_projection import Camera as OracleCamera

pytestmark = pytest.mark.browser

GARDEN = Path(__file__).parents[2] / "fixtures" / "garden.ply"
LEAST_PSNR = 50.0
DEFAULTS = {"rgbMin": 0, "rgbMax": 1, "lnScaleMin": -12, "lnScaleMax": 9, "sh1Max": 1, "sh2Max": 1, "sh3Max": 1}
FITTED = {"rgbMin": -0.5, "rgbMax": 1.25, "lnScaleMin": -7, "lnScaleMax": -1, "sh1Max": 0.25, "sh2Max": 0.5, "sh3Max": 0.125}


def oracle_camera(camera):
    (fx, _, cx), (_, fy, cy), _ = camera.K
    return OracleCamera(camera.viewmat, fx, fy, cx, cy, camera.width, camera.height, camera.near, camera.far)


@pytest.mark.parametrize("accumulator", ["packed", "ext"])
@pytest.mark.parametrize(("encoding", "scale_bytes"), [(DEFAULTS, (85, 125)), (FITTED, (60, 220))], ids=["default", "fitted"])
@pytest.mark.parametrize("degree", [0, 3])
def test_oracle__draws_what_the_real_renderer_draws(browser, degree, encoding, scale_bytes, accumulator):
    words = make_words(np.random.default_rng(11), 300, degree, scale_bytes=scale_bytes)
    sh = {name: words[name] for name in words if name != "packed"}
    camera = looking_at_origin(96, 64)

    pixels = draw_with_spark(browser, camera, **words, encoding=encoding, options={"accumExtSplats": accumulator == "ext"})
    splats = unpack_splats(words["packed"], sh, encoding)
    picture = render_oracle(splats, oracle_camera(camera), "spark", accumulator, framebuffer="unorm8")

    assert psnr(pixels, picture.image) >= LEAST_PSNR


@pytest.mark.parametrize("options", [{}, {"accumExtSplats": True}], ids=["packed", "ext"])
def test_oracle__draws_opaque_splats_as_the_real_renderer_does(browser, options):
    words = make_words(np.random.default_rng(12), 300, 0, scale_bytes=(85, 125))
    # Half of 255 rounds up: Spark's accumulator makes such a splat a little more than opaque.
    words["packed"][:, 0] |= np.uint32(0xFF000000)
    camera = looking_at_origin(96, 64)

    pixels = draw_with_spark(browser, camera, words["packed"], options=options)
    accumulator = "ext" if options else "packed"
    splats = unpack_splats(words["packed"], {}, DEFAULTS)
    picture = render_oracle(splats, oracle_camera(camera), "spark", accumulator, framebuffer="unorm8")

    assert psnr(pixels, picture.image) >= LEAST_PSNR


@pytest.mark.parametrize("accumulator", ["packed", "ext"])
@pytest.mark.parametrize("fits", [False, True], ids=["default", "fitted"])
@pytest.mark.parametrize("degree", [0, 3])
def test_render__draws_what_the_real_renderer_draws(browser, degree, fits, accumulator):
    cloud = make_scene(degree)
    pack = spark.encode(cloud, encoding=spark.fit_encoding([cloud]) if fits else spark.SplatEncoding(), rotation="reference")
    camera = looking_at_origin(320, 200)

    pixels = draw_pack(browser, camera, pack, options={"accumExtSplats": accumulator == "ext"})
    decoded = spark.decode(pack)
    ours = render(decoded, camera, model="spark", variant=accumulator, framebuffer="unorm8")
    other_model = render(decoded, camera, model="inria")

    assert psnr(pixels, ours.image) >= LEAST_PSNR
    # The bound tells models apart.
    assert psnr(pixels, other_model.image) < LEAST_PSNR - 10


# Base colors above 1 are clamped by the default ranges.
@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.LossyConversionWarning")
@pytest.mark.parametrize("spark_encoding", ["default", "fit"])
def test_render__draws_the_bundled_scene_as_the_real_renderer_does(browser, spark_encoding):
    cloud = gsplat_tools.load(GARDEN)
    pack = spark.encode(cloud, encoding=spark.fit_encoding([cloud]) if spark_encoding == "fit" else spark.SplatEncoding())
    camera = Camera.look_at((0.35, -1.25, -3.1), (0.08, -0.42, 0.05), fov_y=40.0, width=320, height=200)

    pixels = draw_pack(browser, camera, pack)
    ours = render(spark.decode(pack), camera, model="spark", framebuffer="unorm8")

    assert psnr(pixels, ours.image) >= LEAST_PSNR


@pytest.mark.parametrize("metric", ["radial", "depth"])
def test_render__draws_in_the_order_that_the_real_renderer_sorts_by(browser, metric):
    pack = spark.encode(make_scene(3))
    decoded, camera = spark.decode(pack), looking_at_origin(320, 200)

    pixels = draw_pack(browser, camera, pack, options={"sortRadial": metric == "radial"})
    drawn = {
        name: render(
            decoded, camera, model="spark", framebuffer="unorm8", order=sort_by_depth(decoded, camera, metric=name)
        ).image
        for name in ("radial", "depth")
    }

    other = "depth" if metric == "radial" else "radial"
    assert psnr(pixels, drawn[metric]) >= LEAST_PSNR
    assert psnr(pixels, drawn[other]) < psnr(pixels, drawn[metric]) - 5
