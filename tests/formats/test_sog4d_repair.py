"""gsplat-inspect normalize: old spellings of meta.json become today's, and nothing else changes."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gsplat_tools.cli.inspect import main
from gsplat_tools.errors import FormatError
from gsplat_tools.formats import load
from gsplat_tools.sequence import GaussianSequence
from gsplat_tools.validation import normalize, validate
from tests.sog4d_bundles import BROKEN, archive, valid_bundle, valid_files, valid_meta


def legacy_bundle() -> bytes:
    """No format, vectors as lists, a null."""
    meta = valid_meta()
    del meta["format"]
    meta["comment"] = None
    for name in ("rangeMin", "rangeMax"):
        meta["streams"]["position"][name] = [list(v.values()) for v in meta["streams"]["position"][name]]
    meta["streams"]["scale"]["codebook"] = [list(v.values()) for v in meta["streams"]["scale"]["codebook"]]
    return archive(meta, valid_files())


def test_normalize__makes_a_legacy_bundle_valid_and_keeps_what_it_shows(tmp_path: Path) -> None:
    (tmp_path / "old.sog4d").write_bytes(legacy_bundle())
    (tmp_path / "today.sog4d").write_bytes(valid_bundle())
    assert not validate(tmp_path / "old.sog4d")["valid"]

    changes = normalize(tmp_path / "old.sog4d", tmp_path / "new.sog4d")

    assert len(changes) == 5
    report = validate(tmp_path / "new.sog4d")
    assert report["valid"]
    assert not {"vector-list", "json-null"} & {issue["code"] for issue in report["issues"]}
    repaired, expected = load(tmp_path / "new.sog4d"), load(tmp_path / "today.sog4d")
    assert isinstance(repaired, GaussianSequence)
    assert isinstance(expected, GaussianSequence)
    for frame in range(len(expected)):
        for name, values in expected.frame(frame).arrays().items():
            assert np.array_equal(values, getattr(repaired.frame(frame), name)), name


def test_normalize__keeps_halves_of_surrogate_pairs_escaped(tmp_path: Path) -> None:
    (tmp_path / "old.sog4d").write_bytes(archive({**valid_meta(), "generator": "é\ud800", "comment": None}, valid_files()))

    normalize(tmp_path / "old.sog4d", tmp_path / "new.sog4d")

    with zipfile.ZipFile(tmp_path / "new.sog4d") as bundle:
        assert json.loads(bundle.read("meta.json"))["generator"] == "é\ud800"


def test_normalize__in_place_replaces_the_file_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "old.sog4d"
    path.write_bytes(legacy_bundle())

    result = CliRunner().invoke(main, ["normalize", str(path)])

    assert result.exit_code == 0
    assert "added the missing field format" in result.stderr
    with zipfile.ZipFile(path) as bundle:
        assert json.loads(bundle.read("meta.json"))["format"] == "sog4d"
        assert len(set(bundle.namelist())) == len(bundle.namelist())
    assert [entry.name for entry in tmp_path.iterdir()] == ["old.sog4d"]


def test_normalize__says_that_there_is_nothing_to_repair(tmp_path: Path) -> None:
    (tmp_path / "a.sog4d").write_bytes(valid_bundle())

    assert normalize(tmp_path / "a.sog4d", tmp_path / "b.sog4d") == []
    assert validate(tmp_path / "b.sog4d")["valid"]


@pytest.mark.parametrize("code", ["meta-json", "meta-missing", "bands", "range-value"])
def test_normalize__leaves_alone_what_is_wrong_beyond_its_spelling(code: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.sog4d"
    path.write_bytes(BROKEN[code]())
    before = path.read_bytes()

    with pytest.raises(FormatError) as caught:
        normalize(path)

    assert caught.value.path == path
    assert path.read_bytes() == before


def test_validate__lists_broken_rules_with_their_offenders(tmp_path: Path) -> None:
    path = tmp_path / "bad.sog4d"
    path.write_bytes(BROKEN["index-range"]())

    result = CliRunner().invoke(main, ["validate", str(path), "--json"])

    issue = json.loads(result.stdout)["issues"][0]
    assert result.exit_code == 1
    assert (issue["code"], issue["severity"]) == ("index-range", "error")
    assert issue["first"][0]["frame"] is not None
    assert issue["first"][0]["splat"] is not None
