import warnings
from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.chunks import as_chunks
from gsplat_tools.convert import convert
from gsplat_tools.errors import CapabilityError, CloudError, GsplatWarning, LossyConversionWarning, ValidationError
from gsplat_tools.formats import FORMATS, load, save
from gsplat_tools.formats.preparing import SaveChoices, prepare
from gsplat_tools.verification import Validation
from tests.clouds import random_cloud


def test_save__reports_what_it_wrote(tmp_path: Path) -> None:
    report = save(random_cloud(40, sh_degree=2), tmp_path / "a.ply")

    assert (report.format, report.splats, report.sh_degree, report.frames) == ("ply", 40, 2, 1)
    assert report.bytes == (tmp_path / "a.ply").stat().st_size


def test_save__names_the_options_there_are(tmp_path: Path) -> None:
    with pytest.raises(CapabilityError, match=r"has no option rotaton; it has .*rotation"):
        save(random_cloud(4), tmp_path / "a.gspk", rotaton="best")
    with pytest.raises(CapabilityError, match="cannot tell the format"):
        save(random_cloud(4), tmp_path / "a.xyz")
    with pytest.raises(CapabilityError, match="unknown format 'jpeg'"):
        save(random_cloud(4), tmp_path / "a.xyz", to="jpeg")
    assert list(tmp_path.iterdir()) == []


def test_save__of_chunks_is_save_of_the_cloud(tmp_path: Path) -> None:
    cloud = random_cloud(500, sh_degree=1)

    save(cloud, tmp_path / "whole.ply")
    save(as_chunks(cloud, 37), tmp_path / "chunks.ply")

    assert (tmp_path / "whole.ply").read_bytes() == (tmp_path / "chunks.ply").read_bytes()


def test_prepare__drops_bands_that_are_zero_everywhere_unless_the_target_is_lossless() -> None:
    cloud = random_cloud(10, sh_degree=3)
    shN = cloud.shN.copy()
    shN[:, 3:] = 0
    cloud = cloud.replace(shN=shN)

    assert prepare(cloud, FORMATS["spark"], SaveChoices()).scene.sh_degree == 1
    assert prepare(cloud, FORMATS["ply"], SaveChoices()).scene.sh_degree == 3
    assert prepare(cloud, FORMATS["ply"], SaveChoices(sh_degree="auto")).scene.sh_degree == 1
    assert prepare(cloud, FORMATS["spark"], SaveChoices(sh_degree=2)).scene.sh_degree == 2


def test_prepare__converts_axes_that_are_known_and_refuses_to_guess() -> None:
    cloud = random_cloud(10, sh_degree=1)

    turned = prepare(cloud, FORMATS["ply"], SaveChoices(source_coordinates="RUB", target_coordinates="RUF")).scene

    whole = turned.read()  # type: ignore[union-attr]
    assert np.array_equal(whole.means, cloud.means * [1, 1, -1])
    assert whole.coordinate_system == "RUF"
    with pytest.raises(CloudError, match="--source-coordinates"):
        prepare(cloud, FORMATS["ply"], SaveChoices(target_coordinates="RUF"))


def test_prepare__folds_an_origin_where_the_target_has_no_place_for_it() -> None:
    cloud = random_cloud(50, sh_degree=0).replace(origin=np.array([4000.0, 0, 0]), coordinate_system="RUF")

    with pytest.warns(GsplatWarning, match="--recenter on"):
        folded = prepare(cloud, FORMATS["gscc"], SaveChoices()).scene.read()  # type: ignore[union-attr]
    with pytest.warns(LossyConversionWarning, match=r"does not store the origin"):
        kept = prepare(cloud, FORMATS["gscc"], SaveChoices(recenter="on")).scene.read()  # type: ignore[union-attr]

    assert not folded.origin.any()
    assert np.allclose(folded.means, cloud.means + np.array([4000, 0, 0]), atol=3e-4)
    assert np.abs(kept.means).max() < 10


def test_prepare__keeps_a_stored_origin() -> None:
    cloud = random_cloud(50, sh_degree=0).replace(origin=np.array([5e5, 4e6, 100.0]))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = prepare(cloud, FORMATS["ply"], SaveChoices()).scene.read()  # type: ignore[union-attr]

    assert np.array_equal(kept.origin, cloud.origin)
    assert np.array_equal(kept.means, cloud.means)


def test_prepare__orders_on_request() -> None:
    cloud = random_cloud(200, sh_degree=0)

    ordered = prepare(cloud, FORMATS["spark"], SaveChoices(order="morton")).scene

    assert not np.array_equal(ordered.means, cloud.means)  # type: ignore[union-attr]
    assert np.array_equal(np.sort(ordered.means, axis=0), np.sort(cloud.means, axis=0))  # type: ignore[union-attr]


def test_convert__refuses_what_does_not_hold_its_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A writer that is wrong must not replace a target."""
    from dataclasses import replace

    save(random_cloud(60, sh_degree=0), tmp_path / "a.ply")
    (tmp_path / "b.gspk").write_bytes(b"old")
    record = FORMATS["uncompressed"]

    def write_wrong(scene, stream, options) -> None:  # type: ignore[no-untyped-def]
        assert record.write is not None
        record.write(scene.map(lambda chunk: chunk.replace(means=chunk.means + np.float32(0.01))), stream, options)

    monkeypatch.setitem(FORMATS, "uncompressed", replace(record, write=write_wrong))
    with pytest.raises(ValidationError, match="means: 180 of 180 values beyond their bound"):
        convert([tmp_path / "a.ply"], tmp_path / "b.gspk", to="uncompressed", overwrite=True)

    assert (tmp_path / "b.gspk").read_bytes() == b"old"
    convert([tmp_path / "a.ply"], tmp_path / "b.gspk", to="uncompressed", overwrite=True, validation=None)
    assert (tmp_path / "b.gspk").read_bytes() != b"old"


def test_convert__renders_with_the_model_of_the_target(tmp_path: Path) -> None:
    save(random_cloud(60, sh_degree=0), tmp_path / "a.ply")

    report = convert([tmp_path / "a.ply"], tmp_path / "b.gspk", validation=Validation(views=1, size=(48, 32)))

    assert report.validation is not None
    assert report.validation["model"] == "unity"
    assert report.validation["psnr_min"] > 30
    assert isinstance(load(tmp_path / "b.gspk"), type(random_cloud(0)))
