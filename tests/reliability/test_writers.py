"""Whatever happens to a writer, the target is the old or the new one, and nobody is told otherwise."""

from __future__ import annotations

import errno
import io
import os
import resource
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gsplat_tools.errors import WriteError
from gsplat_tools.formats import _files, _folder, saving
from gsplat_tools.formats.base import FolderLayout
from tests.reliability.cases import Case, cases
from tests.reliability.crash import (
    ACTS,
    NEW,
    fail_at_operations,
    interrupt_at_lines,
    kill_at_lines,
    kill_at_operations,
    kill_at_random,
    targets,
)
from tests.reliability.faults import EXIT_REFUSED, Operations, failing, in_child, leftovers, operations_of

KINDS = [case for case in cases() if case.id in {"ply", "spark", "sog4d-sequence", "sog-folder", "visionary-f16"}]
"""A plain file, packs, archives, folders, files with companions."""

every_writer = pytest.mark.parametrize("case", cases(), ids=lambda case: case.id)
one_of_each_kind = pytest.mark.parametrize("case", KINDS, ids=lambda case: case.id)
old_or_absent = pytest.mark.parametrize("exists", [True, False], ids=["old", "absent"])
every_writer_over_an_old_target = pytest.mark.parametrize(
    ("case", "exists"),
    [pytest.param(case, True, id=f"{case.id}-old") for case in cases()]
    + [pytest.param(case, False, id=f"{case.id}-absent") for case in KINDS],
)


@every_writer_over_an_old_target
def test_kill__at_operations_leaves_the_old_or_the_new_target(case: Case, exists: bool) -> None:
    acts = {name: ACTS[name] for name in ("before", "halfway")}  # after one is before the next

    outcomes = kill_at_operations(case, exists=exists, acts=acts, most=2)

    assert outcomes["new"] > 0
    assert outcomes["old" if exists else "absent"] > 0


@one_of_each_kind
@old_or_absent
def test_kill__at_lines_leaves_the_old_or_the_new_target(case: Case, exists: bool) -> None:
    outcomes = kill_at_lines(case, exists=exists, step=25)

    assert outcomes["old" if exists else "absent"] > 0


@one_of_each_kind
@old_or_absent
def test_interruption__at_lines_leaves_no_temporary(case: Case, exists: bool) -> None:
    outcomes = interrupt_at_lines(case, exists=exists, step=7)

    assert set(outcomes) == {"old" if exists else "absent"}


@every_writer
def test_kill__at_random_leaves_the_old_or_the_new_target(case: Case) -> None:
    assert kill_at_random(case, exists=True, times=2, splats=300)


@every_writer_over_an_old_target
def test_faults__at_any_operation_are_errors_or_do_no_harm(case: Case, exists: bool) -> None:
    outcomes = fail_at_operations(case, exists=exists, most=2)

    assert outcomes["old" if exists else "absent"] > 0


@one_of_each_kind
def test_short_writes__are_continued(case: Case) -> None:
    with targets(case, 12, exists=True) as fresh:
        target = fresh()
        first = operations_of(fresh().write).index("write")

        with Operations(first, failing(errno.EIO, halfway=True), keeps_on=True).installed():
            target.write()

        assert target.check("with short writes") == "new"


@every_writer
def test_header__that_contradicts_the_scene_keeps_the_target_as_it_was(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    count = saving.count_splats
    with targets(case, 12, exists=True) as fresh:
        target = fresh()
        monkeypatch.setattr(saving, "count_splats", lambda scene: count(scene) + 1)

        with pytest.raises(WriteError, match="13 splats"):
            target.write()

        assert target.check("a header that lies") == "old"


@every_writer
def test_size_limit__of_the_process_is_an_error(case: Case) -> None:
    with targets(case, 200, exists=True) as fresh:
        target = fresh()

        def work() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
            with pytest.raises(WriteError, match="allows no file of this size"):
                target.write()

        assert in_child(work) == 0
        assert target.check("a size limit") == "old"
        assert leftovers(target.path.parent) == []


@pytest.fixture
def tiny_disk() -> Iterator[Path]:
    """A file system of 64 KiB."""
    with tempfile.TemporaryDirectory() as name:
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", name], capture_output=True, check=False)
        if mounted.returncode:
            pytest.skip("file systems cannot be mounted here")
        try:
            yield Path(name)
        finally:
            subprocess.run(["umount", name], check=True)


@every_writer
def test_small_file_system__that_is_full_is_an_error(case: Case, tiny_disk: Path) -> None:
    path = tiny_disk / case.name
    case.write(path, 2)
    before = case.content(path)

    with pytest.raises(WriteError, match="No space left on device"):
        case.write(path, 6000)

    assert case.content(path) == before
    assert leftovers(tiny_disk) == []


@pytest.fixture
def folder_of_another() -> Iterator[Path]:
    """A folder that everyone may enter."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def as_nobody(work: Callable[[], object]) -> int:
    """Do some work without the rights of the superuser."""

    def powerless() -> None:
        if os.geteuid() == 0:
            os.setgid(65534)
            os.setuid(65534)
        work()

    return in_child(powerless)


@one_of_each_kind
def test_read_only_folder__is_an_error(case: Case, folder_of_another: Path) -> None:
    path = folder_of_another / case.name
    case.write(path)
    before = case.content(path)
    folder_of_another.chmod(0o555)

    def work() -> None:
        with pytest.raises(WriteError, match=r"Permission denied; change|write-protected"):
            case.write(path, seed=NEW)
        with pytest.raises(WriteError, match="Permission denied; change"):
            case.write(path.with_name("other-" + path.name) if case.record.folder is None else path, seed=NEW)

    if case.record.folder is None:
        assert as_nobody(work) == 0
    else:
        assert as_nobody(lambda: case.write(path, seed=NEW)) == EXIT_REFUSED
    folder_of_another.chmod(0o755)
    assert case.content(path) == before
    assert leftovers(folder_of_another) == []


@one_of_each_kind
def test_write_protected_target__is_an_error(case: Case, folder_of_another: Path) -> None:
    path = folder_of_another / case.name
    case.write(path)
    before = case.content(path)
    path.chmod(0o444)
    folder_of_another.chmod(0o777)

    def work() -> None:
        with pytest.raises(WriteError, match="write-protected"):
            case.write(path, seed=NEW)

    assert as_nobody(work) == 0
    assert case.content(path) == before


@one_of_each_kind
def test_link__stays_a_link_to_the_new_file(case: Case, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "links").mkdir()
    real, link = tmp_path / "real" / case.name, tmp_path / "links" / case.name
    case.write(real)
    if case.in_parts:
        pytest.skip("links are followed to one file")
    link.symlink_to(real)

    case.write(link, seed=NEW)

    assert link.is_symlink()
    case.write(tmp_path / case.name, seed=NEW)
    assert case.content(real) == case.content(tmp_path / case.name)


@one_of_each_kind
def test_two_writers__of_one_target_both_end_well(case: Case, tmp_path: Path) -> None:
    allowed = set()
    for seed in (1, 2):
        case.write(tmp_path / case.name, 500, seed)
        allowed.add(case.content(tmp_path / case.name))
    for entry in tmp_path.iterdir():
        entry.unlink()

    def many(seed: int) -> None:
        for _ in range(8):
            case.write(tmp_path / case.name, 500, seed)

    def both() -> None:
        first = os.fork()
        if first == 0:
            os._exit(in_child(lambda: many(1)) & 0xFF)
        many(2)
        if os.waitstatus_to_exitcode(os.waitpid(first, 0)[1]):
            raise RuntimeError("the first writer failed")

    assert in_child(both) == 0
    assert case.content(tmp_path / case.name) in allowed
    assert leftovers(tmp_path) == []


def test_two_writers__of_one_folder_count_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = next(case for case in cases() if case.id == "sog-folder")
    named, folder_size = _folder._files_of, saving.folder_size

    def named_then_replaced(path: Path, layout: FolderLayout) -> set[Path]:
        found = named(path, layout)
        monkeypatch.undo()
        case.write(path, seed=NEW)
        return found

    def while_another_writes(path: Path, layout: FolderLayout) -> int:
        monkeypatch.setattr(_folder, "_files_of", named_then_replaced)
        return folder_size(path, layout)

    monkeypatch.setattr(saving, "folder_size", while_another_writes)

    case.write(tmp_path / case.name)


def test_two_writers__without_leave_to_overwrite_make_one_target(tmp_path: Path) -> None:
    case = next(case for case in cases() if case.id == "ply")
    for attempt_id in range(6):
        path = tmp_path / f"{attempt_id}.ply"

        def one(seed: int, path: Path = path) -> Callable[[], None]:
            return lambda: case.write(path, 3000, seed, overwrite=False)

        def both(one: Callable[[int], Callable[[], None]] = one) -> None:
            first = os.fork()
            if first == 0:
                os._exit(in_child(one(1)))
            second = in_child(one(2))
            statuses = sorted([second, os.waitstatus_to_exitcode(os.waitpid(first, 0)[1])])
            os._exit(0 if statuses == [0, EXIT_REFUSED] else 1)

        assert in_child(both) == 0
        assert path.exists()
        assert leftovers(tmp_path) == []


def test_temporary_data__that_cannot_be_kept_names_its_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Full(io.BytesIO):
        def write(self, _data: object) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    case = next(case for case in cases() if case.id == "spark")
    monkeypatch.setattr(_files.tempfile, "SpooledTemporaryFile", lambda **_: Full())

    with pytest.raises(WriteError, match="TMPDIR") as caught:
        case.write(tmp_path / case.name)

    assert caught.value.path == Path(tempfile.gettempdir())
    assert list(tmp_path.iterdir()) == []


def test_interrupted_writer__cleans_up(tmp_path: Path) -> None:
    program = (
        "import sys; from gsplat_tools.cli.convert import main; import gsplat_tools.formats._atomic as a, os, signal\n"
        "def stop(stream, path): os.kill(os.getpid(), signal.SIGTERM)\n"
        "a.read_back = stop\n"
        "main()"
    )
    case = next(case for case in cases() if case.id == "ply")
    case.write(tmp_path / "a.ply")

    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.ply"), str(tmp_path / "b.splat"), "--no-validate"],
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 128 + signal.SIGTERM
    assert "the target is as it was" in done.stderr
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


def test_mode__of_a_new_target_is_that_of_any_new_file(tmp_path: Path) -> None:
    case = next(case for case in cases() if case.id == "ply")

    def work() -> None:
        os.umask(0o027)
        case.write(tmp_path / "a.ply")

    assert in_child(work) == 0
    assert stat.S_IMODE((tmp_path / "a.ply").stat().st_mode) == 0o640
