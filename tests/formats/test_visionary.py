"""Visionary's buffers in files: bytes by hand, what precision costs, and what is refused."""

from __future__ import annotations

import io
import json
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.convert import convert
from gsplat_tools.errors import (
    CapabilityError,
    CloudError,
    CorruptDataError,
    GsplatWarning,
    LossyConversionWarning,
    TruncatedDataError,
    UnsupportedVersionError,
)
from gsplat_tools.formats import load, save
from gsplat_tools.formats.registry import FORMATS
from tests.clouds import random_cloud

C0 = 0.28209479177387814


def single(**changes: Any) -> GaussianCloud:
    fields = {
        "means": [[1.0, -2.0, 0.5]],
        "log_scales": np.log([[1.0, 2.0, 0.5]]),
        "quats": [[1.0, 0.0, 0.0, 0.0]],
        "opacity_logits": [np.log(3.0)],
        "sh0": [[0.25, -0.5, 1.0]],
        "shN": np.arange(9.0).reshape(1, 3, 3),
    }
    return GaussianCloud(**(fields | changes))


def write(cloud: GaussianCloud, to: str, **options: Any) -> io.BytesIO:
    record = FORMATS[to]
    stream = io.BytesIO()
    assert record.write is not None
    record.write(cloud, stream, record.write_options(**options))
    stream.seek(0)
    return stream


@pytest.mark.parametrize(("to", "code", "sh"), [("visionary-f32", "f", 48), ("visionary-f16", "e", 48)])
def test_buffers__lie_one_behind_the_other(to: str, code: str, sh: int) -> None:
    cloud = single()
    data = write(GaussianCloud(**{name: np.repeat(a, 2, axis=0) for name, a in cloud.arrays().items()}), to).getvalue()

    gaussian = struct.pack(f"<10{code}", 1, -2, 0.5, 0.75, 1, 0, 0, 4, 0, 0.25)
    color = struct.pack(f"<{sh}{code}", 0.25, -0.5, 1, *range(9), *[0] * 36)
    assert data == 2 * gaussian + 2 * color


@pytest.mark.parametrize(("to", "code", "count"), [("visionary-f32", "f", 3), ("visionary-f16", "e", 4)])
def test_raw_color__takes_the_place_of_sh(to: str, code: str, count: int) -> None:
    cloud = single(sh0=[[0.5 / C0, 0.0, -0.25 / C0]], shN=np.zeros((1, 0, 3)))

    stream = write(cloud, to, raw_color=True)

    color = bytes(struct.calcsize(f"<{count}{code}"))
    found = struct.unpack(f"<{count}{code}", stream.getvalue()[-len(color) :])
    assert found == pytest.approx((1.0, 0.5, 0.25, 0.0)[:count], abs=1e-7)
    record = FORMATS[to]
    assert record.read is not None
    assert record.read(stream, None).sh0 == pytest.approx(cloud.sh0, abs=1e-6)
    with pytest.raises(CapabilityError, match="--sh-degree 0"):
        write(single(), to, raw_color=True)


@pytest.mark.parametrize("layout", ["interleaved", "channel-major"])
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("to", ["visionary-f32", "visionary-f16"])
def test_sh_layout__comes_back_by_the_sidecar(layout: str, degree: int, to: str, tmp_path: Path) -> None:
    cloud = random_cloud(30, sh_degree=degree)
    report = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        report = save(cloud, tmp_path / "a.vis", to=to, sh_layout=layout, sh_degree=degree)
        found = load(tmp_path / "a.vis")

    assert report.bytes == 30 * (232 if to == "visionary-f32" else 116)
    assert isinstance(found, GaussianCloud)
    assert found.sh_degree == degree
    assert found.shN == pytest.approx(cloud.shN, abs=0 if to == "visionary-f32" else 1e-3)


def test_sidecar__holds_the_values_of_model_params(tmp_path: Path) -> None:
    cloud = random_cloud(7, sh_degree=2).replace(origin=np.array([1e5, 0.25, -3.0]))
    options = {"kernel_size": 0.3, "cutoff_scale": 0.5, "render_mode": "depth", "base_offset": 42}

    save(cloud, tmp_path / "a.vis", to="visionary-f32", **options)

    sidecar = json.loads((tmp_path / "a.vis.json").read_text())
    assert sidecar["modelParams"] == {
        "model": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1e5, 0.25, -3, 1],
        "baseOffset": 42,
        "num_points": 7,
        "gaussianScaling": 1,
        "maxShDeg": 2,
        "kernelSize": 0.3,
        "opacityScale": 1,
        "cutoffScale": 0.5,
        "rendermode": 2,
        "gaussDataType": 0,
        "colorDataType": 0,
        "gaussScale": 1,
        "gaussZeroPoint": 0,
        "colorScale": 1,
        "colorZeroPoint": 0,
    }
    assert sidecar["buffers"] == [
        {"name": "gaussian", "offset": 0, "stride": 40},
        {"name": "color", "offset": 280, "stride": 192},
    ]
    with pytest.warns(GsplatWarning, match="cutoffScale"):
        found = load(tmp_path / "a.vis")
    assert isinstance(found, GaussianCloud)
    assert found.origin.tolist() == [1e5, 0.25, -3.0]
    assert np.array_equal(found.means, cloud.means)


@pytest.mark.parametrize(
    "changes",
    [
        {"splats": -1},
        {"splats": 3.5},
        {"shDegree": 4},
        {"shLayout": "planar"},
        {"color": "hsv"},
        {"modelParams": 3},
        {"modelParams": {"model": [1, 2]}},
        {"modelParams": {"model": ["x"] * 16}},
        {"modelParams": {"model": [0] * 16}},
    ],
    ids=str,
)
def test_sidecar__with_nonsense_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    save(random_cloud(7), path, to="visionary-f32")
    place = tmp_path / "a.vis.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | changes))

    with pytest.raises(CorruptDataError) as caught:
        load(path)
    assert (caught.value.field or "").split(".")[0] == next(iter(changes))


def test_splats_of_the_sidecar__must_fit_the_size(tmp_path: Path) -> None:
    path = tmp_path / "a.vis"
    save(random_cloud(7), path, to="visionary-f32")
    place = tmp_path / "a.vis.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | {"splats": 8}))

    with pytest.raises(TruncatedDataError, match="232 bytes a splat, and 8 splats by the sidecar, found 1624 bytes"):
        load(path)


@pytest.mark.parametrize(
    "options", [{"kernel_size": -1}, {"cutoff_scale": 0.05}, {"base_offset": -1}, {"render_mode": "x"}], ids=str
)
@pytest.mark.parametrize("to", ["visionary-f32", "visionary-i8"])
def test_options__that_visionary_would_clamp_are_refused(options: dict[str, Any], to: str) -> None:
    with pytest.raises(CapabilityError, match=next(iter(options))):
        FORMATS[to].write_options(**options)


def test_f16__warns_of_needles_that_come_back_flat() -> None:
    turned = [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]
    needle = single(log_scales=np.log([[1.0, 3e-3, 3e-3]]), quats=[turned], shN=np.zeros((1, 0, 3)))

    with pytest.warns(LossyConversionWarning, match="axis of 1 of 1 splats") as caught:
        stream = write(needle, "visionary-f16")

    assert [getattr(w.message, "code", None) for w in caught] == ["lost-needles"]
    read = FORMATS["visionary-f16"].read
    assert read is not None
    assert np.isneginf(read(stream, None).log_scales).any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for to in ("visionary-f32", "visionary-i8"):
            write(needle, to)


def test_f16__refuses_positions_and_shrinks_splats_beyond_its_range() -> None:
    with pytest.raises(CapabilityError, match="--recenter on"):
        write(single(means=[[7e4, 0, 0]]), "visionary-f16")

    large = single(log_scales=np.log([[1000.0, 500.0, 500.0]]), sh0=[[0, 1e6, 0]])
    with pytest.warns(LossyConversionWarning, match="1 splats too large, 1 color values"):
        stream = write(large, "visionary-f16")

    read = FORMATS["visionary-f16"].read
    assert read is not None
    found = read(stream, None)
    assert np.exp(found.log_scales[0]) == pytest.approx(np.array([0.5, 0.5, 1]) * np.sqrt(65504), rel=1e-3)
    assert found.sh0[0, 1] == 65504


@pytest.mark.parametrize("to", ["visionary-f32", "visionary-f16", "visionary-i8"])
@pytest.mark.parametrize(
    ("field", "value"), [("means", np.inf), ("log_scales", np.nan), ("log_scales", np.inf), ("sh0", np.nan)]
)
def test_values_that_are_not_finite__are_refused(to: str, field: str, value: float) -> None:
    broken = getattr(single(), field).copy()
    broken[0, 1] = value

    with pytest.raises(CloudError) as caught:
        write(single(**{field: broken}), to)
    assert caught.value.field == field


def test_int8__bytes_of_one_splat() -> None:
    cloud = single(
        log_scales=[[-np.inf, 0.0, 1.0]], opacity_logits=[np.inf], shN=np.zeros((1, 0, 3)), origin=np.array([10.0, 20.0, 30.0])
    )

    data = write(cloud, "visionary-i8", clip=0.0, position_bits=8).getvalue()

    magic, *words = struct.unpack_from("<8s6I", data)
    assert magic == b"GSVISI8\0"
    assert words == [1, 1, 0, 8, 256, zlib.crc32(data[64:])]
    assert struct.unpack_from("<3d8x", data, 32) == (10, 20, 30)
    table = np.frombuffer(data, "<f4", 18, 64).reshape(9, 2)
    # One value a channel: the zero point is the value, the code 0. Axes are sorted, longest first.
    assert table[:, 1].tolist() == [1.0, 0.0, 0.0, 0.25, -0.5, 1.0, 1.0, -2.0, 0.5]
    record = np.frombuffer(data, np.int8, offset=64 + 72)
    assert record[:7].tolist() == [0, 0, 0, 127, 0, 0, -128]
    assert record[11:].tolist() == [0, 0, 0]
    assert np.linalg.norm(record[7:11]) == pytest.approx(128, abs=45)


def test_int8__keeps_flat_axes_and_ends_of_opacity() -> None:
    cloud = random_cloud(300, sh_degree=1)
    logs, logits = cloud.log_scales.copy(), cloud.opacity_logits.copy()
    logs[:40, 1], logits[:5], logits[5:9] = -np.inf, np.inf, -np.inf
    cloud = cloud.replace(log_scales=logs, opacity_logits=logits)
    record = FORMATS["visionary-i8"]
    assert record.read is not None

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LossyConversionWarning)
        found = record.read(write(cloud, "visionary-i8"), None)

    assert np.array_equal(np.isneginf(found.log_scales).sum(axis=1), np.isneginf(logs).sum(axis=1))
    assert np.isposinf(found.opacity_logits[:5]).all()
    assert np.isneginf(found.opacity_logits[5:9]).all()


def test_int8__clipping_is_counted(rng: np.random.Generator) -> None:
    cloud = random_cloud(500, sh_degree=0)

    with pytest.warns(LossyConversionWarning, match="of 3000 scales and SH values"):
        write(cloud, "visionary-i8", clip=0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write(cloud, "visionary-i8", clip=0.0)


@pytest.mark.parametrize(
    ("offset", "value", "error"),
    [
        (8, 9, UnsupportedVersionError),
        (16, 4, CorruptDataError),
        (20, 12, CorruptDataError),
        (12, 2**31, CorruptDataError),
        (24, 7, CorruptDataError),
        (70, 1, CorruptDataError),
    ],
)
def test_int8__refuses_headers_that_promise_something_else(offset: int, value: int, error: type[Exception]) -> None:
    data = bytearray(write(single(), "visionary-i8").getvalue())
    struct.pack_into("<I", data, offset, value)
    read = FORMATS["visionary-i8"].read
    assert read is not None

    with pytest.raises(error):
        read(io.BytesIO(bytes(data)), None)


@pytest.mark.parametrize("options", [{"clip": 0.5}, {"clip": -0.1}, {"clip": "rendered"}, {"position_bits": 12}], ids=str)
def test_int8__refuses_options_without_a_meaning(options: dict[str, Any]) -> None:
    with pytest.raises(CapabilityError, match=next(iter(options))):
        FORMATS["visionary-i8"].write_options(**options)


def test_convert__goes_through_all_three_and_validates_each(tmp_path: Path) -> None:
    cloud = random_cloud(300, sh_degree=2)
    save(cloud, tmp_path / "a.ply")
    source = "a.ply"
    for precision in ("f32", "f16", "i8", "f32"):
        target = f"{len(list(tmp_path.iterdir()))}.vis"
        report = convert([tmp_path / source], tmp_path / target, to=f"visionary-{precision}")
        assert report.validation is not None
        assert report.validation["passed"]
        assert report.format == f"visionary-{precision}"
        source = target
    raw = convert([tmp_path / "a.ply"], tmp_path / "raw.vis", to="visionary-f16", raw_color=True, sh_degree=0)
    assert raw.bytes == 300 * 28
    assert raw.validation is not None


def test_convert__chooses_int8_ranges_by_rendering(tmp_path: Path) -> None:
    save(random_cloud(300, sh_degree=0), tmp_path / "a.ply")

    report = convert([tmp_path / "a.ply"], tmp_path / "a.vis", to="visionary-i8", clip="rendered")

    assert report.options["clip"] in ("auto", 0.0, 1e-5, 1e-4, 1e-3, 1e-2)


def test_convert__does_not_warn_of_model_params_that_it_was_asked_for(tmp_path: Path) -> None:
    save(random_cloud(30, sh_degree=0), tmp_path / "a.ply")

    report = convert([tmp_path / "a.ply"], tmp_path / "a.vis", to="visionary-f32", gaussian_scaling=2.0)
    again = convert([tmp_path / "a.vis"], tmp_path / "b.ply")

    assert report.warnings == []
    assert [warning["code"] for warning in again.warnings] == ["model-params"]
