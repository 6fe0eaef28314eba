import io
import json
import zipfile

import numpy as np
import pytest

from gsplat_tools.formats import sog4d
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.saving import split_options
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.tuning import prediction
from gsplat_tools.tuning.measuring import Setting, Workbench
from gsplat_tools.tuning.prediction import _in_proportion, _sizes, predict
from tests.clouds import random_cloud


@pytest.fixture
def samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples small enough that a test's scene is larger than they are."""
    monkeypatch.setattr(prediction, "SMALLEST_SAMPLE", 512)


def test_prediction__of_a_small_scene_is_a_measurement() -> None:
    cloud = random_cloud(300, sh_degree=1)

    found = predict(cloud, Setting(format="spark"), views=2, size=(64, 48))

    point = Workbench(cloud, views=2, size=(64, 48)).measure(Setting(format="spark"))
    assert found.is_exact
    assert found.bytes == point.bytes
    assert point.likeness is not None
    assert found.psnr_min == point.likeness.psnr_min


@pytest.mark.usefixtures("samples")
def test_prediction__of_records_of_one_size_is_exact_in_bytes() -> None:
    found = predict(random_cloud(4000, sh_degree=0), Setting(format="splat"), views=0)

    assert not found.is_exact
    assert found.sampled_splats < 600
    assert found.bytes == 32 * 4000


@pytest.mark.usefixtures("samples")
@pytest.mark.parametrize("target", ["spark", "spz", "gscc"])
def test_prediction__is_near_what_is_measured(target: str) -> None:
    cloud = random_cloud(6000, sh_degree=0)
    cloud = cloud.replace(log_scales=np.clip(cloud.log_scales, -6, -2.5), coordinate_system="RUB")

    found = predict(cloud, Setting(format=target), views=2, size=(160, 90))

    point = Workbench(cloud, views=2, size=(160, 90)).measure(Setting(format=target))
    assert point.likeness is not None
    assert found.bytes == pytest.approx(point.bytes, rel=0.03)
    assert found.psnr_min == pytest.approx(point.likeness.psnr_min, abs=1.5)
    assert found.psnr_mean == pytest.approx(point.likeness.psnr_mean, abs=1.5)


@pytest.mark.usefixtures("samples")
@pytest.mark.parametrize("target", ["sog", "sog4d", "splat4d"])
def test_prediction__gives_samples_their_share_of_the_entries_of_codebooks(target: str) -> None:
    cloud = random_cloud(6000, sh_degree=1)
    setting = Setting(format=target, options={"sh_palette_size": 512})

    found = predict(cloud, setting, views=0)

    point = Workbench(cloud, views=1).measure(setting, draw=False)
    assert found.bytes == pytest.approx(point.bytes, rel=0.06)
    sampled = _in_proportion(setting, {"sh_palette_size": 512, "scale_codebook_size": 3}, 0.125)
    assert sampled.options == {"sh_palette_size": 64, "scale_codebook_size": 1}


@pytest.mark.parametrize("preset", ["fast", "balanced", "best"])
def test_sizes__are_those_of_the_file(preset: str) -> None:
    cloud = random_cloud(3000, sh_degree=1)

    sizes = _sizes(cloud, Setting(format="sog4d", preset=preset))

    data = io.BytesIO()
    _, options = split_options(FORMATS["sog4d"], preset, {})
    sog4d.write(cloud, data, options)
    with zipfile.ZipFile(data) as archive:
        assert len(archive.read("sh/shN_centroids.bin")) <= sizes["sh_palette_size"] * 9 * (2 if preset != "exact" else 4)
        assert len(json.loads(archive.read("meta.json"))["streams"]["scale"]["codebook"]) <= sizes["scale_codebook_size"]
    assert sizes == {"scale_codebook_size": {"fast": 512, "best": 2048}.get(preset, 1024),
                     "sh_palette_size": {"fast": 256, "best": 1024}.get(preset, 512)}  # fmt: skip


@pytest.mark.usefixtures("samples")
def test_prediction__of_a_sequence_grows_by_its_frames() -> None:
    first = random_cloud(3000, sh_degree=0)

    def moved(frame: int) -> GaussianSequence:
        return first.replace(means=first.means + np.float32(0.01 * frame))

    scene = GaussianSequence(moved, num_splats=3000, sh_degree=0, num_frames=9)

    found = predict(scene, Setting(format="sog4d"), views=0)

    point = Workbench(scene, views=1).measure(Setting(format="sog4d"), draw=False)
    assert (found.frames, found.sampled_frames) == (9, 4)
    assert found.bytes == pytest.approx(point.bytes, rel=0.15)
