import numpy as np
import pytest

from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.models import MODELS
from gsplat_tools.reference.rasterizer import render
from tests.clouds import random_cloud
from tests.reference.splats import splats


def test_auto_cameras__are_the_same_for_the_same_scene() -> None:
    first, second = (auto_cameras(random_cloud(300)) for _ in range(2))

    assert len(first) == 8
    assert all(np.array_equal(a.viewmat, b.viewmat) and np.array_equal(a.K, b.K) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("model", MODELS)
def test_auto_cameras__show_scenes_of_any_size_in_every_model(scale: float, model: str) -> None:
    cloud = random_cloud(400, sh_degree=0)
    cloud = cloud.replace(means=cloud.means * np.float32(scale), log_scales=cloud.log_scales + np.float32(np.log(scale)))

    for camera in auto_cameras(cloud, views=4, size=(96, 64)):
        rendering = render(cloud, camera, model=model)
        assert rendering.counts.drawn > 150
        assert rendering.alphas.mean() > 0.02


def test_auto_cameras__ignore_outliers() -> None:
    cloud = random_cloud(1000, sh_degree=0)
    means = cloud.means.copy()
    means[:5] = 1e6
    means[5] = np.nan
    faint = cloud.opacity_logits.copy()
    faint[6:20] = -12.0
    means[6:20] = -500.0

    near = auto_cameras(cloud)
    outliers = auto_cameras(cloud.replace(means=means, opacity_logits=faint))

    for a, b in zip(near, outliers, strict=True):
        assert np.linalg.norm(a.position - b.position) < 0.2 * np.linalg.norm(a.position)


def test_auto_cameras__stand_at_the_origin_of_the_cloud() -> None:
    cloud = random_cloud(100)
    origin = np.array([1e5, 0, -2e5])

    for a, b in zip(auto_cameras(cloud), auto_cameras(cloud.replace(origin=origin)), strict=True):
        assert np.allclose(a.position + origin, b.position)


@pytest.mark.parametrize(
    ("system", "up"), [("unknown", (0, -1, 0)), ("RDF", (0, -1, 0)), ("RUB", (0, 1, 0)), ("RFU", (0, 0, 1))]
)
def test_auto_cameras__hold_up_upright(system: str, up) -> None:  # type: ignore[no-untyped-def]
    cloud = random_cloud(100).replace(coordinate_system=system)

    for camera in auto_cameras(cloud):
        assert camera.viewmat[1, :3] @ np.array(up) < -0.8  # up in the world is up in the picture: minus y


def test_auto_cameras__do_not_mirror_left_handed_worlds() -> None:
    """RUF is RUB with z reversed: the pictures must be the same."""
    right = splats([(0.5, 0.2, 0.1), (-0.3, 0.4, -0.6), (0.1, -0.5, 0.8)], scales=0.2, colors=np.eye(3))
    left = right.replace(means=right.means * np.array([1, 1, -1], np.float32), coordinate_system="RUF")
    right = right.replace(coordinate_system="RUB")

    for a, b in zip(auto_cameras(right), auto_cameras(left), strict=True):
        assert np.abs(render(right, a).image - render(left, b).image).max() < 1e-5


@pytest.mark.parametrize("count", [0, 1, 2])
def test_auto_cameras__manage_tiny_scenes(count: int) -> None:
    cameras = auto_cameras(random_cloud(count), views=3, size=(32, 32))

    assert len(cameras) == 3
    assert all(np.isfinite(camera.viewmat).all() for camera in cameras)
    with pytest.raises(ValueError, match="at least 1"):
        auto_cameras(random_cloud(count), views=0)
