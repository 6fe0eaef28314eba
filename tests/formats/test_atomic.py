import os
from pathlib import Path

import pytest

from gsplat_tools.errors import GsplatError, TargetExistsError
from gsplat_tools.formats._atomic import replacing


def test_replacing__publishes_the_whole_file(tmp_path: Path) -> None:
    target = tmp_path / "scene.bin"

    with replacing(target, overwrite=False) as stream:
        stream.write(b"whole")
        assert not target.exists()

    assert target.read_bytes() == b"whole"
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.bin"]


def test_replacing__leaves_the_old_file_when_the_block_fails(tmp_path: Path) -> None:
    target = tmp_path / "scene.bin"
    target.write_bytes(b"old")

    with pytest.raises(ZeroDivisionError), replacing(target, overwrite=True) as stream:
        stream.write(bytes([1 // (stream.write(b"half") - 4)]))

    assert target.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.bin"]


def test_replacing__guards_a_target_that_is_there(tmp_path: Path) -> None:
    target = tmp_path / "scene.bin"
    target.write_bytes(b"old")

    with pytest.raises(TargetExistsError, match="--overwrite"), replacing(target, overwrite=False):
        pytest.fail("the block must not run")

    assert target.read_bytes() == b"old"


def test_replacing__names_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(GsplatError, match="folder of the target"), replacing(tmp_path / "no" / "a.bin", overwrite=False):
        pass


def test_replacing__keeps_the_permissions_of_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "scene.bin"
    target.write_bytes(b"old")
    target.chmod(0o640)

    with replacing(target, overwrite=True) as stream:
        stream.write(b"new")

    assert target.stat().st_mode & 0o777 == 0o640


def test_replacing__sweeps_what_a_killed_process_left(tmp_path: Path) -> None:
    dead = 2**22 + 12345  # above the largest process number
    stale = tmp_path / f".scene.bin.{dead}.abc.gsplat-tmp"
    stale.write_bytes(b"half")
    other = tmp_path / f".scene.bin.{os.getpid()}.abc.gsplat-tmp"
    other.write_bytes(b"someone is writing")

    with replacing(tmp_path / "scene.bin", overwrite=False) as stream:
        stream.write(b"new")

    assert not stale.exists()
    assert other.exists()


def test_replacing__turns_a_full_disk_into_a_located_error(tmp_path: Path) -> None:
    with pytest.raises(GsplatError, match="No space left") as caught, replacing(tmp_path / "a.bin", overwrite=False):
        raise OSError(28, "No space left on device")

    assert caught.value.path == tmp_path / "a.bin"
    assert not any(tmp_path.iterdir())


def test_replacing__follows_a_link(tmp_path: Path) -> None:
    (tmp_path / "real.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to(tmp_path / "real.bin")

    with replacing(tmp_path / "link.bin", overwrite=True) as stream:
        stream.write(b"new")

    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "real.bin").read_bytes() == b"new"


def test_replacing__refuses_what_is_no_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")

    with pytest.raises(GsplatError, match="not a regular file"), replacing(tmp_path / "pipe", overwrite=True):
        pytest.fail("the block must not run")
