"""A still scene in blocks: the bytes of one machine, whatever the blocks and whoever encodes them."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from gsplat_tools.chunks import CHUNK_SIZE
from gsplat_tools.cli.convert import main
from gsplat_tools.cluster import block_tasks, blocks
from gsplat_tools.cluster.arranging import _Draw, row_type
from gsplat_tools.cluster.blocks import WholeSceneError, convert_blocks
from gsplat_tools.cluster.engines import InProcess, open_engine
from gsplat_tools.convert import ConversionReport, convert
from gsplat_tools.errors import CapabilityError, CloudError, ClusterError, ReadError, ValidationError, WriteError
from gsplat_tools.formats.saving import save
from gsplat_tools.parallel import BLOCK_SIZE
from gsplat_tools.verification import Validation
from tests.clouds import random_cloud
from tests.cluster.sequences import killing, parts_of, pids, sha256
from tests.cluster.test_sequences import save_raw

pytestmark = pytest.mark.cluster

SPLATS = 2 * BLOCK_SIZE + 1000
"""Three blocks of the smallest size."""

QUICK = {"sh_palette_size": 40, "scale_codebook_size": 60, "webp_effort": 0}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes of degree 0 to 3, one with invalid splats, and one that is read in three chunks of unlike length."""
    folder = tmp_path_factory.mktemp("scenes")
    for degree in range(4):
        save(random_cloud(SPLATS, sh_degree=degree, seed=degree), folder / f"{degree}.ply")
    for name, count, degree in (("invalid", SPLATS, 1), ("chunks", 2 * CHUNK_SIZE + 5000, 0)):
        cloud = random_cloud(count, sh_degree=degree, seed=9)
        means, quats = cloud.means.copy(), cloud.quats.copy()
        means[::97] = np.nan
        quats[50::101] = 0
        save_raw(cloud.replace(means=means, quats=quats), folder / f"{name}.ply")
    return folder


def local(source: Path, target: Path, **options: Any) -> tuple[str, ConversionReport]:
    """Convert in memory; return the SHA-256 and the report."""
    report = convert([source], target, validation=None, **options)
    return sha256(target.read_bytes()), report


def in_blocks(source: Path, target: Path, **options: Any) -> Any:
    """Convert in blocks of the smallest size, in this process, without checks."""
    return convert_blocks(source, target, InProcess(), **{"validation": None, "block_splats": 1, **options})


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("0", {}),
        ("1", {"version": 2}),
        ("3", {}),
        ("3", {"version": 2, "sh_degree": 2, "sh_palette_size": 1100, "centroids": "f32", "webp_effort": 1}),
        ("2", {"sh_palette_size": 3000, "preset": "fast"}),
        ("1", {"prune_opacity": 0.3, "source_coordinates": "RDF", "target_coordinates": "LUF", "recenter": "on"}),
        ("2", {"order": "hilbert2d", "rotation": "reference", "zip": "deflated"}),
        ("1", {"order": "none", "labels": "delta-v1", "rotation": "best", "sh0_codebook": "base-rgb", "zip": "stored"}),
        ("2", {"sh_degree": 0, "time_mapping": "explicit", "width": 200, "seed": 7}),
        ("invalid", {"prune_opacity": 0.5}),
        ("chunks", {"prune_opacity": 0.1, "prune_faint": 0.5}),
        ("chunks", {"preset": "best", "webp_effort": 0}),
    ],
)
def test_blocks__give_the_bytes_of_one_machine(scenes: Path, tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    options = {**QUICK, **options}
    expected, here = local(scenes / f"{name}.ply", tmp_path / "local.sog4d", **options)

    report = in_blocks(scenes / f"{name}.ply", tmp_path / "out.sog4d", **options)

    assert sha256((tmp_path / "out.sog4d").read_bytes()) == expected == report.cluster["sha256"]
    ours, theirs = (each.to_json() for each in (report, here))
    for fact in ("source", "source_format", "splats", "sh_degree", "frames", "dropped", "warnings", "options", "decisions"):
        assert ours[fact] == theirs[fact], fact
    assert ours["target"]["bytes"] == theirs["target"]["bytes"]
    assert ours["cluster"]["blocks"] == -(-report.splats // BLOCK_SIZE) > 1
    assert all(spent >= 0 for spent in report.seconds.values())
    assert not list(tmp_path.glob(".*"))


def test_invalid_splats__are_refused_where_that_was_asked_for(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(CloudError, match="would be dropped"):
        in_blocks(scenes / "invalid.ply", tmp_path / "out.sog4d", strict=True)
    with pytest.raises(CapabilityError, match="none is left to write"):
        in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", prune_opacity=1.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extension", ["gspk", "spz", "splat", "compressed.ply"])
def test_other_sources__give_the_bytes_of_one_machine(scenes: Path, tmp_path: Path, extension: str) -> None:
    source = tmp_path / f"scene.{extension}"
    convert([scenes / "1.ply"], source, to="spark" if extension == "gspk" else None, validation=None)
    expected, _ = local(source, tmp_path / "local.sog4d", **QUICK)

    in_blocks(source, tmp_path / "out.sog4d", **QUICK)

    assert sha256((tmp_path / "out.sog4d").read_bytes()) == expected


@pytest.mark.parametrize("block_splats", [BLOCK_SIZE, BLOCK_SIZE + 1, 10**7])
def test_the_size_of_blocks__changes_no_byte(scenes: Path, tmp_path: Path, block_splats: int) -> None:
    expected, _ = local(scenes / "1.ply", tmp_path / "local.sog4d", **QUICK)

    report = in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", block_splats=block_splats, **QUICK)

    assert report.cluster["blocks"] == {BLOCK_SIZE: 3, BLOCK_SIZE + 1: 2}.get(block_splats, 1)
    assert report.cluster["sha256"] == expected


@pytest.mark.parametrize("scheduler", ["local:2", "local-cluster:2"])
def test_other_engines__change_no_byte(scenes: Path, tmp_path: Path, scheduler: str) -> None:
    if scheduler.startswith("local-cluster"):
        pytest.importorskip("distributed")
    expected, _ = local(scenes / "2.ply", tmp_path / "local.sog4d", **QUICK)
    engine = open_engine(scheduler)
    try:
        report = convert_blocks(scenes / "2.ply", tmp_path / "out.sog4d", engine, block_splats=1, **QUICK)  # type: ignore[arg-type]
    finally:
        engine.close()

    assert sha256((tmp_path / "out.sog4d").read_bytes()) == expected
    assert report.cluster["workers"] == 2


def test_checks__are_those_of_one_machine(scenes: Path, tmp_path: Path) -> None:
    expected = convert([scenes / "1.ply"], tmp_path / "local.sog4d", **QUICK).validation  # type: ignore[arg-type]
    found = in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", validation=Validation(), **QUICK).validation

    assert expected is not None
    attributes, others = expected.pop("attributes"), found.pop("attributes")
    assert found == expected
    assert expected["rendered_splats"] == SPLATS
    # The angle that a covariance is allowed is that of its piece, at most that of the whole.
    assert others["covariances"].pop("bound") <= attributes["covariances"].pop("bound") * (1 + 1e-12)
    for name, errors in attributes.items():
        for kind, value in errors.items():
            assert others[name][kind] == (None if value is None else pytest.approx(value, rel=1e-9)), (name, kind)


def test_stages__tell_the_bytes_that_they_moved(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: dict[str, int] = {}
    monkeypatch.setattr(blocks, "remove_parts", lambda folder: sizes.update(
        {path.name: path.stat().st_size for path in Path(folder).iterdir()}
    ))  # fmt: skip
    source, options = scenes / "1.ply", {**QUICK, "validation": Validation(), "prune_faint": 0.01}
    report = in_blocks(source, tmp_path / "out.sog4d", **options)
    stages, read = report.cluster["stages"], source.stat().st_size
    rows = next(size for name, size in sizes.items() if name.startswith("rows"))
    written = {
        "arrange": sum(size for name, size in sizes.items() if name.startswith(("rows", "scene"))),
        "encode": sum(size for name, size in sizes.items() if name[:6].isdecimal()),
        "compress": sum(size for name, size in sizes.items() if not name.startswith(("rows", "scene", "0"))),
    }

    assert stages["look"]["bytes_read"] == stages["arrange"]["bytes_read"] == 2 * read
    assert stages["encode"]["bytes_read"] == rows
    assert stages["compress"]["bytes_read"] == stages["encode"]["bytes_written"]
    assert stages["fit"]["bytes_read"] == stages["arrange"]["bytes_written"] - 2 * rows  # without those for pictures
    assert stages["draw"]["bytes_read"] == rows + stages["encode"]["bytes_written"]  # all splats are drawn
    assert stages["assemble"]["bytes"] == report.bytes
    for name, size in written.items():
        assert 0 < size - stages[name]["bytes_written"] < 30_000, name  # what parts say about themselves

    again = in_blocks(source, tmp_path / "out.sog4d", overwrite=True, **options).cluster["stages"]
    for name in written:
        assert "bytes_written" not in again[name], name


def test_pictures_of_large_scenes__show_every_so_manieth_splat(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsplat_tools.cluster.arranging.MAX_RENDERED", 5000)
    found = in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", validation=Validation(), **QUICK).validation
    assert found["rendered_splats"] == -(-SPLATS // 7)
    assert found["psnr_min"] > 20


def test_what_is_not_right__leaves_the_target_as_it_was(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "out.sog4d"
    target.write_bytes(b"before")
    options = {"overwrite": True, "validation": Validation(), **QUICK}
    with pytest.raises(ValidationError, match="below --min-psnr 200"):
        in_blocks(scenes / "1.ply", target, **{**options, "validation": Validation(min_psnr=200)})

    decode = block_tasks._webp.decode_rgba
    with monkeypatch.context() as patch:
        patch.setattr(block_tasks._webp, "decode_rgba", lambda *words, **named: decode(*words, **named) ^ 1)
        with pytest.raises(ValidationError, match="does not decompress to what was compressed"):
            in_blocks(scenes / "1.ply", target, **{**options, "seed": 2})

    encode = block_tasks.encode_frame

    def wrong(*words: Any, **named: Any) -> Any:
        planes = encode(*words, **named)
        planes.columns["position_hi"][-1] += 1
        return planes

    with monkeypatch.context() as patch:
        patch.setattr(block_tasks, "encode_frame", wrong)
        with pytest.raises(ValidationError, match="means: "):
            in_blocks(scenes / "1.ply", target, **{**options, "seed": 1})
    assert target.read_bytes() == b"before"


@pytest.mark.parametrize(
    ("scheduler", "during"), [("local:2", "arrange"), ("local:2", "encode"), ("local-cluster:1", "encode")]
)
def test_a_killed_worker__changes_no_byte(scenes: Path, tmp_path: Path, scheduler: str, during: str) -> None:
    if scheduler.startswith("local-cluster"):
        pytest.importorskip("distributed")
    target = tmp_path / "out.sog4d"
    folder = tmp_path / ".out.sog4d.gsplat-parts"
    expected, _ = local(scenes / "3.ply", tmp_path / "local.sog4d", **QUICK)
    engine = open_engine(scheduler)
    try:
        with killing(engine, lambda: bool(finished_blocks(target)) if during == "encode" else folder.exists()) as killed:
            convert_blocks(scenes / "3.ply", target, engine, block_splats=1, **QUICK)  # type: ignore[arg-type]
        assert pids(engine) != killed
    finally:
        engine.close()

    assert len(killed) == 1
    assert sha256(target.read_bytes()) == expected
    assert not folder.exists()


def finished_blocks(target: Path) -> list[Path]:
    """Return the blocks beside a target."""
    return [path for path in parts_of(target) if path.name[0] == "0"]


@pytest.fixture
def interrupted(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, str]:
    """A target whose run ended with its blocks and one image done, and the SHA-256 that it should have."""
    expected, _ = local(scenes / "1.ply", tmp_path / "local.sog4d", **QUICK)
    with monkeypatch.context() as patch:
        write_part, written = block_tasks.write_part, []

        def full_disk(part: Any, body: Any) -> None:
            if written:
                raise OSError(errno.ENOSPC, "No space left on device")
            write_part(part, body)
            written.append(part.path)

        patch.setattr(block_tasks, "write_part", full_disk)
        patch.setattr("gsplat_tools.cluster.engines._FIRST_PAUSE", 0)
        with pytest.raises(WriteError, match="No space left"):
            in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", **QUICK)
    assert len(parts_of(tmp_path / "out.sog4d")) == 1 + 1 + 3 + 1  # rows, what is known of them, blocks, an image
    return tmp_path / "out.sog4d", expected


def test_a_run_that_ended_early__is_continued(scenes: Path, interrupted: tuple[Path, str]) -> None:
    target, expected = interrupted
    rows = next(path for path in parts_of(target) if path.name.startswith("rows"))
    before = rows.stat().st_mtime_ns, rows.stat().st_ino
    after = []
    remove = blocks.remove_parts

    def watch(folder: str) -> None:
        after.append((rows.stat().st_mtime_ns, rows.stat().st_ino))
        remove(folder)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "remove_parts", watch)
        report = in_blocks(scenes / "1.ply", target, **QUICK)

    assert after == [before]
    assert report.cluster["kept_blocks"] == 3
    assert sha256(target.read_bytes()) == expected
    assert not parts_of(target)


def test_a_block_whose_worker_died_after_it__is_one_of_this_run(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsplat_tools.cluster.engines._FIRST_PAUSE", 0)
    sealed, written = block_tasks.sealed, []

    @contextmanager
    def lost(path: str, said: dict[str, Any]) -> Iterator[Any]:
        with sealed(path, said) as body:
            yield body
        written.append(path)
        if len(written) == 2:
            raise ConnectionError("lost")

    monkeypatch.setattr(block_tasks, "sealed", lost)
    report = in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", **QUICK)

    assert len(written) == report.cluster["blocks"] == 3  # the second was found
    assert (report.cluster["kept_blocks"], report.cluster["retried"]) == (0, 1)


@pytest.mark.parametrize("kind", ["rows", "scene", "0", "position_hi"])
@pytest.mark.parametrize("damage", ["changed", "cut", "gone"])
def test_a_damaged_part__is_made_again(scenes: Path, interrupted: tuple[Path, str], kind: str, damage: str) -> None:
    target, expected = interrupted
    path = next(path for path in parts_of(target) if path.name.startswith(kind))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data if damage == "changed" else data[:-20])
    if damage == "gone":
        path.unlink()

    report = in_blocks(scenes / "1.ply", target, **QUICK)

    assert report.cluster["kept_blocks"] == (2 if kind == "0" else 3)
    assert sha256(target.read_bytes()) == expected


def test_a_part_that_is_damaged_during_a_run__ends_it(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "out.sog4d"
    arrange, encode = blocks._Job.arrange, blocks._Job.encode

    def damage(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[100] ^= 1
        path.write_bytes(data)

    def damaged_rows(job: Any) -> Any:
        found = arrange(job)
        damage(Path(found[1].rows))
        return found

    def damaged_block(job: Any, arrangement: Any) -> Any:
        found = encode(job, arrangement)
        damage(Path(found[0][1].path))
        return found

    for name, function, said in (("arrange", damaged_rows, "rows of the scene"), ("encode", damaged_block, "finished block")):
        with monkeypatch.context() as patch:
            patch.setattr(blocks._Job, name, function)
            with pytest.raises(ClusterError, match=f"{said}.* changed; the same command"):
                in_blocks(scenes / "1.ply", target, **QUICK)
        assert not target.exists()
    in_blocks(scenes / "1.ply", target, **QUICK)
    assert sha256(target.read_bytes()) == local(scenes / "1.ply", tmp_path / "local.sog4d", **QUICK)[0]


def test_a_source_that_changes__is_noticed(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "scene.ply"
    save(random_cloud(1000, sh_degree=1), source)
    arrange = blocks.arrange

    def touched(*words: Any) -> Any:
        os.utime(source, (1, 1))
        return arrange(*words)

    def shorter(*words: Any) -> Any:
        save(random_cloud(900, sh_degree=1), source, overwrite=True)
        return arrange(*words)

    for change in (touched, shorter):
        monkeypatch.setattr(blocks, "arrange", change)
        with pytest.raises(ReadError, match="changed while it was read"):
            convert_blocks(source, tmp_path / "out.sog4d", InProcess(retries=0), validation=None)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"visual_tolerance": 0.1}, "visual tolerance"),
        ({"outliers": "drop"}, "outliers"),
        ({"frame_times": [0.5]}, "times"),
    ],
)
def test_what_needs_the_whole_scene__is_no_work_for_blocks(
    scenes: Path, tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(WholeSceneError, match=said):
        in_blocks(scenes / "1.ply", tmp_path / "out.sog4d", **options)


def test_sources_that_are_read_whole_and_other_targets__are_refused(scenes: Path, tmp_path: Path) -> None:
    convert([scenes / "0.ply"], tmp_path / "scene.sog", validation=None, webp_effort=0)
    with pytest.raises(WholeSceneError, match="is read whole"):
        in_blocks(tmp_path / "scene.sog", tmp_path / "out.sog4d")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(WholeSceneError, match="a pipe"):
        in_blocks(tmp_path / "pipe", tmp_path / "out.sog4d")
    with pytest.raises(CapabilityError, match=r"becomes a \.sog4d bundle"):
        in_blocks(scenes / "0.ply", tmp_path / "out.spz")
    with pytest.raises(WriteError, match="make it first"):
        in_blocks(scenes / "0.ply", tmp_path / "missing/out.sog4d")
    assert not (tmp_path / "missing").exists()
    with pytest.raises(CapabilityError, match="at least one splat"):
        in_blocks(scenes / "0.ply", tmp_path / "out.sog4d", block_splats=0)


def test_the_command__takes_blocks_where_it_can(scenes: Path, tmp_path: Path) -> None:
    def run(name: str, *words: str) -> tuple[int, Any]:
        options = ["--webp-effort", "0", "--sh-palette-size", "40", "--views", "0", "--json", *words]
        result = CliRunner().invoke(main, [str(scenes / "1.ply"), str(tmp_path / name), *options])
        return result.exit_code, json.loads(result.stdout) if result.exit_code == 0 else result.stderr

    def data(name: str) -> bytes:
        return (tmp_path / name).read_bytes()

    run("a.sog4d")
    _, here = run("b.sog4d", "--block-splats", "500")
    _, there = run("c.sog4d", "--scheduler", "local:1")
    _, whole = run("d.sog4d", "--scheduler", "local:1", "--visual-tolerance", "0.01")
    run("e.sog4d", "--visual-tolerance", "0.01")

    assert (here["cluster"]["blocks"], there["cluster"]["blocks"], "blocks" in whole["cluster"]) == (3, 1, False)
    assert data("a.sog4d") == data("b.sog4d") == data("c.sog4d")
    assert data("d.sog4d") == data("e.sog4d")
    for words, said in (
        (["--visual-tolerance", "0.01"], "a visual tolerance weighs"),
        (["--target-psnr", "30", "--views", "1"], "--target-psnr looks at the whole scene"),
    ):
        code, error = run("f.sog4d", "--block-splats", "500", *words)
        assert code == 1
        assert said in error
    refused = CliRunner().invoke(main, [str(scenes / "1.ply"), str(tmp_path / "f.spz"), "--block-splats", "500"])
    assert "blocks are for .sog4d targets" in refused.stderr
    assert not list(tmp_path.glob(".*"))


def test_draws__keep_the_rows_of_their_ranks() -> None:
    ranks = np.random.default_rng(0).permutation(1000).astype(np.uint32)
    draw = _Draw(np.arange(0, 1000, 7), row_type(0))
    for part in np.array_split(ranks, 9):
        rows = np.zeros(len(part), row_type(0))
        rows["opacity_logits"] = part
        draw.take(part, rows)
    assert draw.rows["opacity_logits"].tolist() == list(range(0, 1000, 7))
