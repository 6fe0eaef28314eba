"""gsplat-convert when the disk does not do its part: one line, status 1, and the old target."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.reliability.cases import cases

PROGRAM = [sys.executable, "-c", "from gsplat_tools.cli.convert import main; main()"]


def convert(source: Path, target: Path, *options: str, limit: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command, where asked with a limit on the size of files."""

    def prepare() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.run(
        [*PROGRAM, str(source), str(target), *options], capture_output=True, text=True, check=False, preexec_fn=prepare
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("convert", ["--help"]),
        ("inspect", ["--version"]),
        ("inspect", ["info", "--help"]),
        ("inspect", ["info", "FILE", "--json"]),
        ("inspect", ["info", "FILE"]),
    ],
)
def test_full_stdout__is_one_line(command: str, arguments: list[str], source: Path) -> None:
    program = f"from gsplat_tools.cli.{command} import main; main()"
    arguments = [str(source) if each == "FILE" else each for each in arguments]

    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )

    assert done.stderr.splitlines() == ["error: standard output: cannot write: No space left on device"]
    assert done.returncode == 1


def test_summary__escapes_names_of_files(source: Path, tmp_path: Path) -> None:
    odd = source.rename(tmp_path / "a\n\x1b[31mb.ply")

    done = convert(odd, tmp_path / "c\x1b[0md.ply", "--no-validate")

    assert done.returncode == 0, done.stderr
    assert "\x1b" not in done.stderr
    assert done.stderr.splitlines()[0] == f"{tmp_path}/a \\x1b[31mb.ply -> {tmp_path}/c\\x1b[0md.ply (ply)"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    case = next(case for case in cases() if case.id == "ply")
    case.write(tmp_path / "scene.ply", 500)
    return tmp_path / "scene.ply"


def test_size_limit__is_one_line_with_path_and_remedy(source: Path, tmp_path: Path) -> None:
    name = "old.splat"
    (tmp_path / name).write_bytes(b"old")

    done = convert(source, tmp_path / name, "--overwrite", limit=3000)

    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        (
            f"error: {tmp_path / name}: cannot write: File too large; the file system or a limit (ulimit -f) allows no file of "
            "this size; write elsewhere"
        )
    ]
    assert (tmp_path / name).read_bytes() == b"old"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [name, "scene.ply"]


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs a file whose first page cannot be read")
def test_unreadable_source__is_named(tmp_path: Path) -> None:
    done = convert(Path("/proc/self/mem"), tmp_path / "new.ply")

    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "error: /proc/self/mem: cannot read: Input/output error; the disk, or the connection to it, is failing"
    ]
    assert list(tmp_path.iterdir()) == []


def test_device__is_no_target(source: Path) -> None:
    done = convert(source, Path("/dev/full"), "--to", "splat", "--overwrite")

    assert done.returncode == 1
    assert done.stderr.startswith("error: /dev/full: the target is not a regular file")
