"""Files that know what was written to them."""

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.errors import ReadError, WriteError
from gsplat_tools.formats import _files
from gsplat_tools.formats._files import RecordedFile, SourceFile, Spool, checksum, open_source_file


def made(path: Path) -> RecordedFile:
    return RecordedFile(path, 0o600, path)


@pytest.mark.parametrize("buffered", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_recorded_file__agrees_with_whatever_was_written_where(
    seed: int, buffered: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_files, "BLOCK_BYTES", 100)
    rng = np.random.default_rng(seed)
    expected = bytearray()
    raw = made(tmp_path / "a.bin")
    with io.BufferedRandom(raw, 64) if buffered else raw as stream:
        for _ in range(60):
            offset = len(expected) if rng.random() < 0.5 else int(rng.integers(0, len(expected) + 40))
            data = rng.bytes(int(rng.integers(0, 250)))
            if data:
                expected.extend(bytes(max(0, offset + len(data) - len(expected))))
                expected[offset : offset + len(data)] = data
            stream.seek(offset)
            stream.write(data)
        stream.flush()

        assert (tmp_path / "a.bin").read_bytes() == expected
        assert raw.first_difference() is None


@pytest.mark.parametrize("position", [0, 3, 99, 100, 101, 150, 249])
def test_recorded_file__finds_every_changed_byte(position: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_files, "BLOCK_BYTES", 100)
    path = tmp_path / "a.bin"
    with made(path) as file:
        file.write(bytes(range(250)))
        file.seek(95)
        file.write(b"header12")  # over the border of two blocks

        change(path, position, lambda byte: byte ^ 4)
        assert file.first_difference() == position // 100 * 100
        change(path, position, lambda byte: byte ^ 4)
        assert file.first_difference() is None


def change(path: Path, position: int, function: Callable[[int], int]) -> None:
    data = bytearray(path.read_bytes())
    data[position] = function(data[position])
    with path.open("r+b") as file:
        file.write(data)


@pytest.mark.parametrize("size", [0, 5, 249, 251, 1000])
def test_recorded_file__finds_another_length(size: int, tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with made(path) as file:
        file.write(bytes(range(250)))
        os.truncate(path, size)

        assert file.first_difference() == min(size, 250)


def test_recorded_file__finds_the_old_bytes_where_a_change_was_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with made(path) as file:
        file.write(b"0000rest")
        file.seek(0)
        file.write(b"1234")
        with path.open("r+b") as other:
            other.write(b"0000")

        assert file.first_difference() == 0


def test_recorded_file__remembers_only_what_a_short_write_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_files, "_raw_write", lambda file, data: io.FileIO.write(file, data[:7]))
    raw = made(tmp_path / "a.bin")
    with io.BufferedRandom(raw, 64) as stream:
        stream.write(bytes(range(200)))
        stream.flush()

        assert (tmp_path / "a.bin").read_bytes() == bytes(range(200))
        assert raw.first_difference() is None


@pytest.mark.parametrize("in_memory", [10, 1 << 20])
def test_spool__gives_back_what_went_in(in_memory: int) -> None:
    with Spool(in_memory) as spool:
        spool.write(b"abc" * 100)
        spool.write(np.arange(100, dtype=np.float32).data)

        assert spool.length == 700
        assert b"".join(spool.parts(33)) == b"abc" * 100 + np.arange(100, dtype=np.float32).tobytes()


@pytest.mark.parametrize("damage", [lambda file: file.truncate(299), lambda file: (file.seek(7), file.write(b"x"))])
def test_spool__refuses_bytes_that_changed(damage: Callable[[Any], object]) -> None:
    with Spool(10) as spool:
        spool.write(b"abc" * 100)
        damage(spool._file)

        with pytest.raises(WriteError, match="does not hold what was written"):
            list(spool.parts())


def test_source_file__names_itself_when_reading_fails() -> None:
    if not Path("/proc/self/mem").exists():
        pytest.skip("needs a file whose first page cannot be read")

    for read in (lambda f: f.read(), lambda f: f.read(10), lambda f: f.raw.readall()):
        with open_source_file(Path("/proc/self/mem")) as file:
            with pytest.raises(ReadError, match="Input/output error; the disk") as caught:
                read(file)
            assert caught.value.path == Path("/proc/self/mem")


def test_source_file__reads_everything(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(3_000_000))

    with SourceFile(tmp_path / "a.bin") as file:
        assert file.readall() == bytes(3_000_000)


@pytest.mark.parametrize("size", [0, 1, 7, 8, 8167, 8168, 8169, 100_003, _files.BLOCK_BYTES])
def test_checksum__sees_every_flipped_bit(size: int) -> None:
    data = bytearray(np.random.default_rng(size).bytes(size))
    right = checksum(data)
    assert right == checksum(bytes(data))

    for bit in {*range(0, 8 * size, max(1, size // 50)), *range(max(0, 8 * size - 70), 8 * size)}:
        data[bit // 8] ^= 1 << bit % 8
        assert checksum(data) != right
        data[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize("unit", [1, 4, 8, 512, 4096, 65536])
def test_checksum__sees_what_disks_do(unit: int) -> None:
    rng = np.random.default_rng(unit)
    original = rng.normal(size=_files.BLOCK_BYTES // 8).view(np.uint8)
    right = checksum(original.data)
    units = len(original) // unit
    for _ in range(100):
        i, j = rng.choice(units, 2, replace=False) * unit
        lost, swapped, shifted = original.copy(), original.copy(), original.copy()
        lost[i : i + unit] = 0
        swapped[i : i + unit], swapped[j : j + unit] = original[j : j + unit], original[i : i + unit]
        low = min(i, len(original) - 2 * unit)
        shifted[low + unit :] = original[low:-unit]
        for damaged in (lost, swapped, shifted):
            assert (checksum(damaged.data) == right) == np.array_equal(damaged, original)


@pytest.mark.parametrize("bit", range(64))
def test_checksum__sees_a_line_that_is_stuck(bit: int) -> None:
    stuck = np.full(_files.BLOCK_BYTES // 8, 1 << bit, np.uint64)

    assert checksum(stuck.tobytes()) != checksum(bytes(_files.BLOCK_BYTES))
