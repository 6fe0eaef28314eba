"""The harness itself: a camera, a color and an order that are known beforehand come out of the real renderer as they should."""

import math

import numpy as np
import pytest

from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.models import find_model
from tests.browser import chromium, conftest
from tests.browser.chromium import BrowserError
from tests.browser.scenes import looking_at_origin
from tests.browser.spark_renderer import draw_with_spark


def round_splats(centers, scale_byte, colors):
    """Return words of round, opaque splats: exp(-12 + (scale_byte - 1) 21/254) world units, no rotation, colors as bytes."""
    rows = np.zeros((len(centers), 16), np.uint8)
    rows[:, 0:3] = colors
    rows[:, 3] = 255
    rows[:, 4:10] = np.asarray(centers, "<f2").view(np.uint8)
    rows[:, 12:15] = scale_byte
    return rows.view("<u4")


@pytest.mark.browser
def test_draw_with_spark__puts_a_splat_where_a_pinhole_camera_sees_it(browser):
    center = np.array([0.75, -0.25, 0.5])
    turned = Camera.look_at((2.0, -1.5, -3.0), (0.3, 0.2, 0.1), (0.2, -1.0, 0.1), fov_y=40.0, width=150, height=90)
    # Everything that could be mixed up differs: both focal lengths, and a principal point off the middle.
    camera = Camera(turned.viewmat, [[140.0, 0, 60.0], [0, 110.0, 55.5], [0, 0, 1]], 150, 90)
    x, y, z = camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]

    image = draw_with_spark(browser, camera, round_splats([center], 112, [255, 255, 255]))

    weights = image[..., 0] / image[..., 0].sum()
    column, row = weights.sum(0) @ (np.arange(150) + 0.5), weights.sum(1) @ (np.arange(90) + 0.5)
    assert np.count_nonzero(image[..., 0]) > 100
    # The center is kept as a half relative to the camera, and the picture as bytes.
    assert column == pytest.approx(140.0 * x / z + 60.0, abs=0.1)
    assert row == pytest.approx(110.0 * y / z + 55.5, abs=0.1)


@pytest.mark.browser
def test_draw_with_spark__changes_no_color_on_the_way(browser):
    # So large on screen that it is flat in the middle.
    words = round_splats([[0.0, 0.0, 0.0]], 150, [200, 100, 50])
    camera = looking_at_origin(63, 41)

    image = draw_with_spark(browser, camera, words)
    empty = draw_with_spark(browser, camera, words[:0], background=(51 / 255, 102 / 255, 153 / 255, 1.0))

    assert image[20, 31].tolist() == [200, 100, 50, 255]
    assert (empty == [51, 102, 153, 255]).all()


@pytest.mark.browser
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_draw_with_spark__draws_the_near_splat_over_the_far_one_in_any_order(browser, order):
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), fov_y=45.0, width=32, height=32)
    words = round_splats([[0, 0, 0], [0, 0, 1]], 140, [[255, 0, 0], [0, 255, 0]])[order]

    image = draw_with_spark(browser, camera, words)

    assert image[16, 16, 0] > 250
    assert image[16, 16, 1] < 5


@pytest.mark.browser
def test_draw_with_spark__gives_the_same_bytes_twice(browser):
    rng = np.random.default_rng(5)
    words = round_splats(rng.normal(size=(500, 3)), 115, rng.integers(0, 256, (500, 3)))
    camera = looking_at_origin(80, 50)

    first = draw_with_spark(browser, camera, words)
    draw_with_spark(browser, looking_at_origin(31, 17), words[::-1], options={"sortRadial": False})

    assert np.array_equal(first, draw_with_spark(browser, camera, words))


@pytest.mark.browser
def test_model_spark__has_the_numbers_that_the_real_renderer_reports(browser):
    defaults, _ = browser.call("sparkDefaults")
    model = find_model("spark")

    assert model.low_pass == defaults["blurAmount"]
    assert model.center_limit == defaults["clipXY"]
    assert model.axis_cap == defaults["maxPixelRadius"]
    assert model.alpha_floor == pytest.approx(defaults["minAlpha"])
    assert model.cutoff == pytest.approx(defaults["maxStdDev"] ** 2 / 2)
    assert (model.metric == "radial") is defaults["sortRadial"]
    assert (model.accumulator == "ext") is defaults["accumExtSplats"]
    # What the model has no number for.
    assert defaults["focalAdjustment"] == defaults["falloff"] == 1
    assert defaults["preBlurAmount"] == defaults["minPixelRadius"] == defaults["apertureAngle"] == 0
    assert defaults["premultipliedAlpha"] is True
    assert defaults["enable2DGS"] is False
    assert math.isclose(defaults["maxStdDev"], math.sqrt(8))


@pytest.mark.browser
def test_call__raises_what_the_page_threw(browser):
    with pytest.raises(
        BrowserError, match=r"noSuchJob failed in the browser: TypeError: jobs\[job.name\] is not a function"
    ) as caught:
        browser.call("noSuchJob")

    assert caught.value.error["name"] == "TypeError"
    assert browser.call("describeRenderer")[0]["three"] == "187"


def test_stop_where_missing__skips_or_fails_as_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("GSPLAT_TOOLS_CHROMIUM", str(tmp_path / "chromium"))
    monkeypatch.delenv(conftest.REQUIRED, raising=False)

    with pytest.raises(pytest.skip.Exception, match="Chromium is not installed; run scripts/peers"):
        conftest.stop_where_missing(chromium.missing())

    monkeypatch.setenv(conftest.REQUIRED, "1")
    with pytest.raises(pytest.fail.Exception, match=f"{conftest.REQUIRED}=1, but Chromium is not installed"):
        conftest.stop_where_missing(chromium.missing())


def test_missing__names_the_packages_that_are_not_there(monkeypatch, tmp_path):
    monkeypatch.setattr(chromium, "executable", lambda: "chromium")
    monkeypatch.setattr(chromium, "NODE_MODULES", tmp_path)
    for name in ("three", "fzstd"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "package.json").write_text("{}")

    assert chromium.missing() == "npm packages are not installed: @sparkjsdev/spark; run scripts/peers"
