"""A file and the JSON beside it: found, checked, and replaced so that a crash at any moment leaves a pair that fits."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.errors import CorruptDataError, GsplatWarning, TargetExistsError, UnknownFormatError
from gsplat_tools.formats import _companion, load, save
from gsplat_tools.formats.loading import inspect_file
from tests.clouds import random_cloud


def store(path: Path, seed: int, *, to: str = "visionary-f16", sh_degree: int = 1, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        return save(random_cloud(20, seed=seed, sh_degree=sh_degree), path, to=to, overwrite=True, order="none", **options)


def read(path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        return load(path)


@pytest.mark.parametrize("to", ["visionary-f32", "visionary-f16", "visionary-i8"])
def test_companion__names_the_format(to: str, tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    store(path, 0, to=to)

    record, facts = inspect_file(path)

    assert (record.id, facts.splats, facts.sh_degree) == (to, 20, 1)
    assert read(path).sh_degree == 1
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.vis", "a.vis.json"]
    described = json.loads((tmp_path / "a.vis.json").read_text())
    assert described["file"]["bytes"] == path.stat().st_size
    assert "previous" not in described


def test_plain_buffers_without_their_companion__are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    store(path, 0)
    (tmp_path / "a.vis.json").unlink()

    with pytest.raises(UnknownFormatError, match=r"a\.vis\.json"):
        load(path)


def test_int8__stands_without_its_companion(tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    store(path, 0, to="visionary-i8")
    (tmp_path / "a.vis.json").unlink()

    assert len(read(path)) == 20


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"format": "visionary-f99"}', '{"file": {"bytes": 3}}', "[" * 100_000, '{"file": 7, "format": "x"}']
)
def test_companion__that_is_broken_or_of_another_file_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    store(path, 0)
    (tmp_path / "a.vis.json").write_text(text)

    with pytest.raises((CorruptDataError, UnknownFormatError)) as caught:
        load(path)
    assert caught.value.path == path


def test_companion__of_a_file_with_one_changed_bit_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    store(path, 0)
    data = bytearray(path.read_bytes())
    data[77] ^= 1
    path.write_bytes(data)

    with pytest.raises(CorruptDataError, match="another file"):
        load(path)


def test_companion__written_by_hand_needs_no_checksum(tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    store(path, 0)
    (tmp_path / "a.vis.json").write_text('{"format": "visionary-f16", "shDegree": 1}')

    assert read(path).sh_degree == 1


def test_companion__that_is_in_the_way_is_not_replaced_unasked(tmp_path: Path) -> None:
    (tmp_path / "a.vis.json").write_text("mine")

    with pytest.raises(TargetExistsError) as caught:
        save(random_cloud(3), tmp_path / "a.vis", to="visionary-f32")

    assert caught.value.path == tmp_path / "a.vis.json"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.vis.json"]


@pytest.mark.parametrize("moment", ["before anything", "between", "after the file"])
def test_crash__at_any_moment_leaves_a_pair_that_fits(moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.vis"
    store(path, 1, sh_degree=2)
    store(tmp_path / "b.vis", 2, sh_degree=1)
    old, new = (read(tmp_path / name) for name in ("a.vis", "b.vis"))
    # As `published` goes: the companion of both, the file, the companion of the new one.
    temporary = tmp_path / ".a.vis.1.x.gsplat-tmp"
    (tmp_path / "b.vis").rename(temporary)
    (tmp_path / "b.vis.json").rename(_companion.path_of(temporary))

    class Crash(Exception):
        pass

    def publish() -> None:
        with _companion.published(temporary, path):
            if moment == "between":
                raise Crash
            temporary.replace(path)
            if moment == "after the file":
                raise Crash

    if moment != "before anything":
        with pytest.raises(Crash):
            publish()

    found = read(path)
    expected = new if moment == "after the file" else old
    assert found.sh_degree == expected.sh_degree
    assert np.array_equal(found.means, expected.means)
    assert inspect_file(path)[1].sh_degree == expected.sh_degree
    # Whatever was left, the next conversion makes it whole.
    store(path, 3, sh_degree=0)
    assert "previous" not in json.loads((tmp_path / "a.vis.json").read_text())
    assert read(path).sh_degree == 0


def test_leftovers__of_a_process_that_is_gone_are_swept(tmp_path: Path) -> None:
    for name in (".a.vis.999999999.0a1b.gsplat-tmp.json", ".a.vis.999999999.0a1b.gsplat-tmp.json.next"):
        (tmp_path / name).write_text("{}")

    store(tmp_path / "a.vis", 0)

    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.vis", "a.vis.json"]


def test_failed_check__leaves_neither_file(tmp_path: Path) -> None:
    def refuse(*_: Any) -> None:
        raise CorruptDataError("no")

    with pytest.raises(CorruptDataError):
        store(tmp_path / "a.vis", 0, check=refuse)
    assert list(tmp_path.iterdir()) == []
