"""Every format at the extremes: no value beyond its own bound, nothing that vanishes from the report."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from gsplat_tools.cli.inspect import main
from gsplat_tools.formats.base import Bounds
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.saving import save
from gsplat_tools.numerics import (
    Row,
    exceeded_rows,
    measure_cloud,
    plot_page,
    plot_svg,
    scene_rows,
    summarize,
    synthetic_rows,
)
from gsplat_tools.numerics.conditions import conditions, ordinary
from gsplat_tools.numerics.halves import half_row
from tests.clouds import random_cloud

MEASURED = [record for record in FORMATS.values() if record.read is not None and record.write is not None]


@pytest.mark.parametrize("record", MEASURED, ids=lambda record: record.id)
def test_format__holds_its_bounds_in_every_sweep(record: Any) -> None:
    rows = synthetic_rows([record.id])

    assert [f"{row.attribute}, {row.condition}: {row.measured_max} above {row.bound}" for row in exceeded_rows(rows)] == []
    sweeps = {row.sweep for row in rows}
    assert {"position", "log scale", "needle", "rotation", "opacity logit", "sh0", "SH degree 3", "subnormal"} <= sweeps
    assert ("motion" in sweeps) == record.holds_motion
    assert ("sequence" in sweeps) == record.holds_sequences
    # Nothing without a bound is left without a reason, and what logarithms cannot say is bounded as a length.
    unbounded = [row for row in rows if row.within is None]
    assert [row for row in unbounded if "no bound" not in row.note and not row.note.startswith("refused")] == []
    measured = {row.condition for row in rows if row.attribute == "scales" and not row.note.startswith("refused")}
    lengths = {row.condition: row for row in rows if row.attribute == "scales (linear)"}
    assert set(lengths) == measured
    # The step of a range that reaches 3e38 is beyond float64.
    beyond = ["log scale 3e+38"] if record.id == "visionary-i8" else []
    assert [row.condition for row in lengths.values() if row.within is None] == beyond
    assert {"rotations (degrees)", "shN"} <= {row.attribute for row in rows if row.within} or record.max_sh_degree == 0


def test_conditions__reach_the_extremes() -> None:
    points = list(conditions())

    means = np.concatenate([np.abs(p.cloud.means).ravel() + np.abs(p.cloud.origin).max() for p in points])
    assert means.max() >= 1e8
    assert {p.x for p in points if p.sweep == "position"} == {10.0**k for k in range(-8, 8)}
    assert {p.label for p in points if p.sweep == "needle"} >= {"1", "1e+05"}
    logs = np.concatenate([p.cloud.log_scales.ravel() for p in points])
    assert logs.max() > 2.9e38
    assert np.isneginf(logs).any()
    logits = np.concatenate([p.cloud.opacity_logits for p in points])
    assert {-np.inf, np.inf} <= set(logits.tolist())
    assert max(np.abs(p.cloud.shN).max() for p in points if p.cloud.sh_degree == 4) >= 999
    assert max(np.abs(p.cloud.velocities).max() for p in points if p.cloud.velocities is not None) >= 9e29
    assert any((p.cloud.means.view(np.uint32) == 0x80000000).any() for p in points), "-0"
    smallest = min(np.abs(p.cloud.means[p.cloud.means != 0]).min() for p in points if p.cloud.means.any())
    assert 0 < smallest < np.finfo(np.float32).tiny


@pytest.mark.parametrize("attribute", ["means", "scales", "opacities", "sh0", "shN"])
def test_exceeded_rows__notice_a_bound_that_is_half_of_what_it_should_be(attribute: str) -> None:
    record = FORMATS["spark"]
    assert record.bounds is not None
    whole = record.bounds

    def halved(*arguments: Any) -> Bounds:
        limits = whole(*arguments)
        return {**limits, attribute: limits[attribute] / 2}

    rows = measure_cloud(ordinary(3), dataclasses.replace(record, bounds=halved))

    # The bound of lengths follows from that of their logarithms.
    expected = [attribute, "scales (linear)"] if attribute == "scales" else [attribute]
    assert [row.attribute for row in exceeded_rows(rows)] == expected


def test_refused_clouds__stay_in_the_report() -> None:
    far = ordinary(means=np.full((96, 3), 1e6) * np.linspace(-1, 1, 96)[:, None])

    rows = measure_cloud(far, FORMATS["gscc"], watched=["means", "scales"], sweep="position", label="1e+06", x=1e6)

    assert [(row.attribute, row.within, row.bound) for row in rows] == [("means", None, None), ("scales", None, None)]
    assert all(row.note.startswith("refused: ") and "half precision" in row.note for row in rows)


def test_positions__with_an_origin_are_measured_in_the_world() -> None:
    cloud = ordinary(origin=np.array([1e7, -1e7, 0.1]))

    folded = {row.attribute: row for row in measure_cloud(cloud, FORMATS["splat"])}["means"]
    kept = {row.attribute: row for row in measure_cloud(cloud, FORMATS["uncompressed"])}["means"]

    assert folded.within
    assert folded.measured_max == pytest.approx(0.5, abs=0.1)  # float32 has steps of 1 there
    assert kept.measured_max == 0


def test_half_rows__are_those_of_their_format(tmp_path: Path) -> None:
    save(random_cloud(20, sh_degree=0), tmp_path / "scene.ply")

    for names, expected in (["spz"], set()), (["spz", "visionary-f16"], {"visionary-f16"}):
        rows = [*synthetic_rows(names, ["needle"]), *scene_rows(tmp_path / "scene.ply", names)]
        assert {row.format for row in rows if row.attribute.startswith("vanished")} == expected
        assert {row.format for row in rows} == set(names)


def test_half_row__counts_needles_that_lose_their_minor_axis() -> None:
    thick = half_row(ordinary(log_scales=np.full((96, 3), -3.0)), "needle", "1")
    thin = half_row(ordinary(log_scales=np.tile([0.0, -9.0, -9.0], (96, 1))), "needle", "8e3")

    assert thick.measured_max == 0
    assert thin.measured_max is not None
    assert thin.bound == 1
    assert thin.measured_max > 0.3
    assert thin.within


def test_summarize__keeps_the_row_nearest_its_bound() -> None:
    def row(condition: str, tightness: float | None, within: bool | None, note: str = "") -> Row:
        return Row(format="a", attribute="means", condition=condition, tightness=tightness, within=within, sweep="s", note=note)

    rows = [row("1", 0.5, True), row("2", 0.9, True), row("3", None, None, "refused: no")]
    assert [(r.condition, count, refused) for r, count, refused in summarize(rows)] == [("2", 3, 1)]
    assert next(summarize([*rows, row("4", 0.1, False)]))[0].condition == "4"


def test_scene_rows__cover_every_format(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    save(random_cloud(500, sh_degree=1), path)

    rows = scene_rows(path, max_splats=200)

    assert exceeded_rows(rows) == []
    assert {row.format for row in rows} >= {record.id for record in MEASURED}
    assert {row.condition for row in rows} == {"scene every 3th splat"}


def test_plots__are_one_file_without_links() -> None:
    rows = synthetic_rows(["spark"], ["position", "opacity logit"])

    page, svg = plot_page(rows, title="a <b>"), plot_svg(rows)

    assert "a &lt;b&gt;" in page
    for text in (page, svg):
        assert text.count("<polyline") >= 6
        assert "means against position" in text
        assert not re.search(r"(href|src)=", text)
        assert "nan" not in text
    assert "&#215;<title>refused" in svg
    assert svg.startswith("<svg xmlns=")


@pytest.mark.parametrize(
    ("errors", "shown"),
    [
        ([1e-45, 1e-30, 1e-4, 2e-3, 2e-3, 2e-3], [1e-4, 2e-3]),  # opacities of huge logits
        ([1e-3, 2e-3, 1e-2, 1e78], [1e-3, 1e-2]),  # covariances of splats that grew from nothing
    ],
)
def test_plots__show_the_decades_that_hold_most_values(errors: list[float], shown: list[float]) -> None:
    rows = [
        Row(format="x", attribute="a", condition="c", sweep="s", x=float(i + 1), measured_max=error, bound=error, within=True)
        for i, error in enumerate(errors)
    ]

    places = [float(y) for y in re.findall(r'<circle cx="[^"]*" cy="([^"]*)"', plot_svg(rows))]

    inside = [place for place, error in zip(places, errors, strict=True) if shown[0] <= error <= shown[1]]
    assert max(inside) - min(inside) > 40
    for place, error in zip(places, errors, strict=True):  # y grows downwards
        assert place > max(inside) or error >= shown[0]
        assert place < min(inside) or error <= shown[1]


def test_command__prints_json_and_writes_a_plot(tmp_path: Path) -> None:
    scene, plot = tmp_path / "scene.ply", tmp_path / "plot.html"
    save(random_cloud(60, sh_degree=0), scene)

    result = CliRunner().invoke(main, ["numerics", str(scene), "--format", "spz", "--json", "-o", str(plot)])

    assert result.exit_code == 0
    rows = json.loads(result.stdout)["rows"]
    assert {"format", "attribute", "condition", "bound", "measured_max", "measured_rms", "within"} <= set(rows[0])
    assert {row["attribute"] for row in rows if row["format"] == "spz"} == {
        "means",
        "scales",
        "scales (linear)",
        "covariances",
        "rotations (degrees)",
        "opacities",
        "sh0",
    }
    assert plot.read_text().startswith("<!doctype html>")
    again = CliRunner().invoke(main, ["numerics", str(scene), "--format", "spz", "-o", str(plot)])
    assert again.exit_code == 1
    assert "--overwrite" in again.output


def test_command__exits_with_1_where_a_bound_is_exceeded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tmp_path / "scene.ply"
    save(random_cloud(60, sh_degree=0), scene)
    broken = dataclasses.replace(FORMATS["splat"], bounds=lambda *_: {"opacities": np.zeros(1)})
    monkeypatch.setitem(FORMATS, "splat", broken)

    result = CliRunner().invoke(main, ["numerics", str(scene), "--format", "splat"])

    assert result.exit_code == 1
    assert "1 of" in result.stderr


@pytest.mark.parametrize("arguments", [[], ["--synthetic", "FILE"]])
def test_command__wants_a_file_or_sweeps(arguments: list[str], tmp_path: Path) -> None:
    scene = tmp_path / "scene.ply"
    save(random_cloud(3, sh_degree=0), scene)

    result = CliRunner().invoke(main, ["numerics", *(str(scene) if word == "FILE" else word for word in arguments)])

    assert result.exit_code == 2
