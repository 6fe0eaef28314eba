"""SOG scenes of every kind, assembled by hand, against what plain arithmetic says they mean."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import (
    CapabilityError,
    CorruptDataError,
    FormatError,
    GsplatWarning,
    LimitExceededError,
    UnsupportedVersionError,
)
from gsplat_tools.formats import load
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.sog import FORMAT, RULES, SogReadOptions, matches, read
from tests.formats import sog_files
from tests.formats.sog_files import archive, edited, folder, version_1, version_2, webp


def decode(files: dict[str, bytes], **options: Any) -> GaussianCloud:
    """Read a bundle of the files, whatever is warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        return read(io.BytesIO(archive(files)), SogReadOptions(**options))


def warned(files: dict[str, bytes]) -> tuple[GaussianCloud, list[GsplatWarning]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cloud = read(io.BytesIO(archive(files)), SogReadOptions())
    return cloud, [w.message for w in caught if isinstance(w.message, GsplatWarning)]


def position(low: int, high: int, first: float, last: float) -> float:
    n = first + (last - first) * (low + 256 * high) / 65535
    return math.copysign(math.exp(abs(n)) - 1, n)


def quaternion(a: int, b: int, c: int, tag: int) -> list[float]:
    if tag < 252:
        return [1.0, 0.0, 0.0, 0.0]
    smaller = [(v / 255 * 2 - 1) / math.sqrt(2) for v in (a, b, c)]
    whole = smaller.copy()
    whole.insert(tag - 252, math.sqrt(max(0.0, 1 - sum(v * v for v in smaller))))
    return whole


def test_positions_and_rotations__follow_the_formulas() -> None:
    cloud = decode(version_2())

    ranges = [(-1.0, 1.0), (0.0, 3.0), (-2.0, 2.0)]
    expected = [
        [position(low[k], high[k], *ranges[k]) for k in range(3)]
        for low, high in zip(sog_files.MEANS_L, sog_files.MEANS_U, strict=True)
    ]
    np.testing.assert_allclose(cloud.means, expected, rtol=2e-7)
    assert cloud.means[0, 0] == np.float32(1 - math.e)
    np.testing.assert_allclose(cloud.quats, [quaternion(*pixel) for pixel in sog_files.QUATS], atol=1e-7)
    np.testing.assert_array_equal(cloud.quats[4], [1, 0, 0, 0])


def test_codebooks__give_scales_colors_and_opacities() -> None:
    cloud = decode(version_2(bands=0))

    np.testing.assert_array_equal(cloud.log_scales, [[-12 + v / 16 for v in pixel[:3]] for pixel in sog_files.SCALES])
    np.testing.assert_array_equal(cloud.sh0, [[-2 + v / 64 for v in pixel[:3]] for pixel in sog_files.COLORS])
    ends = math.log(1e-6 / (1 - 1e-6))
    expected = [ends, -ends, math.log(128 / 127), math.log(1 / 254), math.log(254)]
    np.testing.assert_allclose(cloud.opacity_logits, expected, rtol=1e-6)
    assert cloud.sh_degree == 0


@pytest.mark.parametrize("bands", [1, 2, 3])
def test_palette__is_found_by_entry_and_coefficient(bands: int) -> None:
    cloud, messages = warned(version_2(bands))

    coefficients = (3, 8, 15)[bands - 1]
    expected = [[-1 + (10 * j + k) / 128 for k in range(3)] for j in range(coefficients)]
    np.testing.assert_array_equal(cloud.shN[0], expected)
    np.testing.assert_array_equal(cloud.shN[4], expected)
    assert not cloud.shN[1].any()  # entry 0 indexes 128 everywhere, which is 0
    assert not cloud.shN[2].any()
    assert not cloud.shN[3].any()
    assert [m.code for m in messages] == ["label-range"]
    assert "2 of 5 labels" in str(messages[0])


def test_version_1__interpolates_between_ends() -> None:
    cloud = decode(version_1(bands=2))

    scales = [[low + (high - low) * v / 255 for v, low, high in zip(pixel[:3], (-8, -9, -10), (0, 1, 2), strict=True)]
              for pixel in sog_files.SCALES]  # fmt: skip
    np.testing.assert_allclose(cloud.log_scales, scales, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(cloud.opacity_logits, [-6 + 18 * pixel[3] / 255 for pixel in sog_files.COLORS], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh0[1], [1, -2, -3 + 6 * 128 / 255], rtol=1e-6)
    np.testing.assert_allclose(cloud.shN[0, 7], [-0.5 + v / 255 for v in (70, 71, 72)], atol=1e-7)
    np.testing.assert_array_equal(cloud.means, decode(version_2()).means)
    assert cloud.sh_degree == 2
    assert FORMAT.inspect(io.BytesIO(archive(version_1(bands=3)))).sh_degree == 3


def same(first: GaussianCloud, second: GaussianCloud) -> bool:
    return all(np.array_equal(values, getattr(second, name)) for name, values in first.arrays().items())


def test_folder__is_read_like_the_bundle(tmp_path: Path) -> None:
    bundle = decode(version_2(bands=0))

    assert same(load(folder(version_2(bands=0), tmp_path)), bundle)  # type: ignore[arg-type]
    assert same(read(io.BytesIO(archive(version_2(bands=0), deflated=True)), SogReadOptions()), bundle)
    assert same(read(io.BytesIO(archive(version_2(bands=0), prefix="scene/")), SogReadOptions()), bundle)
    reversed_files = dict(reversed(version_2(bands=0).items()))
    (tmp_path / "first.sog").write_bytes(archive(reversed_files))
    assert same(load(tmp_path / "first.sog"), bundle)  # type: ignore[arg-type]


def test_meta_json_alone__says_that_the_images_are_missing() -> None:
    with pytest.raises(CorruptDataError, match="give its path"):
        read(io.BytesIO(version_2()["meta.json"]), SogReadOptions())


@pytest.mark.parametrize("name", ["../q.webp", "/q.webp", "a/../../q.webp", "C:q.webp", "a\\q.webp", "", "link/q.webp"])
def test_names_that_lead_out_of_the_folder__are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "q.webp").write_bytes(webp(sog_files.QUATS))
    inside = tmp_path / "inside"
    path = folder(edited(version_2(bands=0), "quats.files", [name]), inside)
    (inside / "link").symlink_to(tmp_path)

    with pytest.raises(CorruptDataError, match="path"):
        load(path)


def test_splat_model__is_taken_from_either_tag() -> None:
    files = version_2(bands=0)

    assert decode(files).splat_model == "default"
    assert decode(edited(files, "antialias", True)).splat_model == "antialiased"
    assert decode(edited(files, "antialias", False)).splat_model == "default"
    assert decode(edited(files, "model", "2dgs")).splat_model == "2dgs"
    assert decode(edited(files, "model", "antialiased")).splat_model == "antialiased"
    cloud, messages = warned(edited(files, "model", "3dgs-plus"))
    assert cloud.splat_model == "default"
    assert [m.code for m in messages] == ["unknown-model"]
    cloud, messages = warned(edited(edited(files, "model", "antialiased"), "antialias", False))
    assert cloud.splat_model == "antialiased"
    assert [m.code for m in messages] == ["model-conflict"]


REQUIRED = [
    "count", "means", "means.mins", "means.maxs", "means.files", "scales", "scales.codebook", "scales.files", "quats",
    "quats.files", "sh0", "sh0.codebook", "sh0.files", "shN.count", "shN.bands", "shN.codebook", "shN.files",
]  # fmt: skip


@pytest.mark.parametrize("path", REQUIRED)
@pytest.mark.parametrize("value", [..., None, "x", [], {}, -1, 1e400, True, [None] * 256, ["x.webp"] * 3, [1e300] * 256])
def test_meta__names_the_field_that_is_wrong(path: str, value: Any) -> None:
    with pytest.raises(FormatError) as caught:
        decode(edited(version_2(), path, value))

    assert caught.value.field is not None
    assert path.split(".", maxsplit=1)[0] in caught.value.field or "webp" in caught.value.field
    assert caught.value.code in RULES  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("path", "value", "code"),
    [
        ("count", 7, "image-size"),
        ("count", 2.5, "count"),
        ("count", 10**12, "image-limit"),
        ("means.mins", [2, 0, -2], "range"),
        ("means.maxs", [1, 3, 89], "range"),
        ("scales.codebook", [0.0] * 257, "codebook-length"),
        ("scales.codebook", [0.0] * 9, "codebook-index"),
        ("sh0.codebook", [0.0], "codebook-index"),
        ("shN.codebook", [0.0] * 128, "codebook-index"),
        ("shN.bands", 4, "bands"),
        ("shN.bands", 2, "palette-size"),
        ("shN.count", 0, "palette-count"),
        ("shN.count", 65537, "palette-count"),
        ("shN.count", 129, "palette-size"),
        ("quats.files", ["none.webp"], "file-missing"),
        ("means.files", ["low.webp"], "files"),
    ],
)
def test_contradiction__is_refused_by_its_rule(path: str, value: Any, code: str) -> None:
    with pytest.raises(FormatError) as caught:
        decode(edited(version_2(), path, value))

    assert caught.value.code == code  # type: ignore[attr-defined]


@pytest.mark.parametrize("version", [1, 3, "2", True, None])
def test_other_versions__are_refused(version: object) -> None:
    with pytest.raises(UnsupportedVersionError, match="version 2"):
        decode(edited(version_2(), "version", version))


@pytest.mark.parametrize("text", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b'{"version": 2}', b"{}"])
def test_meta_that_is_no_object__is_refused(text: bytes) -> None:
    with pytest.raises(CorruptDataError):
        decode(version_2() | {"meta.json": text})


def test_archive_without_meta__is_refused() -> None:
    files = version_2()
    del files["meta.json"]

    with pytest.raises(CorruptDataError, match=r"meta\.json at the root"):
        decode(files)


def test_image_that_claims_more_than_its_file_holds__is_refused_before_decoding() -> None:
    whole = version_2()["c.webp"]
    bits = (16383 - 1) | (16383 - 1) << 14 | 1 << 28
    huge = whole[:21] + bits.to_bytes(4, "little") + whole[25:]

    with pytest.raises(LimitExceededError):
        decode(version_2() | {"c.webp": huge})


def test_lossy_image__is_refused() -> None:
    from PIL import Image

    target = io.BytesIO()
    Image.new("RGBA", (8, 8)).save(target, "WEBP", lossless=False)

    with pytest.raises(CorruptDataError, match="lossless"):
        decode(version_2() | {"q.webp": target.getvalue()})


def test_matches__tells_bundles_apart_from_other_archives_and_json() -> None:
    assert not matches(b"PK\x03\x04" + bytes(26) + b"meta.json")
    assert not matches(b"PK\x03\x04" + bytes(26) + b"frames/00000/sh0.webp")
    assert matches(b"PK\x03\x04" + bytes(26) + b"means_l.webp")
    assert matches(version_2()["meta.json"])
    assert matches(version_1()["meta.json"])
    assert not matches(b'{"format": "sog4d", "means": {}}')
    assert not matches(b'{"layout": "other"}')
    assert not matches(b"ply\n")


def test_inspect__reads_no_image_and_loads_no_compiler(tmp_path: Path) -> None:
    path = folder(version_2(bands=0) | {"c.webp": b"", "q.webp": b""}, tmp_path)

    _, facts = inspect_file(path)

    assert (facts.version, facts.splats, facts.sh_degree) == ("2", 5, 0)
    assert facts.bounds is not None
    np.testing.assert_allclose(facts.bounds[0], [1 - math.e, 0, 1 - math.e**2])
    code = f"import sys; from gsplat_tools.inspection import info; info({str(path)!r}); sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def lod_scene(root: Path, **changes: Any) -> Path:
    """A scene of two levels in three bundles, and an environment."""
    for name in ("0_0", "0_1", "1_0", "env"):
        folder(version_2(bands=1 if name == "0_1" else 0), root / name)
    meta = {
        "version": 1,
        "lodLevels": 2,
        "counts": [8, 2],
        "environment": "env/meta.json",
        "filenames": ["0_0/meta.json", "1_0/meta.json", "0_1/meta.json"],
        "tree": {
            "bound": {"min": [0, 0, 0], "max": [1, 1, 1]},
            "children": [
                {"lods": {"0": {"file": 2, "offset": 1, "count": 3}, "1": {"file": 1, "offset": 0, "count": 2}}},
                {"lods": {"0": {"file": 0, "offset": 0, "count": 5}}},
            ],
        },
    }
    path = root / "lod-meta.json"
    path.write_text(json.dumps(meta | changes))
    return path


def test_lod__reads_the_rows_of_one_level_and_the_environment(tmp_path: Path) -> None:
    path = lod_scene(tmp_path)
    whole = decode(version_2(bands=1))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        finest, coarse = load(path), load(path, lod=1)

    rows = [0, 1, 2, 3, 4, 1, 2, 3, 0, 1, 2, 3, 4]
    np.testing.assert_array_equal(finest.means, whole.means[rows])  # type: ignore[union-attr]
    np.testing.assert_array_equal(finest.shN[5:8], whole.shN[1:4])  # type: ignore[union-attr]
    assert not finest.shN[:5].any()  # type: ignore[union-attr]
    np.testing.assert_array_equal(coarse.means, whole.means[[0, 1, 0, 1, 2, 3, 4]])  # type: ignore[union-attr]
    _, facts = inspect_file(path)
    assert (facts.splats, facts.sh_degree, facts.encoding["levels"]) == (13, 1, [8, 2])


@pytest.mark.parametrize(
    "changes",
    [
        {"version": 2},
        {"filenames": ["0_0/meta.json", "../x/meta.json", "0_1/meta.json"]},
        {"filenames": ["0_0/meta.json"]},
        {"filenames": ["0_0/meta.json", "1_0/meta.json", "gone/meta.json"]},
        {"filenames": "0_0"},
        {"lodLevels": 1},
        {"lodLevels": "two"},
        {"counts": [8, 3]},
        {"environment": 7},
        {"tree": {"children": [{"lods": {"0": {"file": 0, "offset": 4, "count": 4}}}]}},
        {"tree": {"children": [{"lods": {"x": {"file": 0, "offset": 0, "count": 1}}}]}},
        {"tree": {"children": [{"lods": {"0": {"file": 0, "offset": -1, "count": 1}}}]}},
        {"tree": {"children": [7]}},
        {"tree": {"children": 7}},
        {"tree": 7},
    ],
)
def test_lod_that_contradicts_itself__is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    path = lod_scene(tmp_path, **changes)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        with pytest.raises(FormatError):
            load(path)


def test_level_that_is_not_there__is_the_callers_fault(tmp_path: Path) -> None:
    with pytest.raises(CapabilityError, match=r"0\.\.1"):
        load(lod_scene(tmp_path), lod=2)
    with pytest.raises(CapabilityError, match="lod=1"):
        decode(version_2(), lod=1)


@pytest.mark.parametrize(
    ("data", "found"),
    [(b"", "found an empty one"), (b"#!/bin/sh\n" + archive(version_2(0)), r"starts with b'#!/bin/sh"), (b"\x89PNG", "PNG")],
)
def test_file_that_is_neither_archive_nor_json__is_said_to_be(data: bytes, found: str, tmp_path: Path) -> None:
    (tmp_path / "scene.sog").write_bytes(data)

    with pytest.raises(CorruptDataError, match=f"expected a ZIP archive or a meta.json, .*{found}"):
        load(tmp_path / "scene.sog")
