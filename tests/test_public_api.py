import subprocess
import sys

import pytest

import gsplat_tools


@pytest.mark.parametrize("name", gsplat_tools.__all__)
def test_public_names__resolve(name: str) -> None:
    assert getattr(gsplat_tools, name) is not None


def test_public_names__are_all_there_is() -> None:
    assert sorted(gsplat_tools.__all__) == sorted({*gsplat_tools._HOMES, "errors"})
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        _ = gsplat_tools.lode  # type: ignore[attr-defined]


def test_render_and_compare__agree_on_a_scene_with_itself() -> None:
    from tests.clouds import random_cloud

    cloud = random_cloud(50)
    camera = gsplat_tools.Camera.look_at((0, 0, -6), (0, 0, 0), fov_y=50, width=48, height=32)

    rendering = gsplat_tools.render(cloud, camera)
    report = gsplat_tools.compare(cloud, cloud, views=2, size=(48, 32))

    assert rendering.image.shape == (32, 48, 3)
    assert rendering.image.max() > 0.1
    assert report.identical
    assert report.psnr_min is None


@pytest.mark.parametrize(
    "statement", ["import gsplat_tools", "import gsplat_tools.cli.inspect", "import gsplat_tools.cli.convert"]
)
def test_import__loads_no_compiler(statement: str) -> None:
    code = f"{statement}, sys; sys.exit('numba' in sys.modules)"

    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
