import errno
import os
import stat
from pathlib import Path

import pytest

from gsplat_tools.errors import GsplatError, TargetExistsError, WriteError
from gsplat_tools.formats import _atomic, _files
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


def test_sweep_stale__removes_what_a_killed_process_left(tmp_path: Path) -> None:
    stale = tmp_path / ".scene.bin.1.0a1b2c3d.gsplat-tmp"  # number 1 always runs: the lock tells, not the number
    stale.write_bytes(b"half")
    others = [
        tmp_path / name for name in (".scene.bin2.1.0a.gsplat-tmp", ".scene.bin.1.0a.gsplat-tmp~", "scene.bin.gsplat-tmp")
    ]
    for other in others:
        other.write_bytes(b"")

    with replacing(tmp_path / "scene.bin", overwrite=False) as stream:
        stream.write(b"new")

    assert not stale.exists()
    assert all(other.exists() for other in others)


def test_sweep_stale__leaves_the_temporary_of_a_writer_at_work(tmp_path: Path) -> None:
    target = tmp_path / "scene.bin"

    with replacing(target, overwrite=True) as first:
        first.write(b"first")
        with replacing(target, overwrite=True) as second:
            second.write(b"second")
        assert target.read_bytes() == b"second"

    assert target.read_bytes() == b"first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.bin"]


def test_replacing__makes_its_temporary_again_when_a_sweeper_took_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = _atomic.fcntl.flock
    swept: list[Path] = []

    def sweep_first(handle: int, how: int) -> None:
        if not swept:
            swept.extend(tmp_path.iterdir())
            swept[0].unlink()
        lock(handle, how)

    monkeypatch.setattr(_atomic.fcntl, "flock", sweep_first)
    with replacing(tmp_path / "scene.bin", overwrite=False) as stream:
        stream.write(b"new")

    assert (tmp_path / "scene.bin").read_bytes() == b"new"


def test_replacing__turns_a_full_disk_into_a_located_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_file: object, _data: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(_files, "_raw_write", refuse)
    with (
        pytest.raises(WriteError, match="No space left on device; free some space") as caught,
        replacing(tmp_path / "a.bin", overwrite=False) as stream,
    ):
        stream.write(b"x")

    assert caught.value.path == tmp_path / "a.bin"
    assert not any(tmp_path.iterdir())


def test_replacing__passes_on_what_the_block_raises(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="of the source") as caught, replacing(tmp_path / "a.bin", overwrite=False):
        raise OSError(errno.EIO, "of the source")

    assert not isinstance(caught.value, GsplatError)
    assert not any(tmp_path.iterdir())


def test_replacing__refuses_what_does_not_read_back_as_it_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    sync = os.fsync

    def lose_a_byte(handle: int) -> None:
        sync(handle)
        os.pwrite(handle, b"\0", 2)

    monkeypatch.setattr(os, "fsync", lose_a_byte)
    with pytest.raises(WriteError, match="does not read back the same"), replacing(target, overwrite=True) as stream:
        stream.write(b"whole")

    assert target.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]


def test_replacing__never_replaces_a_file_that_was_made_meanwhile(tmp_path: Path) -> None:
    target = tmp_path / "a.bin"

    with pytest.raises(TargetExistsError, match="appeared"), replacing(target, overwrite=False):
        target.write_bytes(b"theirs")

    assert target.read_bytes() == b"theirs"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]


def test_replacing__does_without_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EOPNOTSUPP, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    with replacing(tmp_path / "a.bin", overwrite=False) as stream:
        stream.write(b"new")

    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_replacing__says_when_the_name_may_be_lost(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sync = os.fsync

    def refuse_folders(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(number, os.strerror(number))
        sync(handle)

    monkeypatch.setattr(os, "fsync", refuse_folders)
    with pytest.raises(WriteError, match="may not survive"), replacing(tmp_path / "a.bin", overwrite=False) as stream:
        stream.write(b"new")

    assert (tmp_path / "a.bin").read_bytes() == b"new"


def test_replacing__takes_names_as_long_as_files_may_have(tmp_path: Path) -> None:
    for _ in range(2):
        with replacing(tmp_path / ("n" * 255), overwrite=True) as stream:
            stream.write(b"new")

    assert (tmp_path / ("n" * 255)).read_bytes() == b"new"
    with pytest.raises(WriteError, match="shorter name"), replacing(tmp_path / ("n" * 256), overwrite=True):
        pytest.fail("the block must not run")


def test_replacing__refuses_a_link_that_leads_to_itself(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")

    with pytest.raises(WriteError, match="leads to itself"), replacing(tmp_path / "a", overwrite=True):
        pytest.fail("the block must not run")


def test_replacing__writes_where_a_dangling_link_leads(tmp_path: Path) -> None:
    (tmp_path / "link.bin").symlink_to("real.bin")

    with replacing(tmp_path / "link.bin", overwrite=False) as stream:
        stream.write(b"new")

    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "real.bin").read_bytes() == b"new"


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
