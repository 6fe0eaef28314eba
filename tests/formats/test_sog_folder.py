import errno
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from gsplat_tools.cli.convert import main
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, GsplatError, TargetExistsError, ValidationError
from gsplat_tools.formats import _folder, load, save
from gsplat_tools.formats.sog import folder
from tests.clouds import random_cloud

IMAGES = {f"{name}.webp" for name in ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels")}


def scene(seed: int = 0) -> GaussianCloud:
    return random_cloud(60, sh_degree=1, seed=seed).replace(log_scales=np.full((60, 3), -4.0))


def names(path: Path) -> set[str]:
    return {entry.name for entry in path.iterdir()}


def assert_equal(a: GaussianCloud, b: GaussianCloud) -> None:
    for name, values in a.arrays().items():
        assert np.array_equal(values, getattr(b, name)), name


def test_folder__holds_what_the_bundle_holds(tmp_path: Path) -> None:
    report = save(scene(), tmp_path / "new" / "meta.json")
    save(scene(), tmp_path / "a.sog")

    assert names(tmp_path / "new") == IMAGES | {"meta.json"}
    assert_equal(load(tmp_path / "new" / "meta.json"), load(tmp_path / "a.sog"))
    assert report.format == "sog"
    assert report.bytes == sum(entry.stat().st_size for entry in (tmp_path / "new").iterdir())


def test_folder__is_guarded(tmp_path: Path) -> None:
    save(scene(), tmp_path / "meta.json")
    before = {entry: entry.read_bytes() for entry in tmp_path.iterdir()}

    with pytest.raises(TargetExistsError, match="--overwrite"):
        save(scene(1), tmp_path / "meta.json")

    assert {entry: entry.read_bytes() for entry in tmp_path.iterdir()} == before


def test_folder__is_replaced_with_the_files_of_the_old_one(tmp_path: Path) -> None:
    (tmp_path / "notes.webp").write_bytes(b"not ours")
    save(scene(), tmp_path / "meta.json")
    save(scene(1), tmp_path / "meta.json", overwrite=True)
    save(scene(1), tmp_path / "a.sog")

    assert_equal(load(tmp_path / "meta.json"), load(tmp_path / "a.sog"))
    assert len(names(tmp_path)) == len(IMAGES) + 3
    assert (tmp_path / "notes.webp").read_bytes() == b"not ours"


def test_folder__never_takes_the_name_of_another_file(tmp_path: Path) -> None:
    (tmp_path / "sh0.webp").write_bytes(b"not ours")

    save(scene(), tmp_path / "meta.json")

    assert (tmp_path / "sh0.webp").read_bytes() == b"not ours"
    assert len(load(tmp_path / "meta.json")) == 60


def test_folder__that_fails_its_check_leaves_no_trace(tmp_path: Path) -> None:
    def refuse(*_: object) -> None:
        raise ValidationError("no")

    with pytest.raises(ValidationError):
        save(scene(), tmp_path / "new" / "meta.json", check=refuse)

    assert names(tmp_path) == set()


@pytest.mark.parametrize("images", range(6))
def test_folder__that_cannot_be_written_keeps_the_old_one(images: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(scene(), tmp_path / "meta.json")
    before = {entry: entry.read_bytes() for entry in tmp_path.iterdir()}
    placing, left = _folder._placing, [images]

    def failing(path: Path, placed: list[Path]) -> object:
        if left[0] == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        left[0] -= 1
        return placing(path, placed)

    monkeypatch.setattr("gsplat_tools.formats._folder._placing", failing)

    with pytest.raises(OSError, match="No space left"):  # six images differ; that of the scales is the same and stays
        save(scene(1), tmp_path / "meta.json", overwrite=True)

    assert {entry: entry.read_bytes() for entry in tmp_path.iterdir()} == before


def test_folder__index_of_something_else_is_replaced_alone(tmp_path: Path) -> None:
    (tmp_path / "meta.json").write_text('{"version": 2, "means": {"files": ["../secret", "a.webp"]}}')
    (tmp_path / "a.webp").write_bytes(b"not ours")

    save(scene(), tmp_path / "meta.json", overwrite=True)

    assert (tmp_path / "a.webp").read_bytes() == b"not ours"


def test_lod_meta__is_not_written(tmp_path: Path) -> None:
    with pytest.raises(CapabilityError, match="cannot tell the format"):
        save(scene(), tmp_path / "lod-meta.json")


def test_archive_beyond_the_limits_of_old_zip__is_written_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(scene(), tmp_path / "a.sog")
    monkeypatch.setattr("zipfile.ZIP64_LIMIT", 1000)  # as if the bundle were of 4 GiB
    monkeypatch.setattr("zipfile.ZIP_FILECOUNT_LIMIT", 2)
    save(scene(), tmp_path / "b.sog")

    assert b"PK\x06\x06" in (tmp_path / "b.sog").read_bytes()
    assert_equal(load(tmp_path / "b.sog"), load(tmp_path / "a.sog"))


def test_level_of_detail__is_an_option_of_the_command(tmp_path: Path) -> None:
    for level, count in enumerate((60, 20)):
        save(scene().take(slice(0, count)), tmp_path / str(level) / "meta.json")
    lods = {str(level): {"file": level, "offset": 0, "count": count} for level, count in enumerate((60, 20))}
    tree = {"bound": {"min": [-9, -9, -9], "max": [9, 9, 9]}, "lods": lods}
    lod = {"version": 1, "lodLevels": 2, "filenames": ["0/meta.json", "1/meta.json"], "tree": tree}
    (tmp_path / "lod-meta.json").write_text(json.dumps(lod))

    def convert(*options: str) -> Result:
        arguments = [str(tmp_path / "lod-meta.json"), str(tmp_path / "out.ply"), "--overwrite", "--no-validate", "--json"]
        return CliRunner().invoke(main, [*arguments, *options])

    assert json.loads(convert().stdout)["splats"] == 60
    assert json.loads(convert("--lod", "1").stdout)["splats"] == 20
    assert convert("--lod", "2").exit_code == 1
    assert "expected a level in 0..1" in convert("--lod", "2").stderr


def test_named_files__of_a_broken_index_are_refused() -> None:
    with pytest.raises(GsplatError):
        folder.named_files(b'{"version": 2}')
