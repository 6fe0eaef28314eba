import errno
from pathlib import Path

import numpy as np
import pytest

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


def test_named_files__of_a_broken_index_are_refused() -> None:
    with pytest.raises(GsplatError):
        folder.named_files(b'{"version": 2}')
