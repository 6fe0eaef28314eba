"""NaN and infinity: the same splats are invalid everywhere, and each is counted under its cause."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.convert import convert
from gsplat_tools.errors import CloudError, NonFiniteWarning
from gsplat_tools.formats import load
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.inspection import statistics
from gsplat_tools.numerics import scene_rows
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.sorting import sort_by_depth
from gsplat_tools.validation import validate
from tests.clouds import random_cloud
from tests.reference.splats import camera

CAUSES = {
    "means-nan": 1,
    "means-inf": 2,
    "log_scales-nan": 1,
    "log_scales-inf": 1,
    "quats-nan": 1,
    "quats-inf": 1,
    "quats-zero": 2,
    "opacity_logits-nan": 1,
    "sh0-nan": 1,
    "sh0-inf": 1,
    "shN-nan": 1,
    "shN-inf": 1,
}
INVALID, LEGAL = sum(CAUSES.values()), 3


@pytest.fixture
def broken() -> GaussianCloud:
    """40 splats, the first of which are invalid in every way and then odd in every legal way."""
    arrays = {name: values.copy() for name, values in random_cloud(40, sh_degree=1).arrays().items()}
    arrays["means"][:, 2] += 6
    arrays["means"][0, 1], arrays["means"][1, 0], arrays["means"][2, 2] = np.nan, np.inf, -np.inf
    arrays["log_scales"][3, 0], arrays["log_scales"][4, 1] = np.nan, np.inf
    arrays["quats"][5, 0], arrays["quats"][6, 3], arrays["quats"][7], arrays["quats"][8] = np.nan, -np.inf, 0.0, -0.0
    arrays["opacity_logits"][9] = np.nan
    arrays["sh0"][10, 2], arrays["sh0"][11, 0] = np.nan, -np.inf
    arrays["shN"][12, 2, 1], arrays["shN"][13, 0, 0] = np.nan, np.inf
    arrays["opacity_logits"][14], arrays["opacity_logits"][15] = np.inf, -np.inf
    arrays["log_scales"][16] = -np.inf
    return GaussianCloud(**arrays)


@pytest.fixture
def path(broken: GaussianCloud, tmp_path: Path) -> Path:
    record = FORMATS["ply"]
    assert record.write is not None
    with (tmp_path / "broken.ply").open("wb") as stream:
        record.write(broken, stream, record.write_options())
    return tmp_path / "broken.ply"


def test_load__drops_with_counts_or_refuses(path: Path) -> None:
    with pytest.warns(NonFiniteWarning, match=f"dropped {INVALID} of 40") as caught:
        scene = load(path)

    assert len(scene) == 40 - INVALID
    for cause, count in CAUSES.items():
        assert f"{cause} {count}" in str(caught[0].message)
    with pytest.raises(CloudError, match=f"{INVALID} of 40 splats are invalid.*the first is splat 0"):
        load(path, strict=True)


@pytest.mark.parametrize("target", ["ply", "spz", "uncompressed", "splat", "compressed-ply"])
def test_convert__reports_what_it_dropped(path: Path, tmp_path: Path, target: str) -> None:
    report = convert([path], tmp_path / "out", to=target)

    assert report.dropped == CAUSES
    assert report.splats == 40 - INVALID
    with pytest.raises(CloudError, match="would be dropped"):
        convert([path], tmp_path / "strict", to=target, strict=True)
    assert not (tmp_path / "strict").exists()


def test_reports__count_per_cause(path: Path) -> None:
    (issue,) = (entry for entry in validate(path)["issues"] if entry["code"] == "invalid-splats")
    (hint,) = (entry for entry in statistics(path)["hints"] if entry["code"] == "invalid")

    assert issue["count"] == INVALID
    assert [entry["splat"] for entry in issue["first"]] == [0, 1, 3, 4, 5]
    for cause, count in CAUSES.items():
        assert f"{cause} {count}" in issue["message"]
        assert f"{cause} {count}" in hint["message"]
    attributes = statistics(path)["attributes"]
    assert (attributes["means"]["nan"], attributes["means"]["inf"]) == (1, 2)
    assert attributes["log_scales"]["inf"] == 4


def test_numerics__measures_what_is_left(path: Path) -> None:
    with pytest.warns(NonFiniteWarning, match=f"dropped {INVALID}"):
        rows = scene_rows(path, ["spz"])

    assert {row.within for row in rows} == {True}


@pytest.mark.parametrize("model", ["inria", "unity", "spark"])
def test_render__counts_invalid_splats(broken: GaussianCloud, model: str) -> None:
    counts = render(broken, camera(), model=model).counts

    assert counts.invalid == INVALID
    assert counts.drawn + counts.culled + counts.hidden == 40 - INVALID


def test_sort__puts_nan_last_and_keeps_every_splat(broken: GaussianCloud) -> None:
    for metric in ("depth", "radial"):
        order = sort_by_depth(broken, camera(), metric=metric)  # type: ignore[arg-type]
        assert sorted(order.tolist()) == list(range(40))
        # An infinite x is hidden along the view by 0 times infinity, and far by distance.
        assert order[-1] in (0, 1, 2)
