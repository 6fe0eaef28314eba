"""The same bytes from tasks as from one machine, and what is left when something goes wrong."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cluster import tasks
from gsplat_tools.cluster.engines import InProcess, Processes, open_engine
from gsplat_tools.cluster.parts import read_part
from gsplat_tools.cluster.sequences import convert_sequence
from gsplat_tools.errors import CapabilityError, CloudError, TargetExistsError, WriteError
from gsplat_tools.formats.saving import save
from tests.clouds import random_cloud
from tests.cluster.sequences import killing, local_bundle, make_frames, parts_of, pids, sha256
from tests.formats.test_sog4d_sequences import moving

pytestmark = pytest.mark.cluster

SHORT = {"delta_segment_length": 3, "sh_palette_size": 40, "scale_codebook_size": 60, "webp_effort": 0}


@pytest.mark.parametrize(
    "options",
    [
        SHORT,
        {**SHORT, "labels": "full", "version": 2, "zip": "deflated"},
        {**SHORT, "prune_opacity": 0.5, "sh_degree": 1, "frame_times": [0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0]},
        {**SHORT, "rotation": "reference", "zip": "stored", "visual_tolerance": 0.05, "order": "none"},
    ],
)
def test_tasks__give_the_bytes_of_one_machine(tmp_path: Path, options: dict[str, Any]) -> None:
    pattern = make_frames(tmp_path / "frames", 7, 120, sh_degree=2)
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **options)

    report = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), validation=None, **options)

    assert sha256((tmp_path / "out.sog4d").read_bytes()) == expected == report.cluster["sha256"]
    assert not list(tmp_path.glob(".*"))


def test_seconds__add_up_to_what_a_run_took(tmp_path: Path) -> None:
    pattern = make_frames(tmp_path / "frames", 4, 60)
    start = time.perf_counter()

    report = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), **SHORT)

    assert all(spent >= 0 for spent in report.seconds.values()), report.seconds
    assert 0.2 < sum(report.seconds.values()) / (time.perf_counter() - start) <= 1


def test_stages__tell_the_bytes_that_they_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = make_frames(tmp_path / "frames", 7, 60)
    monkeypatch.setattr("gsplat_tools.cluster.sequences.remove_parts", lambda folder: None)
    first = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), **SHORT)  # type: ignore[arg-type]
    source = sum(path.stat().st_size for path in (tmp_path / "frames").iterdir())
    parts = parts_of(tmp_path / "out.sog4d")
    parts[1].unlink()
    again = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), overwrite=True, **SHORT)  # type: ignore[arg-type]

    one, two = first.cluster["stages"], again.cluster["stages"]
    assert one["look"]["bytes_read"] == one["fit"]["bytes_read"] == source
    assert one["encode"]["bytes_read"] == 2 * source
    assert two["encode"]["bytes_read"] == pytest.approx(2 * source * 3 / 7)  # the second segment alone
    assert 0 < two["encode"]["bytes_written"] < one["encode"]["bytes_written"]
    assert one["assemble"]["bytes"] == first.bytes


def test_frames_with_invalid_splats__are_dropped_alike(tmp_path: Path) -> None:
    for index, cloud in enumerate(moving(100, 5, sh_degree=1)):
        means = cloud.means.copy()
        means[3 * index : 4 * index] = np.nan
        save_raw(cloud.replace(means=means), tmp_path / "frames" / f"{index}.ply")
    pattern = str(tmp_path / "frames/*.ply")
    expected, dropped = local(pattern, tmp_path)

    report = convert_sequence([pattern], tmp_path / "b.sog4d", InProcess(), validation=None, **SHORT)

    assert sha256((tmp_path / "b.sog4d").read_bytes()) == expected
    assert report.dropped == dropped == {"means-nan": 0 + 1 + 2 + 3 + 4}
    assert [warning["code"] for warning in report.warnings] == ["non-finite"]
    with pytest.raises(CloudError, match="invalid splats") as caught:
        convert_sequence([pattern], tmp_path / "c.sog4d", InProcess(), strict=True, **SHORT)
    assert caught.value.frame == 1
    assert not (tmp_path / "c.sog4d").exists()


def test_checks__are_those_of_one_machine(tmp_path: Path) -> None:
    from gsplat_tools.convert import convert

    pattern = make_frames(tmp_path / "frames", 7, 100)
    expected = convert([pattern], tmp_path / "local.sog4d", **SHORT).validation
    found = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), **SHORT).validation

    assert expected is not None
    assert found is not None
    for name in ("psnr_min", "psnr_mean", "ssim_mean", "max_abs", "worst_view", "model"):
        assert found[name] == expected[name], name
    for name, errors in expected["attributes"].items():
        for kind, value in errors.items():
            assert found["attributes"][name][kind] == (None if value is None else pytest.approx(value, rel=1e-12)), (name, kind)


def test_a_killed_process__changes_no_byte(tmp_path: Path) -> None:
    pattern = make_frames(tmp_path / "frames", 24, 150)
    target = tmp_path / "out.sog4d"
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)
    engine = Processes(2)
    try:
        with killing(engine, lambda: bool(parts_of(target))) as killed:
            report = convert_sequence([pattern], target, engine, validation=None, **SHORT)
    finally:
        engine.close()

    assert len(killed) == 1
    assert sha256(target.read_bytes()) == expected
    assert report.cluster["retried"] >= 1


def test_a_dask_worker_that_dies__changes_no_byte(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    pattern = make_frames(tmp_path / "frames", 24, 150)
    target = tmp_path / "out.sog4d"
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)
    engine = open_engine("local-cluster:1")
    try:
        with killing(engine, lambda: bool(parts_of(target))) as killed:
            report = convert_sequence([pattern], target, engine, validation=None, **SHORT)
        assert len(killed) == 1
        assert report.cluster["retried"] >= 1
        assert report.cluster["kept_segments"] == 0
        assert pids(engine) != killed
    finally:
        engine.close()

    assert sha256(target.read_bytes()) == expected


def test_a_run_that_ended_early__is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = make_frames(tmp_path / "frames", 12, 100)
    target = tmp_path / "out.sog4d"
    target.write_bytes(b"before")
    expected = local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)
    write_part, written = tasks.write_part, []

    def full_disk(part: Any, body: Any) -> None:
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        write_part(part, body)
        written.append(part.path)

    monkeypatch.setattr(tasks, "write_part", full_disk)
    with pytest.raises(WriteError, match="No space left"):
        convert_sequence([pattern], target, InProcess(retries=1), overwrite=True, validation=None, **SHORT)
    assert target.read_bytes() == b"before"
    assert [str(path) for path in parts_of(target)] == sorted(written)

    monkeypatch.undo()
    damaged = parts_of(target)[0]
    data = bytearray(damaged.read_bytes())
    data[100] ^= 1
    damaged.write_bytes(data)
    report = convert_sequence([pattern], target, InProcess(), overwrite=True, validation=None, **SHORT)

    assert report.cluster["kept_segments"] == 1
    assert sha256(target.read_bytes()) == expected
    assert not parts_of(target)


def test_a_part_whose_worker_died_after_it__is_one_of_this_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = make_frames(tmp_path / "frames", 7, 60)
    monkeypatch.setattr("gsplat_tools.cluster.engines._FIRST_PAUSE", 0)
    write_part, written = tasks.write_part, []

    def lost(part: Any, body: Any) -> None:
        write_part(part, body)
        written.append(part.path)
        if len(written) == 2:
            raise ConnectionError("lost")

    monkeypatch.setattr(tasks, "write_part", lost)
    report = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), validation=None, **SHORT)

    assert len(written) == report.cluster["segments"] == 3  # the second was found
    assert (report.cluster["kept_segments"], report.cluster["retried"]) == (0, 1)


def test_a_part_that_is_cut_off_anywhere__is_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = make_frames(tmp_path / "frames", 2, 20)
    kept: dict[str, bytes] = {}
    monkeypatch.setattr("gsplat_tools.cluster.sequences.remove_parts", lambda folder: kept.update(
        {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    ))  # fmt: skip
    convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), validation=None, **SHORT)
    ((_, data),) = kept.items()
    (path,) = parts_of(tmp_path / "out.sog4d")
    key = path.name.split("-")[1].split(".")[0]
    stored = read_part(str(path), "?", "")

    assert stored is None  # another key
    for size in [*range(0, len(data), max(1, len(data) // 40)), len(data) - 1]:
        path.write_bytes(data[:size])
        assert read_part(str(path), key, "") is None, size


def test_a_source_that_changed__is_encoded_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = make_frames(tmp_path / "frames", 6, 60)
    monkeypatch.setattr("gsplat_tools.cluster.sequences.remove_parts", lambda folder: None)
    convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), validation=None, **SHORT)
    save(random_cloud(60, sh_degree=1, seed=9), tmp_path / "frames/4.ply", overwrite=True)

    report = convert_sequence([pattern], tmp_path / "out.sog4d", InProcess(), overwrite=True, validation=None, **SHORT)

    assert report.cluster["kept_segments"] == 0
    assert sha256((tmp_path / "out.sog4d").read_bytes()) == local_bundle(pattern, tmp_path / "local.sog4d", **SHORT)


def test_what_cannot_be_done__is_refused_before_work(tmp_path: Path) -> None:
    pattern = make_frames(tmp_path / "frames", 3, 20)
    (tmp_path / "there.sog4d").write_bytes(b"")
    with pytest.raises(TargetExistsError):
        convert_sequence([pattern], tmp_path / "there.sog4d", InProcess())
    with pytest.raises(WriteError, match="make it first"):
        convert_sequence([pattern], tmp_path / "missing/out.sog4d", InProcess())
    assert not (tmp_path / "missing").exists()
    with pytest.raises(CapabilityError, match="a cluster makes"):
        convert_sequence([pattern], tmp_path / "out.spz", InProcess())
    with pytest.raises(CapabilityError, match="unknown scheduler"):
        open_engine("local:0")
    save(random_cloud(21, sh_degree=1), tmp_path / "frames/2.ply", overwrite=True)
    with pytest.raises(CloudError, match="splats of the first") as caught:
        convert_sequence([pattern], tmp_path / "out.sog4d", InProcess())
    assert caught.value.frame == 2


def save_raw(cloud: Any, path: Path) -> None:
    """Write a PLY with all splats, invalid ones too."""
    from gsplat_tools.formats.registry import FORMATS

    path.parent.mkdir(exist_ok=True)
    record = FORMATS["ply"]
    assert record.write is not None
    with path.open("w+b") as stream:
        record.write(cloud, stream, record.write_options())


def local(pattern: str, folder: Path) -> tuple[str, dict[str, int]]:
    """Convert on this machine; return the SHA-256 and what was dropped."""
    from gsplat_tools.convert import convert

    report = convert([pattern], folder / "local.sog4d", validation=None, **SHORT)
    return sha256((folder / "local.sog4d").read_bytes()), report.dropped
