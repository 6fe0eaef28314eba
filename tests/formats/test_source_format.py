import json
import warnings
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from gsplat_tools.cli.convert import main
from gsplat_tools.errors import CloudError, GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.sequences import open_sequence
from tests.clouds import random_cloud


def save_counting(scene: object, path: Path, **options: object) -> list[str]:
    """Save and return the messages of warnings about a lossy source."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        save(scene, path, **options)
    return [str(w.message) for w in caught if getattr(w.message, "code", "") == "lossy-to-lossy"]


def read(path: Path) -> object:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        return load(path)


def lossy(folder: Path, name: str = "a.spz") -> object:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        save(random_cloud(50, sh_degree=1), folder / name, overwrite=True)
    return read(folder / name)


@pytest.mark.parametrize("target", ["b.sog", "b.spz", "b.compressed.ply", "b.gspk", "b.splat", "b.sog4d"])
def test_lossy_to_lossy__warns_once_and_names_both(target: str, tmp_path: Path) -> None:
    messages = save_counting(lossy(tmp_path), tmp_path / target)

    assert len(messages) == 1
    assert "stored as spz" in messages[0]
    assert f"and {inspect_file(tmp_path / target)[0].id} is lossy too" in messages[0]


def test_lossy_to_exact__does_not_warn_and_records_the_source(tmp_path: Path) -> None:
    assert save_counting(lossy(tmp_path), tmp_path / "b.ply") == []
    assert save_counting(lossy(tmp_path), tmp_path / "b.gspk", to="uncompressed") == []

    assert b"\ncomment source_format spz\n" in (tmp_path / "b.ply").read_bytes()
    assert save_counting(lossy(tmp_path), tmp_path / "b.vis", to="visionary-f32") == []
    assert read(tmp_path / "b.vis").source_format == "spz"
    for name in ("b.ply", "b.gspk", "b.vis"):
        assert len(save_counting(read(tmp_path / name), tmp_path / "c.sog", overwrite=True)) == 1


def test_exact_to_lossy__does_not_warn(tmp_path: Path) -> None:
    for name, to in (("a.ply", "ply"), ("a.gspk", "uncompressed")):
        save(random_cloud(50, sh_degree=1), tmp_path / name, to=to)
        assert save_counting(read(tmp_path / name), tmp_path / "b.sog", overwrite=True) == []
    assert b"source_format" not in (tmp_path / "a.ply").read_bytes()


def test_bundles__say_in_the_generator_what_they_were_made_from(tmp_path: Path) -> None:
    for name in ("b.sog", "b.sog4d"):
        save_counting(lossy(tmp_path), tmp_path / name)
        with zipfile.ZipFile(tmp_path / name) as archive:
            meta = json.loads(archive.read("meta.json"))
        assert meta.get("asset", meta)["generator"].endswith(" from spz")
        assert inspect_file(tmp_path / name)[1].encoding["generator"].endswith(" from spz")


def test_packs__name_the_source_in_their_description(tmp_path: Path) -> None:
    save_counting(lossy(tmp_path), tmp_path / "b.gspk")

    assert inspect_file(tmp_path / "b.gspk")[1].encoding["source_format"] == "spz"
    assert read(tmp_path / "b.gspk").source_format == "spark"  # the last lossy step is the one to warn of


def test_sequence_of_lossy_frames__warns_once(tmp_path: Path) -> None:
    for name in ("1.spz", "2.spz", "3.spz"):
        lossy(tmp_path, name)

    assert len(save_counting(open_sequence(tmp_path), tmp_path / "b.sog4d")) == 1
    assert read(tmp_path / "b.sog4d").frame(2).source_format == "sog4d"


@pytest.mark.parametrize("word", ["a\u00e9", "../x", "x" * 40, "A"])
def test_comment_of_someone_else__says_nothing(word: str, tmp_path: Path) -> None:
    save(random_cloud(5, sh_degree=0), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"\nelement", f"\ncomment source_format {word}\nelement".encode(), 1))

    assert read(tmp_path / "b.ply").source_format == ""
    with pytest.raises(CloudError, match="id of a format"):
        random_cloud(5).replace(source_format=word)


@pytest.mark.parametrize("sources", [["a.spz"], ["a.spz", "b.spz"]])
def test_report__has_the_format_of_the_source(sources: list[str], tmp_path: Path) -> None:
    for name in sources:
        lossy(tmp_path, name)
    arguments = [*(str(tmp_path / name) for name in sources), str(tmp_path / "c.sog4d"), "--json", "--no-validate"]

    report = json.loads(CliRunner().invoke(main, arguments).stdout)

    assert report["source_format"] == "spz"
    assert [warning["code"] for warning in report["warnings"]].count("lossy-to-lossy") == 1
