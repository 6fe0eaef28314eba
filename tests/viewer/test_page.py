import base64
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools import render
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats import load, save
from gsplat_tools.formats.sog4d import planes
from gsplat_tools.ops.coordinates import convert_coordinates
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.camera import parse_cameras
from gsplat_tools.reference.image_metrics import compare_images
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.viewing.page import offline_page, template
from gsplat_tools.viewing.payload import prepare_exhibit
from tests.clouds import random_cloud
from tests.viewer.conftest import View, serving
from tools.viewer_sources import source_checksum

pytestmark = pytest.mark.browser
ROOT = Path(__file__).parents[2]
GARDEN = ROOT / "fixtures" / "garden.ply"
NewView = Callable[..., View]


@pytest.fixture(scope="module")
def garden() -> GaussianCloud:
    cloud = load(GARDEN)
    assert isinstance(cloud, GaussianCloud)
    return cloud


@pytest.fixture(scope="module")
def bundle(garden: GaussianCloud, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five keyframes that move, turn, fade and change their colors, with delta labels."""
    rng = np.random.default_rng(5)
    turns = rng.normal(0, 0.3, (5, *garden.quats.shape)).astype(np.float32)

    def frame(k: int) -> GaussianCloud:
        return garden.replace(
            means=garden.means + np.float32(0.05 * k),
            quats=garden.quats + turns[k],
            opacity_logits=garden.opacity_logits - np.float32(k),
            sh0=garden.sh0 * np.float32(1 - 0.1 * k),
            shN=garden.shN * np.float32(1 - 0.2 * (k % 2)),
        )

    path = tmp_path_factory.mktemp("bundle") / "garden.sog4d"
    times = [0.0, 0.1, 0.5, 0.8, 1.0]
    scene = GaussianSequence(frame, num_splats=len(garden), sh_degree=garden.sh_degree, frame_times=times)
    save(scene, path, labels="delta-v1")
    return path


def test_built_page__is_of_todays_sources() -> None:
    built = (ROOT / "gsplat_tools" / "viewing" / "page" / "sources.sha256").read_text(encoding="ascii")

    assert built.strip() == source_checksum(), "run scripts/build_viewer"
    assert "three" in (ROOT / "gsplat_tools" / "viewing" / "page" / "LICENCES.txt").read_text(encoding="utf-8")
    assert "http://" not in template()[:2000]


@pytest.mark.parametrize(
    "target", ["ply", "compressed-ply", "spark", "uncompressed", "gscc", "sog4d", "sog", "spz", "splat", "splat4d"]
)
@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
def test_every_format__loads_and_draws(new_view: NewView, garden: GaussianCloud, target: str, tmp_path: Path) -> None:
    from gsplat_tools.formats.registry import FORMATS

    path = tmp_path / f"scene{FORMATS[target].extensions[0]}"
    save(garden, path, to=target)
    view = new_view()

    with serving(path) as server:
        view.open(server.address)
        camera = auto_cameras(garden, views=1, size=(96, 64))[0]
        bytes_ = view.page.evaluate(
            "async () => Array.from(await viewer.stage.capture({...viewer.config.cameras[0], width: 96, height: 64, "
            "K: viewer.config.cameras[0].K.map((row, i) => i < 2 ? row.map((v) => v * 64 / 720) : row)}))"
        )
        pixels = np.array(bytes_, np.uint8).reshape(64, 96, 4)

    assert view.message == ""
    assert view.complaints == []
    assert f"{len(garden):,} splats" in view.page.inner_text("#facts-0")
    assert view.page.evaluate("viewer.state.sources[0].splats") == len(garden)
    assert camera.width == pixels.shape[1]
    assert (pixels[..., :3].max(axis=(0, 1)) > 40).all()


@pytest.mark.parametrize("target", ["spark", "sog4d"])
@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
def test_picture__agrees_with_model_spark(new_view: NewView, garden: GaussianCloud, target: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene.{'gspk' if target == 'spark' else 'sog4d'}"
    save(garden, path, to=target)
    decoded = load(path)
    cloud = decoded if isinstance(decoded, GaussianCloud) else decoded.at(0.0)
    camera = auto_cameras(cloud, views=1, size=(320, 200))[0]
    view = new_view()

    with serving(path) as server:
        view.open(server.address)
        found = view.page.evaluate("async (c) => Array.from(await viewer.stage.capture(c))", camera.to_json())

    drawn = np.array(found, np.uint8).reshape(200, 320, 4)[::-1, :, :3] / 255
    metrics = compare_images(render(cloud, camera, model="spark").image, drawn)
    assert metrics.psnr is not None
    assert metrics.psnr > 50


def capture(view: View, camera: dict[str, Any], side: int = 0) -> np.ndarray:
    """One side as (H, W, 3) in 0..1, seen from a camera of the page's own coordinates."""
    found = view.page.evaluate("async ([c, side]) => Array.from(await viewer.stage.capture(c, side))", [camera, side])
    return np.array(found, np.uint8).reshape(camera["height"], camera["width"], 4)[::-1, :, :3] / 255


def test_picture_of_a_later_keyframe__has_the_colors_of_its_time(
    new_view: NewView, garden: GaussianCloud, tmp_path: Path
) -> None:
    path = tmp_path / "turned.sog4d"
    scene = GaussianSequence(
        lambda k: garden.replace(shN=garden.shN * np.float32(1 - 2 * k)),
        num_splats=len(garden),
        sh_degree=garden.sh_degree,
        num_frames=2,
    )
    save(scene, path)
    written = load(path)
    view = new_view(160, 100)

    with serving(path) as server:
        view.open(server.address)
        camera = view.page.evaluate("viewer.pageCamera()")
        capture(view, camera)  # the textures are those of time 0 now
        view.page.evaluate("viewer.seek(1)")
        drawn = capture(view, camera)

    view_camera = parse_cameras(camera)[0]
    levels = [compare_images(render(written.frame(k), view_camera, model="spark").image, drawn).psnr for k in (0, 1)]
    assert levels[1] is not None
    assert levels[1] > 48
    assert levels[0] is not None
    assert levels[0] < 35


@pytest.mark.filterwarnings("ignore::gsplat_tools.errors.GsplatWarning")
@pytest.mark.parametrize("target", ["gscc", "georeferenced"])
def test_copied_camera__gives_the_same_picture_where_the_file_is_left_handed_or_far_away(
    new_view: NewView, garden: GaussianCloud, target: str, tmp_path: Path
) -> None:
    path = tmp_path / ("scene.gscc" if target == "gscc" else "scene.ply")
    save(garden if target == "gscc" else garden.replace(origin=np.array([1e5, -2e5, 300.0])), path)
    cloud = load(path)
    assert isinstance(cloud, GaussianCloud)
    view = new_view(320, 200)

    with serving(path) as server:
        view.open(server.address)
        drawn = capture(view, view.page.evaluate("viewer.pageCamera()"))
        view.page.click("#copy-camera")
        view.wait_until("viewer.copied !== ''")
        camera = parse_cameras(json.loads(view.page.evaluate("viewer.copied")))[0]

    metrics = compare_images(render(cloud, camera, model="spark").image, drawn)
    assert metrics.psnr is not None
    assert metrics.psnr > 38  # the file's own steps are on both sides; Spark's layout is not
    assert drawn.max() > 0.5


def test_second_file__is_brought_into_the_axes_and_about_the_origin_of_the_first(
    new_view: NewView, garden: GaussianCloud, tmp_path: Path
) -> None:
    first, second = tmp_path / "first.ply", tmp_path / "second.ply"
    save(garden.replace(origin=np.array([100.0, 50.0, -20.0])), first, recenter="on")
    there = garden.replace(means=garden.means + np.float32([100, 50, -20]))
    save(convert_coordinates(there, "RUB"), second)
    view = new_view(160, 100)

    with serving(first, second) as server:
        view.open(server.address)
        camera = view.page.evaluate("viewer.pageCamera()")
        sides = [capture(view, camera, side) for side in (0, 1)]

    metrics = compare_images(*sides)
    assert sides[0].max() > 0.5
    assert (
        metrics.psnr is None or metrics.psnr > 30
    )  # positions of the second are steps of 2^-17 at 100, and its words are those of Spark's layout
    assert "brought beside" in view.page.inner_text("#name-1")


def test_what_is_left_out__is_said(new_view: NewView, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    save(random_cloud(100, sh_degree=4), path, order="none")
    content = bytearray(path.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    row = (len(content) - start) // 100
    content[start + 3 * row : start + 3 * row + 4] = b"\x00\x00\xc0\x7f"  # x of one splat is not a number
    path.write_bytes(content)
    view = new_view()

    with serving(path) as server:
        view.open(server.address)
        note = view.page.inner_text("#name-0")

    assert "without 1 invalid splats" in note
    assert "without SH band 4" in note
    assert view.message == ""
    assert view.complaints == []


def test_empty_scene__is_an_empty_page_without_complaints(new_view: NewView, tmp_path: Path) -> None:
    path = tmp_path / "empty.ply"
    save(random_cloud(5, sh_degree=1).take(slice(0, 0)), path)
    view = new_view()

    with serving(path) as server:
        view.open(server.address)
        for key in "0cl1mih":
            view.page.keyboard.press(key)
        view.page.select_option("#control", "fly")
        view.page.select_option("#control", "orbit")

    assert view.message == ""
    assert view.complaints == []


def test_keys__work_after_the_mouse_and_leave_lists_and_buttons_alone(new_view: NewView, bundle: Path) -> None:
    view = new_view(900, 400)

    with serving(bundle, GARDEN) as server:
        view.open(server.address)
        view.page.click("#reset")
        view.page.keyboard.press(" ")
        assert view.page.evaluate("viewer.state.playing")
        view.page.keyboard.press(" ")
        assert not view.page.evaluate("viewer.state.playing")
        view.page.keyboard.press(".")
        step = view.page.evaluate("viewer.state.t")
        view.page.focus("#help")
        view.page.keyboard.press(" ")

        assert step in (0.0, 0.1, 0.5, 0.8, 1.0)
        assert view.page.is_visible("#keys")
        assert not view.page.evaluate("viewer.state.playing")
        view.page.focus("#divider")
        view.page.keyboard.press("Home")
        assert view.page.evaluate("viewer.stage.split") == 0


def test_play__at_the_end_starts_again(new_view: NewView, bundle: Path) -> None:
    view = new_view()

    with serving(bundle) as server:
        view.open(server.address)
        view.page.uncheck("#loop")
        view.page.evaluate("viewer.seek(1)")
        view.page.click("#play")
        view.page.click("#play")

        assert view.page.evaluate("viewer.state.t") < 1


def test_still_page__is_not_drawn_again(new_view: NewView) -> None:
    view = new_view(96, 64)

    with serving(GARDEN) as server:
        view.open(server.address)
        view.page.evaluate("viewer.paused = false")
        view.wait_until("document.getElementById('loading').hidden && !viewer.stage.isBusy()")
        drawn = view.page.evaluate("viewer.stage.renderer.info.render.frame")
        view.page.evaluate("new Promise((resolve) => setTimeout(resolve, 300))")

        assert drawn > 0
        assert view.page.evaluate("viewer.stage.renderer.info.render.frame") == drawn


def test_image_bytes__are_those_that_python_decodes(new_view: NewView, bundle: Path) -> None:
    view = new_view()
    names = {"position_hi": "hi", "position_lo": "lo", "scale_indices": "scale", "rotation": "rotation", "sh0": "sh0"}
    meta_paths = _stream_paths(bundle)

    with serving(bundle) as server:
        view.open(server.address)
        for name, image in planes(bundle, 3).items():
            if name not in names:
                continue
            found = view.page.evaluate(
                """async (path) => {
                  const { pixels } = await viewer.state.sources[0].player.call({ type: "pixels", path });
                  let text = "";
                  for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
                  return btoa(text);
                }""",
                meta_paths[name].replace("{frame}", "00003"),
            )
            assert base64.b64decode(found) == image.tobytes(), name


def _stream_paths(bundle: Path) -> dict[str, str]:
    """Templates of the image streams, from meta.json."""
    import zipfile

    streams = json.loads(zipfile.ZipFile(bundle).read("meta.json"))["streams"]
    return {
        "position_hi": streams["position"]["hiPath"],
        "position_lo": streams["position"]["loPath"],
        "scale_indices": streams["scale"]["indicesPath"],
        "rotation": streams["rotation"]["path"],
        "sh0": streams["sh"]["sh0Path"],
    }


def test_evaluation__is_the_python_evaluation_at_any_time(new_view: NewView, bundle: Path) -> None:
    view = new_view()
    scene = load(bundle)
    times = [*np.random.default_rng(1).uniform(-0.1, 1.1, 96), 0.0, 0.5, 0.8, 1.0]

    with serving(bundle) as server:
        view.open(server.address)
        for k, t in enumerate(times):
            mode = "nearest" if k % 5 == 0 else "linear"
            found = view.page.evaluate(
                """async ([t, interpolation]) => {
                  const values = await viewer.state.sources[0].player.call({ type: "values", t, interpolation });
                  const texts = {};
                  for (const [name, array] of Object.entries(values)) {
                    const bytes = new Uint8Array(array.buffer);
                    let text = "";
                    for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
                    texts[name] = btoa(text);
                  }
                  return texts;
                }""",
                [t, mode],
            )
            values = {name: np.frombuffer(base64.b64decode(text), np.float32) for name, text in found.items()}
            cloud = scene.at(t, mode)
            opacities = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
            np.testing.assert_allclose(values["means"], cloud.means.ravel(), rtol=3e-7, atol=1e-7)
            np.testing.assert_allclose(values["logScales"], cloud.log_scales.ravel(), rtol=3e-7, atol=1e-6)
            np.testing.assert_allclose(values["quats"], cloud.quats.ravel(), rtol=0, atol=3e-7)
            np.testing.assert_allclose(values["opacities"], opacities, rtol=0, atol=1e-6)
            np.testing.assert_allclose(values["sh0"], cloud.sh0.ravel(), rtol=3e-7, atol=1e-7)
            np.testing.assert_allclose(values["rest"], cloud.shN.ravel(), rtol=3e-7, atol=1e-7)


def test_bad_file__shows_the_words_of_the_validator(new_view: NewView, bundle: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.sog4d"
    broken.write_bytes(bundle.read_bytes().replace(b"meta.json", b"beta.json"))
    view = new_view()

    with serving(broken) as server:
        view.open(server.address)

    assert "not valid" in view.message
    assert "meta-missing" in view.message


def test_offline_page__asks_for_nothing(new_view: NewView, bundle: Path, tmp_path: Path) -> None:
    view = new_view()
    with ExitStack() as keep:
        page = tmp_path / "view.html"
        page.write_text(offline_page(prepare_exhibit([bundle, GARDEN], keep)), encoding="utf-8")

    view.open(page.as_uri())
    view.page.evaluate("viewer.seek(0.65)")
    view.wait_until("!viewer.state.busy")

    assert view.requests == [page.as_uri()]
    assert view.complaints == []
    assert view.message == ""
    assert view.page.evaluate("viewer.stage.sides.length") == 2


def test_copied_camera__is_one_that_render_takes(new_view: NewView) -> None:
    view = new_view(640, 360)

    with serving(GARDEN) as server:
        view.open(server.address)
        view.page.click("#copy-camera")
        view.wait_until("viewer.copied !== ''")
        text = view.page.evaluate("viewer.copied")
        expected = view.page.evaluate("viewer.config.cameras[0]")

    camera = parse_cameras(json.loads(text))[0]
    assert (camera.width, camera.height) == (640, 360)
    np.testing.assert_allclose(camera.viewmat, expected["viewmat"], atol=1e-5)


def test_link__restores_camera_time_and_mode(new_view: NewView, bundle: Path) -> None:
    first, second = new_view(), new_view()

    with serving(bundle, GARDEN) as server:
        first.open(server.address)
        first.page.keyboard.press("m")
        first.page.evaluate("viewer.seek(0.37)")
        first.page.mouse.move(200, 100)
        first.page.mouse.down()
        first.page.mouse.move(260, 130)
        first.page.mouse.up()
        first.page.click("#copy-link")
        first.wait_until("viewer.copied !== ''")
        second.open(first.page.evaluate("viewer.copied"))
        cameras = [each.page.evaluate("viewer.currentCamera()") for each in (first, second)]

        assert second.page.evaluate("viewer.state.t") == 0.37
        assert second.page.evaluate("viewer.stage.mode") == "first"
        np.testing.assert_allclose(cameras[0]["viewmat"], cameras[1]["viewmat"], atol=1e-4)


def test_panel__fits_a_phone(new_view: NewView, bundle: Path) -> None:
    view = new_view(360, 640)

    with serving(bundle) as server:
        view.open(server.address)
        boxes = view.page.evaluate(
            "[...document.querySelectorAll('#panel button, #panel select, #panel input')].filter((e) => e.offsetParent)"
            ".map((e) => e.getBoundingClientRect()).map((r) => [r.left, r.right, r.top, r.bottom])"
        )

    assert len(boxes) > 8
    assert all(left >= 0 and right <= 360 and top >= 320 and bottom <= 640 for left, right, top, bottom in boxes)
