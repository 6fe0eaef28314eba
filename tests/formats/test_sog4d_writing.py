"""What is written: exactness of each attribute, sizes, determinism, refusals."""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np
import pytest

from gsplat_tools.attributes.quaternions import to_matrix
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.quaternion_u8 import encode_constant_w
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats.sog4d import Sog4dOptions, Sog4dReadOptions, read, write
from gsplat_tools.formats.sog4d.bounds import rotation_bound, scale_reach
from gsplat_tools.formats.sog4d.codebooks import falling_frames, scale_coordinates, scales_at, turned
from gsplat_tools.parallel import use_jobs
from tests.clouds import random_cloud


def written(scene: Any, **options: Any) -> bytes:
    target = io.BytesIO()
    write(scene, target, Sog4dOptions(**options))
    return target.getvalue()


def decoded(data: bytes, frame: int = 0) -> GaussianCloud:
    return read(io.BytesIO(data), Sog4dReadOptions()).frame(frame)


def meta_of(data: bytes) -> Any:
    return json.loads(zipfile.ZipFile(io.BytesIO(data)).read("meta.json"))


def covariances(cloud: GaussianCloud) -> np.ndarray:
    rotation = to_matrix(cloud.quats.astype(np.float64))
    return np.einsum("nij,nj,nkj->nik", rotation, np.exp(2 * cloud.log_scales.astype(np.float64)), rotation)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_small_scene__keeps_sh_that_fit_the_palette(version: Any, sh_degree: int) -> None:
    cloud = random_cloud(40, sh_degree=sh_degree)

    back = decoded(written(cloud, version=version, centroids="f32"))

    assert back.shN.shape == cloud.shN.shape
    assert np.array_equal(back.shN, cloud.shN)


def test_f16_centroids__are_the_nearest_halves() -> None:
    cloud = random_cloud(40, sh_degree=2)

    back = decoded(written(cloud))

    assert np.array_equal(back.shN, cloud.shN.astype(np.float16).astype(np.float32))


def test_positions__are_rounded_to_half_a_step() -> None:
    cloud = random_cloud(500, sh_degree=0)

    back = decoded(written(cloud))

    step = (cloud.means.max(axis=0) - cloud.means.min(axis=0)).astype(np.float64) / 65535
    errors = (back.means.astype(np.float64) - cloud.means) / step
    assert np.abs(errors).max() <= 0.501
    assert np.abs(errors.mean(axis=0)).max() < 0.1  # rounded, not cut off


def test_flat_scene__keeps_its_plane() -> None:
    cloud = random_cloud(10, sh_degree=0)
    means = cloud.means.copy()
    means[:, 1] = 3.25

    back = decoded(written(cloud.replace(means=means)))

    assert back.means[:, 1].tolist() == [3.25] * 10


def test_opacities__are_rounded_to_255ths() -> None:
    logits = np.array([-np.inf, -20, -5.0, 0.0, 3.0, 20, np.inf], np.float32)
    cloud = random_cloud(7, sh_degree=0).replace(opacity_logits=logits)

    back = decoded(written(cloud))

    opacities, wanted = (1 / (1 + np.exp(-values.astype(np.float64))) for values in (back.opacity_logits, logits))
    assert np.abs(opacities - wanted).max() <= 0.5 / 255 + 1e-7
    assert opacities[[0, -1]].tolist() == [0, 1]


def test_color_of_a_splat_without_opacity__survives() -> None:
    cloud = random_cloud(30, sh_degree=0).replace(opacity_logits=np.full(30, -30, np.float32))

    assert np.array_equal(decoded(written(cloud)).sh0, cloud.sh0)


def test_few_scales__come_back_to_three_digits() -> None:
    cloud = random_cloud(300, sh_degree=0)
    scales = np.array([(0.123, 0.0456, 0.00789), (1.5, 1.5, 0.25)], np.float32)
    logs = np.log(scales)[np.arange(300) % 2]

    back = decoded(written(cloud.replace(log_scales=logs)))

    assert np.allclose(np.sort(back.log_scales, axis=1), np.sort(logs, axis=1), atol=0.005)


@pytest.mark.parametrize("rotation", ["best", "small", "reference"])
def test_rotations__leave_the_gaussian_within_the_stated_angle(rotation: Any) -> None:
    rng = np.random.default_rng(3)
    cloud = random_cloud(400, sh_degree=0).replace(
        quats=rng.normal(size=(400, 4)).astype(np.float32),
        # Two values only: the codebook is exact, what is left is the rotation.
        log_scales=np.log(np.array([(1.0, 0.5, 0.25), (0.25, 1.0, 0.5)], np.float32))[np.arange(400) % 2],
    )
    limit = {"best": 0.68, "small": 1.97, "reference": 0.91}[rotation]

    back = decoded(written(cloud, rotation=rotation))

    # A turn by an angle moves a covariance by at most sqrt(8/3) sin(angle) of its norm.
    before, after = covariances(cloud), covariances(back)
    moved = np.linalg.norm(after - before, axis=(1, 2)) / np.linalg.norm(before, axis=(1, 2))
    assert moved.max() <= np.sqrt(8 / 3) * np.sin(np.radians(limit)) + 1e-5


def test_constant_w__has_one_value_of_w_and_half_step_errors() -> None:
    rng = np.random.default_rng(5)
    cloud = random_cloud(2000, sh_degree=0).replace(quats=rng.normal(size=(2000, 4)).astype(np.float32))
    quats, _ = turned(cloud, falling_frames(cloud))

    codes = encode_constant_w(quats, 64)

    assert set(codes[:, 0].tolist()) == {128 + 64}
    stored = codes.astype(np.float64) - 128
    ray = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    along = np.abs(np.einsum("nc,nc->n", stored, ray)) / np.linalg.norm(stored, axis=1)
    angles = 2 * np.arccos(np.minimum(along, 1))
    assert angles.max() <= min(rotation_bound(codes), 2 * np.arcsin(np.sqrt(0.75) / 64) + 1e-6)


@pytest.mark.parametrize("quat", [(0, 1, 0, 0), (0.001, -1, 1, 1), (0, 0, 0, 0), (-1, 0.5, 0.5, 0.5), (1e-20, 1e-20, 0, 0)])
def test_constant_w__shortens_what_does_not_fit(quat: tuple[float, ...]) -> None:
    codes = encode_constant_w(np.array([quat], np.float32), 127)

    stored = codes[0].astype(np.float64) - 128
    wanted = np.array(quat, np.float64) if any(quat) else np.array([1.0, 0, 0, 0])
    cosine = abs(stored @ wanted) / np.linalg.norm(stored) / np.linalg.norm(wanted)
    assert cosine > np.cos(np.radians(0.5))


def test_falling_frames__name_the_same_gaussian() -> None:
    cloud = random_cloud(300, sh_degree=0)

    quats, log_scales = turned(cloud, falling_frames(cloud))

    assert (np.diff(log_scales, axis=1) <= 0).all()
    assert (np.abs(quats[:, 0]) >= np.abs(quats).max(axis=1) * (1 - 1e-5)).all()
    before, after = covariances(cloud), covariances(cloud.replace(quats=quats, log_scales=log_scales))
    assert np.abs(after - before).max() <= 1e-5 * np.abs(before).max()


def test_scale_coordinates__come_back() -> None:
    logs = np.random.default_rng(1).uniform(-6, 2, (200, 3)).astype(np.float32)

    back = scales_at(scale_coordinates(logs))

    thin = np.exp(logs) < 0.003 * np.exp(logs).max(axis=1, keepdims=True)
    assert np.allclose(np.log(back)[~thin], logs[~thin], atol=2e-3)
    assert (back >= 0).all()


def test_codebooks__span_the_data() -> None:
    cloud = random_cloud(3000, sh_degree=0)
    sh0 = cloud.sh0.copy()
    sh0[7] = (-9.5, 0, 12.25)

    codebook = np.float32(meta_of(written(cloud.replace(sh0=sh0)))["streams"]["sh"]["sh0Codebook"])

    assert len(codebook) == 256
    assert codebook[0] == np.float32(-9.5)
    assert codebook[-1] == np.float32(12.25)
    assert (np.diff(codebook) >= 0).all()


def test_base_rgb__clips_with_a_count() -> None:
    cloud = random_cloud(50, sh_degree=0)
    outside = int((np.abs(cloud.sh0) > 0.5 / 0.28209479177387814).any(axis=1).sum())
    assert 0 < outside < 50

    with pytest.warns(LossyConversionWarning, match=f"of {outside} splats"):
        data = written(cloud, sh0_codebook="base-rgb")

    assert meta_of(data)["streams"]["sh"]["sh0Codebook"][255] == pytest.approx(1.7724539)


def test_meta__is_short_text_that_reads_back() -> None:
    data = zipfile.ZipFile(io.BytesIO(written(random_cloud(60)))).read("meta.json")

    assert b" " not in data.replace(b'"gsplat_tools ', b"")
    assert b"null" not in data
    streams = json.loads(data)["streams"]
    assert all(set(vector) == {"x", "y", "z"} for vector in streams["position"]["rangeMin"] + streams["scale"]["codebook"])


def test_archive__is_dated_sorted_and_packed_by_kind() -> None:
    entries = zipfile.ZipFile(io.BytesIO(written(random_cloud(50)))).infolist()

    assert [entry.filename for entry in entries] == sorted(entry.filename for entry in entries)
    assert {entry.date_time for entry in entries} == {(1980, 1, 1, 0, 0, 0)}
    stored = {entry.filename.rsplit(".", 1)[1] for entry in entries if entry.compress_type == zipfile.ZIP_STORED}
    assert stored == {"webp"}


@pytest.mark.parametrize(("mode", "method"), [("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED)])
def test_zip__packs_all_alike_when_asked(mode: Any, method: int) -> None:
    entries = zipfile.ZipFile(io.BytesIO(written(random_cloud(20), zip=mode))).infolist()

    assert {entry.compress_type for entry in entries} == {method}


def test_bytes__do_not_depend_on_threads() -> None:
    cloud = random_cloud(40_000, sh_degree=1)
    options = {"sh_palette_size": 300, "scale_codebook_size": 300, "palette_rounds": 1}
    results = []
    for jobs in (1, 3):
        with use_jobs(jobs):
            results.append(written(cloud, **options))

    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("count", "options", "layout"),
    [(10, {}, (4, 3)), (10, {"width": 5}, (5, 2)), (10, {"height": 10}, (1, 10)), (7, {"width": 8, "height": 8}, (8, 8))],
)
def test_layout__is_as_asked_or_nearly_square(count: int, options: Any, layout: tuple[int, int]) -> None:
    data = written(random_cloud(count, sh_degree=0), **options)

    assert (meta_of(data)["layout"]["width"], meta_of(data)["layout"]["height"]) == layout
    assert len(decoded(data)) == count


def test_refusals__say_why() -> None:
    cloud = random_cloud(10)
    for scene, options, error, words in (
        (cloud.take(slice(0, 0)), {}, CapabilityError, "at least one splat"),
        (random_cloud(5, sh_degree=4), {}, CapabilityError, "up to 3"),
        (cloud, {"width": 2, "height": 2}, CapabilityError, "does not hold 10"),
        (cloud, {"frame_times": [0.0, 1.0]}, CapabilityError, "one time a frame"),
        (cloud, {"frame_times": [2.0]}, CapabilityError, r"in \[0, 1\]"),
        (cloud.replace(means=np.full((10, 3), np.nan)), {}, CloudError, "means, frame 0: 10 of 10"),
        (cloud.replace(log_scales=np.full((10, 3), 90.0)), {}, CloudError, "beyond float32"),
        (cloud.replace(opacity_logits=np.full(10, np.nan)), {}, CloudError, "NaN"),
    ):
        with pytest.raises(error, match=words):
            written(scene, **options)


@pytest.mark.parametrize(
    "options",
    [{"version": 3}, {"labels": "delta"}, {"sh_palette_size": 65536}, {"webp_effort": 10}, {"keep_tolerance": 2}, {"width": 0}],
)
def test_options__are_checked(options: Any) -> None:
    with pytest.raises(CapabilityError, match=next(iter(options))):
        Sog4dOptions(**options)


def test_scales_halfway_between_two_entries__keep_their_bound() -> None:
    from gsplat_tools.codecs.palette import nearest_labels
    from gsplat_tools.formats.sog4d.codebooks import points_of, scale_coordinates, scales_at

    rng = np.random.default_rng(0)
    codebook = -np.sort(-np.exp(rng.uniform(-7, -1, (400, 3))), axis=1).astype(np.float32)
    pairs = points_of(codebook)[rng.integers(0, len(codebook), (2, 100_000))].astype(np.float64)
    log_scales = np.log(scales_at(pairs.mean(axis=0).astype(np.float32)))
    labels = nearest_labels(scale_coordinates(log_scales), points_of(codebook))[0]
    axes = np.tile(np.arange(3), (len(labels), 1))

    least, largest = scale_reach(log_scales, codebook, labels, axes, is_first=True)

    stored = np.log(codebook.astype(np.float64))[labels]
    assert ((least <= stored) & (stored <= largest)).all()


def test_zeros_of_both_signs__give_one_range() -> None:
    cloud = random_cloud(50, sh_degree=0)
    means = np.abs(cloud.means)
    means[:, 1] = 0
    texts = []
    for sign in (1, -1):
        means[:25, 1] *= np.float32(sign)
        texts.append(written(cloud.replace(means=means.copy())))
    assert texts[0] == texts[1]


@pytest.mark.parametrize("values", [[0.0] * 100, list(range(100)), [5.0, 1.0, 5.0, 5.0, 2.0] * 30, [-np.inf] * 60 + [1.0]])
def test_long_splats__are_the_first_of_the_longest(values: list[float]) -> None:
    from gsplat_tools.formats.sog4d.codebooks import LONG_SHARE, longest

    lengths = np.array(values)
    order = np.argsort(-lengths, kind="stable")[: int(np.ceil(LONG_SHARE * len(lengths)))]
    assert np.flatnonzero(longest(lengths)).tolist() == sorted(order)
