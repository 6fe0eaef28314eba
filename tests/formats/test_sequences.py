"""Frames from files, folders and patterns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, FormatError
from gsplat_tools.formats import save
from gsplat_tools.formats.sequences import frame_files, natural_key, open_sequence
from tests.clouds import random_cloud


def shifted(frame: int, count: int = 6, sh_degree: int = 1) -> GaussianCloud:
    cloud = random_cloud(count, sh_degree=sh_degree)
    return cloud.replace(means=cloud.means + np.float32(frame))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Frames 1 to 11 with unpadded numbers, one with an upper-case extension, and a file that is no frame."""
    for frame in range(1, 12):
        save(shifted(frame), tmp_path / f"frame{frame}.ply", order="none")
    (tmp_path / "frame7.ply").rename(tmp_path / "frame7.PLY")
    (tmp_path / "notes.txt").write_text("not a frame")
    (tmp_path / ".hidden.ply").write_bytes(b"")
    return tmp_path


def test_folder__comes_in_natural_order(folder: Path) -> None:
    sequence = open_sequence(folder)

    assert len(sequence) == 11
    assert sequence.is_uniform
    for frame in range(11):
        assert np.array_equal(sequence.frame(frame).means, shifted(frame + 1).means), frame


def test_pattern__comes_in_natural_order(folder: Path) -> None:
    assert [path.name for path in frame_files(folder / "frame?.ply")] == [f"frame{i}.ply" for i in (1, 2, 3, 4, 5, 6, 8, 9)]
    assert [path.name for path in frame_files(str(folder / "frame1*.[pP]*"))] == ["frame1.ply", "frame10.ply", "frame11.ply"]


def test_files__keep_the_order_given(folder: Path) -> None:
    sequence = gsplat_tools.open_sequence([folder / "frame3.ply", folder / "frame1.ply"], frame_times=[0.25, 0.5])

    assert sequence.frame_times.tolist() == [0.25, 0.5]
    assert np.array_equal(sequence.frame(0).means, shifted(3).means)


def test_bundle__is_its_own_sequence(folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "all.sog4d"
    save(open_sequence(folder), target, order="none")

    assert open_sequence(target).is_uniform
    retimed = open_sequence([target], frame_times=np.linspace(0.5, 1, 11).tolist())
    assert (len(retimed), retimed.frame_times[0]) == (11, 0.5)
    with pytest.raises(CapabilityError, match="one time a frame, 11"):
        open_sequence(target, frame_times=[0.0])


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (shifted(3, count=5), "the splats of the first, 6 in frame1.ply; this one has 5"),
        (shifted(3, sh_degree=0), "the sh_degree of the first, 1"),
        (shifted(3).replace(extra={"label": np.zeros(6, np.float32)}), "adds label"),
    ],
)
def test_first_frame_that_differs__is_named(folder: Path, other: GaussianCloud, words: str) -> None:
    save(other, folder / "frame4.ply", order="none", overwrite=True)
    save(other, folder / "frame9.ply", order="none", overwrite=True)

    with pytest.raises(CloudError, match=words) as caught:
        open_sequence(folder)
    assert caught.value.path == folder / "frame4.ply"
    assert caught.value.frame == 3


def test_frame_that_changes_later__is_refused_when_read(folder: Path) -> None:
    sequence = open_sequence(folder)
    save(shifted(2, count=4), folder / "frame2.ply", order="none", overwrite=True)

    with pytest.raises(CloudError, match="this one has 4") as caught:
        sequence.frame(1)
    assert caught.value.path == folder / "frame2.ply"


def test_nothing_to_open__says_so(tmp_path: Path, folder: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for paths, words in ((empty, "no file of a known format"), (tmp_path / "none*.ply", "matches"), ([], "at least one frame")):
        with pytest.raises(CapabilityError, match=words):
            open_sequence(paths)
    save(shifted(1), folder / "extra.gspk", to="uncompressed", order="none")
    with pytest.raises(CapabilityError, match="mixes formats"):
        open_sequence(folder)


def test_broken_frame__names_its_file(folder: Path) -> None:
    (folder / "frame5.ply").write_bytes(b"ply\nformat")

    with pytest.raises(FormatError) as caught:
        open_sequence(folder)
    assert caught.value.path == folder / "frame5.ply"


def test_natural_key__compares_numbers() -> None:
    names = ["b2", "a10", "A9", "a09", "a1b10", "a1b9"]

    assert sorted(names, key=lambda name: natural_key(Path(name))) == ["a1b9", "a1b10", "A9", "a09", "a10", "b2"]
