import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gsplat_tools.cli.inspect import main
from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats import FORMATS, save
from gsplat_tools.validation import GENERAL_RULES, normalize, rules_of, validate
from tests.clouds import random_cloud


def test_validate__has_the_fixed_names(tmp_path: Path) -> None:
    save(random_cloud(10), tmp_path / "a.ply")

    result = CliRunner().invoke(main, ["validate", str(tmp_path / "a.ply"), "--json"])

    report = json.loads(result.stdout)
    assert {"file", "format", "valid", "issues"} <= set(report)
    assert set(report["issues"][0]) == {"code", "severity", "count", "message", "first"}
    assert set(report["issues"][0]["first"][0]) == {"frame", "splat", "path", "value"}
    assert report["valid"] is True
    assert result.exit_code == 0


def test_validate__says_why_a_file_cannot_be_read(tmp_path: Path) -> None:
    save(random_cloud(10), tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-5])

    result = CliRunner().invoke(main, ["validate", str(tmp_path / "a.ply"), "--json"])

    report = json.loads(result.stdout)
    assert result.exit_code == 1
    assert report["valid"] is False
    assert report["issues"][0]["code"] == "truncated"
    assert "bytes" in report["issues"][0]["message"]


def test_validate__gathers_findings_per_code(tmp_path: Path) -> None:
    cloud = random_cloud(100, sh_degree=0)
    means, logits = cloud.means.copy(), np.full(100, -9.0)
    means[[7, 9]] = np.nan
    save(cloud.replace(opacity_logits=logits), tmp_path / "a.ply")
    raw = (tmp_path / "a.ply").read_bytes()
    start = raw.index(b"end_header\n") + len(b"end_header\n")
    rows = np.frombuffer(raw[start:], np.float32).reshape(100, -1).copy()
    rows[:, :3] = means
    (tmp_path / "a.ply").write_bytes(raw[:start] + rows.tobytes())

    issues = {issue["code"]: issue for issue in validate(tmp_path / "a.ply")["issues"]}

    assert issues["invalid-splats"]["count"] == 2
    assert issues["invalid-splats"]["first"][0]["splat"] == 7
    assert issues["invisible"]["count"] == 100
    assert issues["invisible"]["severity"] == "hint"


@pytest.mark.parametrize("record", FORMATS.values(), ids=lambda record: record.id)
def test_rules__do_not_redefine_the_general_ones(record) -> None:  # type: ignore[no-untyped-def]
    assert not set(record.rules) & set(GENERAL_RULES)
    assert all(rule.severity in {"error", "warning", "info", "hint"} and rule.meaning for rule in rules_of(record).values())


def test_normalize__has_nothing_to_do_for_a_ply(tmp_path: Path) -> None:
    save(random_cloud(3), tmp_path / "a.ply")
    before = (tmp_path / "a.ply").read_bytes()

    with pytest.raises(CapabilityError, match="nothing to repair"):
        normalize(tmp_path / "a.ply")

    assert (tmp_path / "a.ply").read_bytes() == before


def test_validate__names_the_file_in_every_error(tmp_path: Path) -> None:
    from tests.formats.sog_files import edited, version_2

    for folder, model in (("a", "default"), ("b", "antialiased")):
        (tmp_path / folder).mkdir()
        for name, data in edited(version_2(0), "model", model).items():
            (tmp_path / folder / name).write_bytes(data)
    leaves = [{"lods": {"0": {"file": file, "offset": 0, "count": 5}}} for file in (0, 1)]
    scene = {"lodLevels": 1, "filenames": ["a/meta.json", "b/meta.json"], "tree": {"children": leaves}}
    (tmp_path / "lod-meta.json").write_text(json.dumps(scene))

    with pytest.raises(CapabilityError, match="several splat models") as caught:
        validate(tmp_path / "lod-meta.json")
    assert caught.value.path == tmp_path / "lod-meta.json"
