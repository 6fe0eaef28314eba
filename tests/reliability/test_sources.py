"""Sources that come in small pieces, through pipes, or not at all."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import subprocess
import sys
import threading
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.convert import Validation, convert
from gsplat_tools.errors import CorruptDataError, GsplatWarning, LimitExceededError, ReadError, UnknownFormatError
from gsplat_tools.formats import _files, load, use_max_memory
from gsplat_tools.formats.loading import inspect_file, open_scene
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.sequence import GaussianSequence
from tests.reliability.cases import Case, cases
from tests.reliability.faults import leftovers

READABLE = [case for case in cases() if case.record.read is not None]
every_reader = pytest.mark.parametrize("case", READABLE, ids=lambda case: case.id)
SOG4D = FORMATS["sog4d"]
PROGRAM = "from gsplat_tools.cli.convert import main; main()"
PIPED = [case for case in READABLE if not case.in_parts]


@pytest.fixture(autouse=True)
def quiet() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        yield


def frames_of(path: Path) -> list[GaussianCloud]:
    """Read everything that a file holds."""
    scene = load(path)
    return [scene.frame(i) for i in range(len(scene))] if isinstance(scene, GaussianSequence) else [scene]


def assert_same(found: list[GaussianCloud], expected: list[GaussianCloud]) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        for name, values in other.arrays().items():
            assert np.array_equal(values, one.arrays()[name], equal_nan=True), name


def limited(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """Let every system call that reads return at most `size` bytes."""
    readinto, preadv = io.FileIO.readinto, os.preadv
    monkeypatch.setattr(_files, "_raw_readinto", lambda file, buffer: readinto(file, memoryview(buffer)[:size]))
    monkeypatch.setattr(os, "preadv", lambda file, buffers, offset: preadv(file, [buffers[0][:size]], offset))


@every_reader
@pytest.mark.parametrize("size", [1, 7, 4096])
def test_short_reads__give_the_same_scene(case: Case, size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / case.name
    case.write(path, 20)
    expected, facts = frames_of(path), inspect_file(path)[1]

    limited(monkeypatch, size)

    assert_same(frames_of(path), expected)
    assert inspect_file(path)[1] == facts
    if case.record.read_chunks is not None:
        with open_scene(path, in_chunks=True) as chunks:
            assert_same([chunks.read()], expected)  # type: ignore[union-attr]


@pytest.mark.parametrize("case", PIPED, ids=lambda case: case.id)
@pytest.mark.parametrize("size", [1, 7, 4096])
def test_pipe__gives_the_same_scene(case: Case, size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / case.name
    case.write(path, 20)
    expected = frames_of(path)
    data = path.read_bytes()
    path.unlink()
    os.mkfifo(path)

    def feed() -> None:
        with path.open("wb", buffering=0) as pipe:
            for start in range(0, len(data), size):
                pipe.write(data[start : start + size])

    feeder = threading.Thread(target=feed)
    feeder.start()
    found = frames_of(path)
    feeder.join()

    assert_same(found, expected)


def endless(path: Path, head: bytes) -> threading.Thread:
    """Write a head and then zeros into a FIFO until its reader goes away."""
    os.mkfifo(path)

    def feed() -> None:
        with contextlib.suppress(BrokenPipeError), path.open("wb", buffering=0) as pipe:
            pipe.write(head)
            while True:
                pipe.write(bytes(1 << 20))

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    return thread


def test_endless_pipe__of_no_format_is_refused_by_its_first_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsplat_tools.formats.loading.seekable", lambda *_: pytest.fail("it was copied"))
    feeder = endless(tmp_path / "scene", b"nothing known")

    with pytest.raises(UnknownFormatError, match="no format claims"):
        load(tmp_path / "scene")
    feeder.join(20)
    assert not feeder.is_alive()


def test_endless_pipe__with_a_signature_is_read_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = [tmp_path / "one.ply", tmp_path / "two.ply"]
    feeders = [endless(place, b"ply\nformat binary_little_endian 1.0\n") for place in places]

    with use_max_memory(20 << 20), pytest.raises(LimitExceededError, match=r"has not ended .* --max-memory"):
        load(places[0])
    monkeypatch.setattr(_files.shutil, "disk_usage", lambda _: SimpleNamespace(free=40 << 20))
    with pytest.raises(LimitExceededError, match=r"half of what is free .* save it to a file"):
        load(places[1])
    for feeder in feeders:
        feeder.join(20)
        assert not feeder.is_alive()


@pytest.mark.parametrize("case", [c for c in PIPED if c.id in {"spz", "sog4d-sequence"}], ids=lambda case: case.id)
def test_standard_input__converts_like_the_file(case: Case, tmp_path: Path) -> None:
    path = tmp_path / case.name
    case.write(path, 50)
    target = ".sog4d" if case.record.holds_sequences else ".ply"
    convert([path], tmp_path / f"a{target}", validation=None)

    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, "/dev/stdin", str(tmp_path / f"b{target}"), "--no-validate"],
        input=path.read_bytes(),
        capture_output=True,
        check=False,
        timeout=300,
    )

    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"a{target}").read_bytes() == (tmp_path / f"b{target}").read_bytes()


@pytest.mark.parametrize("validation", [None, Validation(views=1, size=(32, 18))], ids=["unchecked", "validated"])
def test_source__that_breaks_in_a_later_frame_is_named(
    validation: Validation | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, target = tmp_path / "source.sog4d", tmp_path / "target.sog4d"
    next(case for case in cases() if case.id == "sog4d-sequence").write(path)
    target.write_bytes(b"old")
    read_frame, left = GaussianSequence.frame, 0

    def failing_frame(sequence: GaussianSequence, frame_id: int) -> GaussianCloud:
        nonlocal left
        cloud = read_frame(sequence, frame_id)
        if getattr(sequence, "is_innermost", False):
            left -= 1
            if left < 0:
                raise CorruptDataError("an image does not decode", frame=frame_id)
        return cloud

    def marked(stream: Any, options: Any) -> GaussianSequence:
        scene = SOG4D.read(stream, options)
        scene.is_innermost = stream.name == str(path)
        return scene

    monkeypatch.setattr(GaussianSequence, "frame", failing_frame)
    monkeypatch.setitem(FORMATS, "sog4d", replace(SOG4D, read=marked))
    failures: list[Any] = []
    for frames in range(60):
        left = frames
        try:
            convert([path], target, overwrite=True, validation=validation)
        except CorruptDataError as error:
            failures.append(error.path)
            assert target.read_bytes() == b"old"
        else:
            break
    assert 3 <= len(failures) < 60
    assert set(failures) == {path}


@every_reader
def test_failing_disk__at_every_read_names_the_source(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, target = tmp_path / case.name, tmp_path / "target" / "scene.sog4d"
    case.write(path, 20)
    target.parent.mkdir()
    target.write_bytes(b"old")
    readinto, preadv = io.FileIO.readinto, os.preadv
    left = 0

    def count_down() -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def failing_readinto(file: io.FileIO, buffer: Any) -> Any:
        if Path(str(file.name)).parent == tmp_path:
            count_down()
        return readinto(file, buffer)

    def failing_preadv(file: int, buffers: Any, offset: int) -> int:
        count_down()
        return preadv(file, buffers, offset)

    monkeypatch.setattr(_files, "_raw_readinto", failing_readinto)
    monkeypatch.setattr(os, "preadv", failing_preadv)
    failures: list[ReadError] = []
    for reads in range(60):
        left = reads
        try:
            convert([path], target, overwrite=True, validation=None)
        except ReadError as error:
            failures.append(error)
        else:
            break
        assert (target.read_bytes(), leftovers(target.parent)) == (b"old", [])
    assert 0 < len(failures) < 60
    assert {error.path for error in failures} == {path}
    assert all("Input/output error" in str(error) for error in failures)
    assert target.read_bytes() != b"old"


def test_device__is_no_source() -> None:
    with pytest.raises(UnknownFormatError, match="no file and no pipe"):
        load("/dev/zero")
