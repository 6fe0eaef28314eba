import numpy as np
import pytest

from gsplat_tools.errors import LossyConversionWarning
from gsplat_tools.formats import load, save
from gsplat_tools.tuning.measuring import Setting, Workbench
from tests.clouds import random_cloud


@pytest.fixture(scope="module")
def bench() -> Workbench:
    return Workbench(random_cloud(400, sh_degree=2), views=3, size=(96, 64))


def test_point__has_the_bytes_and_errors_of_the_file_that_save_writes(bench: Workbench, tmp_path) -> None:
    point = bench.measure(Setting(format="splat"))

    with pytest.warns(LossyConversionWarning):
        saved = save(bench.scene, tmp_path / "scene.splat")
    decoded = load(saved.path)
    assert point.bytes == saved.bytes == saved.path.stat().st_size
    assert point.attributes["means"]["max"] == pytest.approx(np.abs(decoded.means - bench.scene.means).max(), rel=1e-5)
    assert point.bytes_per_splat == saved.bytes / 400


def test_likeness__is_identical_for_a_lossless_format_and_against_the_whole_source(bench: Workbench) -> None:
    exact = bench.measure(Setting(format="ply")).likeness
    reduced = bench.measure(Setting(format="ply", options={"sh_degree": 0})).likeness

    assert exact is not None
    assert reduced is not None
    assert exact.psnr_min is None
    assert exact.level == np.inf
    assert reduced.psnr_min is not None
    assert reduced.psnr_min < 60


def test_likeness__is_in_the_axes_of_a_format_that_converts_them(bench: Workbench) -> None:
    likeness = bench.measure(Setting(format="gscc")).likeness

    assert likeness is not None
    assert likeness.level > 30


def test_worst_view__is_the_pair_with_the_lowest_level(bench: Workbench) -> None:
    seen = []
    point = bench.measure(Setting(format="splat"), see=lambda source, candidate: seen.append((source, candidate)))

    (source, candidate) = seen[0]
    error = np.square(np.clip(source, 0, 1).astype(np.float64) - np.clip(candidate, 0, 1)).mean()
    assert point.likeness is not None
    assert -10 * np.log10(error) == pytest.approx(point.likeness.psnr_min, abs=1e-6)
