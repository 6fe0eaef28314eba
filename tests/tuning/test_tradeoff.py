import csv
import io
import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.cli.inspect import main
from gsplat_tools.formats import save
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.saving import split_options
from gsplat_tools.ops.sampling import crop
from gsplat_tools.tuning.measuring import Setting
from gsplat_tools.tuning.tradeoff import measure_tradeoff, pareto_front, settings_of
from tests.clouds import random_cloud

SMALL = {"repeats": 1, "views": 2, "size": (64, 48)}


@given(st.lists(st.tuples(st.integers(1, 6), st.integers(30, 36).map(float)), max_size=12))
def test_front__is_what_no_other_point_beats(points: list[tuple[int, float]]) -> None:
    marks = pareto_front(points)

    for (size, level), mark in zip(points, marks, strict=True):
        beaten = [p for p in points if p != (size, level) and p[0] <= size and p[1] >= level]
        assert mark == (not beaten)


@pytest.mark.parametrize("record", [r for r in FORMATS.values() if r.write], ids=lambda r: r.id)
def test_settings__of_a_format_all_differ_and_hold(record) -> None:
    settings = settings_of(record, 3, knobs=True)

    chosen = [split_options(record, setting.preset, dict(setting.options)) for setting in settings]
    assert len(settings) >= 1
    assert all(chosen.count(each) == 1 for each in chosen)


def test_settings__turn_a_long_knob_to_a_few_values_with_its_ends() -> None:
    record = FORMATS["sog4d"]
    options = [setting.options for setting in settings_of(record, 3, knobs=True, moves=False)]

    pruned = [each["prune_faint"] for each in options if "prune_faint" in each]
    values = record.knobs["prune_faint"].values
    assert len(pruned) <= 6
    assert values[0] in pruned
    assert not any(name in each for each in options for name, knob in record.knobs.items() if knob.sequences_only)


def test_tradeoff__says_what_is_not_possible_without_the_name_of_a_temporary_file() -> None:
    cloud = random_cloud(100, sh_degree=0)
    far = cloud.replace(means=cloud.means + np.float32(40))

    found = measure_tradeoff(far, formats=["spz"], settings=[Setting(format="spz", options={"fractional_bits": 22})], **SMALL)

    (setting, reason), *others = found.skipped
    assert (dict(setting.options), others) == ({"fractional_bits": 22}, [])
    assert reason.startswith("means: 100 of 100 splats")


def test_tradeoff__of_a_crop_says_what_it_is_part_of() -> None:
    cloud = random_cloud(600, sh_degree=0)

    found = measure_tradeoff(cloud, formats=["splat"], crop_to=100, **SMALL)

    assert (found.splats, found.cropped_from) == (100, 600)
    assert {point.bytes for point in found.points} == {3200}


def test_crop__is_the_ball_around_the_median() -> None:
    cloud = random_cloud(500, sh_degree=0)

    part = crop(cloud, 50)

    distances = np.linalg.norm(cloud.means - np.median(cloud.means, axis=0), axis=1)
    assert np.array_equal(part.means, cloud.means[distances <= np.sort(distances)[49]])


class Page(HTMLParser):
    """Gathers what a browser would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.rows = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.rows += tag == "tr"
        self.addresses += [value or "" for name, value in attrs if name in {"src", "href"}]


def test_report__is_one_page_that_fetches_nothing_and_shows_every_point(tmp_path: Path) -> None:
    scene, page, table = tmp_path / "scene.ply", tmp_path / "report.html", tmp_path / "report.csv"
    save(random_cloud(300, sh_degree=1), scene)
    arguments = ["tradeoff", scene, "-o", page, "--csv", table, "--to", "spark", "--to", "spz", "--to", "ply", "--json"]
    arguments += ["--repeats", 1, "--views", 2, "--size", "64x48"]

    result = CliRunner().invoke(main, [str(each) for each in arguments])

    assert result.exit_code == 0, result.output
    points = json.loads(result.stdout)["points"]
    names = "format settings bytes bytes_per_splat encode_seconds decode_seconds psnr_min psnr_mean ssim_mean max_abs pareto"
    assert all(set(names.split()) <= set(point) for point in points)
    assert {point["format"] for point in points} == {"spark", "spz", "ply"}
    assert [point["identical"] for point in points if point["format"] == "ply"] == [True]
    parsed = Page()
    parsed.feed(page.read_text(encoding="utf-8"))
    assert parsed.rows == 2 * (len(points) + 1)  # points, and the errors of their attributes
    assert all(address.startswith("data:image/webp;base64,") for address in parsed.addresses)
    rows = list(csv.DictReader(io.StringIO(table.read_text(encoding="utf-8"))))
    assert [int(row["bytes"]) for row in rows] == [point["bytes"] for point in points]


def test_report__is_not_measured_for_where_its_target_exists(tmp_path: Path) -> None:
    scene, page = tmp_path / "scene.ply", tmp_path / "report.html"
    save(random_cloud(10, sh_degree=0), scene)
    page.write_text("mine", encoding="utf-8")

    result = CliRunner().invoke(main, ["tradeoff", str(scene), "-o", str(page)])

    assert result.exit_code == 1
    assert "--overwrite" in result.stderr
    assert page.read_text(encoding="utf-8") == "mine"
