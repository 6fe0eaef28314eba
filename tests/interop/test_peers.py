"""Our files read by other tools, and theirs by us; docs/interop.md has the table."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.ops.coordinates import convert_coordinates
from tests.clouds import random_cloud
from tests.interop import peers

COUNT = 700


def write(cloud: GaussianCloud, path: Path, **options: object) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        save(cloud, path, order="none", **options)


def read(path: Path, **options: object) -> GaussianCloud:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        cloud = load(path, **options)
    assert isinstance(cloud, GaussianCloud)
    return cloud


def largest_differences(ours: GaussianCloud, theirs: GaussianCloud | Mapping[str, np.ndarray]) -> dict[str, float]:
    """Largest difference of every attribute; rotations as angles in radians, opacities after the sigmoid."""
    other = theirs.arrays() if isinstance(theirs, GaussianCloud) else theirs
    differences = {}
    for name in ("means", "log_scales", "sh0", "shN"):
        a, b = getattr(ours, name), np.asarray(other[name])
        assert a.shape == b.shape, name
        differences[name] = float(np.abs(a.astype(np.float64) - b).max(initial=0.0))
    with np.errstate(over="ignore"):
        opacities = [
            1 / (1 + np.exp(-np.asarray(v, np.float64).reshape(-1))) for v in (ours.opacity_logits, other["opacity_logits"])
        ]
    differences["opacities"] = float(np.abs(opacities[0] - opacities[1]).max())
    a, b = ours.quats.astype(np.float64), np.asarray(other["quats"], np.float64)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    b = b * np.where((a * b).sum(axis=1, keepdims=True) < 0, -1, 1)
    differences["rotations"] = float(4 * np.arcsin(np.linalg.norm(a - b, axis=1).max() / 2))
    return differences


ROUNDING = {"means": 1e-6, "log_scales": 2e-6, "sh0": 1e-6, "shN": 1e-6, "opacities": 2e-6, "rotations": 2e-6}


SOG_ROTATIONS = 2e-6


def sorted_by_position(cloud: GaussianCloud) -> GaussianCloud:
    return cloud.take(np.lexsort(cloud.means.T))


def assert_same(ours: GaussianCloud, theirs: GaussianCloud | Mapping[str, np.ndarray], **changes: float) -> None:
    allowed = ROUNDING | changes
    exceeded = {name: value for name, value in largest_differences(ours, theirs).items() if value > allowed[name]}
    assert exceeded == {}


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_our_spz__is_read_by_splat_transform(version: int, sh_degree: int, tmp_path: Path) -> None:
    path, back = tmp_path / "a.spz", tmp_path / "a.ply"
    write(random_cloud(COUNT, sh_degree=sh_degree).replace(splat_model="antialiased"), path, version=version)

    peers.splat_transform(path, back)

    theirs = read(back)
    assert theirs.splat_model == "antialiased"
    assert_same(read(path), theirs)


@pytest.mark.parametrize("version", [3, 4])
def test_spz_of_splat_transform__is_read_by_us(version: int, tmp_path: Path) -> None:
    source, path, back = tmp_path / "a.ply", tmp_path / "a.spz", tmp_path / "b.ply"
    write(random_cloud(COUNT, sh_degree=2), source)

    peers.splat_transform("--spz-version", str(version), source, path)
    peers.splat_transform(path, back)

    assert_same(read(path), read(back))


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_our_compressed_ply__is_read_by_splat_transform(sh_degree: int, tmp_path: Path) -> None:
    path, back = tmp_path / "a.compressed.ply", tmp_path / "a.ply"
    write(random_cloud(COUNT, sh_degree=sh_degree), path)

    peers.splat_transform(path, back)

    assert_same(read(path), read(back))


def test_compressed_ply_of_splat_transform__is_read_by_us(tmp_path: Path) -> None:
    source, path, back = tmp_path / "a.ply", tmp_path / "a.compressed.ply", tmp_path / "b.ply"
    write(random_cloud(COUNT, sh_degree=3), source)

    peers.splat_transform(source, path)
    peers.splat_transform(path, back)

    assert_same(read(path), read(back))


def test_our_splat__is_read_by_splat_transform(tmp_path: Path) -> None:
    path, back = tmp_path / "a.splat", tmp_path / "a.ply"
    write(random_cloud(COUNT, sh_degree=0), path)

    peers.splat_transform(path, back)

    # It takes a byte for 2 b / 255 - 1, half a step beside the (b - 128) / 128 of the format's own viewer: up to a step over
    # all four, on a ray of at least 64, and a rotation turns by twice the angle.
    assert_same(read(path), read(back), rotations=2 / 64)


@pytest.mark.parametrize(
    ("system", "target"),
    # From the Z-up family it applies flips of the target's family before the turn: only targets without flips come out right.
    [("RDF", "RUF"), ("RUB", "RUF"), ("LUF", "RDF"), ("LDB", "RUB"), ("RFU", "RUB"), ("LBD", "LDF"), ("RUB", "RFU")],
)
def test_extension__makes_the_formats_own_reader_convert_as_we_do(system: str, target: str, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write(random_cloud(COUNT, sh_degree=3).replace(coordinate_system=system), path)

    theirs = peers.read_with_adobe_spz(path, target)

    if not theirs["understands_extensions"]:
        pytest.skip("this build of @adobe/spz ignores extensions")
    # Its opacities stop short of 0 and 1.
    assert_same(convert_coordinates(read(path), target), theirs, opacities=1 / 255 + 1e-6, means=5e-6, rotations=5e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_degree_4__is_read_by_the_formats_own_reader(version: int, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write(random_cloud(COUNT, sh_degree=4), path, version=version)

    assert_same(read(path), peers.read_with_adobe_spz(path, "UNSPECIFIED"), opacities=1 / 255 + 1e-6)


@pytest.mark.parametrize("name", ["v2.spz", "v3.spz", "v4.spz", "a.compressed.ply"])
def test_our_files__are_read_by_gsply(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    options = {"version": int(name[1])} if name.endswith(".spz") else {}
    write(random_cloud(COUNT, sh_degree=3), path, **options)

    assert_same(read(path), peers.read_with_gsply(path), opacities=1 / 255 + 1e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_spz_of_gsply__is_read_by_us(version: int, tmp_path: Path) -> None:
    source, path = tmp_path / "a.ply", tmp_path / "a.spz"
    write(random_cloud(COUNT, sh_degree=2), source)

    peers.write_spz_with_gsply(source, path, version)

    assert_same(read(path), peers.read_with_gsply(path), opacities=1 / 255 + 1e-6)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", ["a.sog", "meta.json"])
def test_our_sog__is_read_by_splat_transform(sh_degree: int, name: str, tmp_path: Path) -> None:
    path, back = tmp_path / "scene" / name, tmp_path / "a.ply"
    path.parent.mkdir()
    write(random_cloud(COUNT, sh_degree=sh_degree).replace(splat_model="antialiased"), path)

    peers.splat_transform(path, back)

    theirs = read(back)
    assert theirs.splat_model == "antialiased"
    assert_same(read(path), theirs, rotations=SOG_ROTATIONS)


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_our_sog__is_read_by_gsply(sh_degree: int, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    write(random_cloud(COUNT, sh_degree=sh_degree), path)

    assert_same(read(path), peers.read_with_gsply(path), rotations=SOG_ROTATIONS)


@pytest.mark.parametrize("name", ["a.sog", "meta.json"])
def test_sog_of_splat_transform__is_read_by_us(name: str, tmp_path: Path) -> None:
    source, path, back = tmp_path / "a.ply", tmp_path / "scene" / name, tmp_path / "b.ply"
    path.parent.mkdir()
    write(random_cloud(COUNT, sh_degree=2), source)

    peers.splat_transform(source, path)
    peers.splat_transform(path, back)

    assert_same(read(path), read(back), rotations=SOG_ROTATIONS)


@pytest.mark.parametrize("level", [0, 1])
def test_levels_of_splat_transform__are_read_by_us(level: int, tmp_path: Path) -> None:
    sources, path, back = [tmp_path / "0.ply", tmp_path / "1.ply"], tmp_path / "lod" / "lod-meta.json", tmp_path / "b.ply"
    path.parent.mkdir()
    for seed, source in enumerate(sources):
        write(random_cloud(COUNT // (1 + seed), sh_degree=1, seed=seed), source)

    peers.splat_transform(sources[0], "--tag-lod", "0", sources[1], "--tag-lod", "1", path)
    peers.splat_transform("--select-lod", str(level), path, back)

    ours, theirs = read(path, lod=level), read(back)
    assert len(ours) == COUNT // (1 + level)
    assert_same(sorted_by_position(ours), sorted_by_position(theirs), rotations=SOG_ROTATIONS)
