"""What every registered format promises, whatever it is."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import AttributeTally
from gsplat_tools.errors import CapabilityError, GsplatError, GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.loading import open_scene
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud

FULL = [record for record in FORMATS.values() if record.read is not None and record.write is not None]
every_format = pytest.mark.parametrize("record", FULL, ids=lambda record: record.id)


def write(cloud: GaussianCloud, record: Format, path: Path) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        save(cloud, path, to=record.id, overwrite=True, order="none")
    return path.read_bytes()


def read(path: Path, record: Format) -> GaussianCloud:
    """Read a file as a given format, to the last value."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        with open_scene(path, in_chunks=False, as_format=record.id) as scene:
            if isinstance(scene, GaussianSequence):
                return scene.frame(0)
            assert isinstance(scene, GaussianCloud)
            return scene


def is_headerless(record: Format, whole: bytes) -> bool:
    """Whether files are arrays of records, which nothing but their length says anything about."""
    return len(whole) % 5 == 0 and not record.matches(whole)


def prepared(cloud: GaussianCloud, record: Format) -> GaussianCloud:
    """What a writer is given: the axes of a format that is always in one system."""
    from gsplat_tools.formats.preparing import SaveChoices, prepare

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        scene = prepare(cloud, record, SaveChoices(order="none")).scene
    return scene if isinstance(scene, GaussianCloud) else scene.read()  # type: ignore[union-attr]


@every_format
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3, 4])
def test_round_trip__stays_within_the_bounds_that_the_format_states(record: Format, sh_degree: int, tmp_path: Path) -> None:
    cloud = random_cloud(200, sh_degree=sh_degree)
    path = tmp_path / f"scene{record.extensions[0]}"

    write(cloud, record, path)
    decoded = read(path, record)

    source = prepared(cloud, record)
    assert len(decoded) == len(source)
    assert decoded.sh_degree == min(sh_degree, record.max_sh_degree)
    tally = AttributeTally()
    assert record.bounds is not None
    with path.open("rb") as stream:
        tally.add(source, decoded, record.bounds(source, stream, 0))
    assert tally.exceeded() == []
    assert {"means", "opacities"} <= {name for name, entry in tally.attributes.items() if entry.bound is not None}


@every_format
def test_chunks__hold_what_a_whole_read_gives(record: Format, tmp_path: Path) -> None:
    if record.read_chunks is None:
        pytest.skip(f"{record.id} is read whole")
    path = tmp_path / f"scene{record.extensions[0]}"
    write(random_cloud(300, sh_degree=2), record, path)

    with open_scene(path, in_chunks=True, as_format=record.id) as chunks:
        pieces = chunks.read()  # type: ignore[union-attr]

    whole = read(path, record)
    for name, values in whole.arrays().items():
        assert np.array_equal(values, getattr(pieces, name), equal_nan=True), name


@every_format
def test_bytes__do_not_depend_on_the_number_of_threads(record: Format, tmp_path: Path) -> None:
    from gsplat_tools.parallel import use_jobs

    cloud = random_cloud(3000, sh_degree=1)
    written = []
    for jobs in (1, 2, 4):
        with use_jobs(jobs):
            written.append(write(cloud, record, tmp_path / f"scene{record.extensions[0]}"))

    assert written[0] == written[1] == written[2]


@every_format
def test_prefix__is_refused_at_every_length(record: Format, tmp_path: Path) -> None:
    path = tmp_path / f"scene{record.extensions[0]}"
    whole = write(random_cloud(5, sh_degree=1), record, path)
    assert len(whole) < 20_000

    for length in range(len(whole)):
        if is_headerless(record, whole) and length and length % (len(whole) // 5) == 0:
            continue  # a shorter array of records is a file of its own
        path.write_bytes(whole[:length])
        with pytest.raises(GsplatError) as caught:
            read(path, record)
        assert caught.value.path == path


@every_format
def test_longer_file__is_refused_or_read_the_same(record: Format, tmp_path: Path) -> None:
    path = tmp_path / f"scene{record.extensions[0]}"
    whole = write(random_cloud(5, sh_degree=1), record, path)
    expected = read(path, record)
    path.write_bytes(whole + b"\0\1\2")

    try:
        longer = read(path, record)
    except GsplatError:
        return
    for name, values in expected.arrays().items():
        assert np.array_equal(values, getattr(longer, name), equal_nan=True), name


@every_format
def test_changed_byte__is_refused_or_read_and_nothing_else(record: Format, tmp_path: Path) -> None:
    path = tmp_path / f"scene{record.extensions[0]}"
    whole = write(random_cloud(5, sh_degree=1), record, path)

    outcomes = set()
    for position in range(min(len(whole), 700)):
        for change in (0x01, 0x80, 0xFF):
            damaged = bytearray(whole)
            damaged[position] ^= change
            path.write_bytes(damaged)
            try:
                read(path, record)
                outcomes.add("read")
            except GsplatError:
                outcomes.add("refused")
    assert "refused" in outcomes or is_headerless(record, whole)


@every_format
@pytest.mark.parametrize("count", [0, 1])
def test_small_clouds__come_back(record: Format, count: int, tmp_path: Path) -> None:
    path = tmp_path / f"scene{record.extensions[0]}"
    cloud = random_cloud(count, sh_degree=3)
    if count < record.min_splats:
        with pytest.raises(CapabilityError, match="at least"):
            write(cloud, record, path)
        assert not path.exists()
        return

    write(cloud, record, path)

    assert len(read(path, record)) == count


@every_format
def test_writing__leaves_its_argument_as_it_was(record: Format, tmp_path: Path) -> None:
    cloud = random_cloud(64)
    before = {name: values.copy() for name, values in cloud.arrays().items()}

    write(cloud, record, tmp_path / f"scene{record.extensions[0]}")

    for name, values in before.items():
        assert np.array_equal(values, getattr(cloud, name)), name


@every_format
def test_second_trip__changes_nothing_more_than_the_first_allowed(record: Format, tmp_path: Path) -> None:
    path = tmp_path / f"scene{record.extensions[0]}"
    write(random_cloud(100, sh_degree=1), record, path)
    first = read(path, record)
    write(first, record, path)
    second = read(path, record)

    tally = AttributeTally()
    assert record.bounds is not None
    with path.open("rb") as stream:
        tally.add(prepared(first, record), second, record.bounds(prepared(first, record), stream, 0))
    assert tally.exceeded() == []


@every_format
def test_stream_that_cannot_seek__is_read_the_same(record: Format, tmp_path: Path) -> None:
    from gsplat_tools.formats._stream import seekable

    class Pipe(io.RawIOBase):
        """Gives at most seven bytes a read, and cannot seek."""

        def __init__(self, data: bytes) -> None:
            self._data = io.BytesIO(data)

        def readable(self) -> bool:
            return True

        def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
            return self._data.readinto(memoryview(buffer)[:7])

    path = tmp_path / f"scene{record.extensions[0]}"
    whole = write(random_cloud(20, sh_degree=1), record, path)

    copied = seekable(Pipe(whole))  # type: ignore[arg-type]
    try:
        assert record.read is not None
        scene = record.read(copied, record.read_options())
        cloud = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
        assert np.array_equal(cloud.means, read(path, record).means)
    finally:
        copied.close()


@every_format
def test_load__finds_the_format_by_content(record: Format, tmp_path: Path) -> None:
    if not record.matches(write(random_cloud(4), record, tmp_path / f"scene{record.extensions[0]}")[:64]):
        pytest.skip(f"{record.id} has no signature")
    disguised = tmp_path / "scene.unknown"
    disguised.write_bytes((tmp_path / f"scene{record.extensions[0]}").read_bytes())

    scene = load(disguised)

    assert (scene.num_splats if isinstance(scene, GaussianSequence) else len(scene)) == 4
