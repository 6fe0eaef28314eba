"""What the writer puts into a bundle, taken out again with json, zipfile and Pillow."""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import attribute_errors
from gsplat_tools.errors import CapabilityError, CloudError, GsplatWarning, LossyConversionWarning
from gsplat_tools.formats.sog import FORMAT, SogOptions, SogReadOptions, read, write
from gsplat_tools.formats.sog.codebooks import choose_palette_size, largest_palette_size
from tests.clouds import random_cloud


def written(cloud: GaussianCloud, **options: Any) -> bytes:
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        write(cloud, stream, SogOptions(**options))
    return stream.getvalue()


def parts(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return meta.json and the images of a bundle."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        images = {
            name.removesuffix(".webp"): np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA"))
            for name in archive.namelist()
            if name.endswith(".webp")
        }
        return json.loads(archive.read("meta.json")), images


def round_trip(cloud: GaussianCloud, **options: Any) -> GaussianCloud:
    return read(io.BytesIO(written(cloud, **options)), SogReadOptions())


def test_archive__holds_the_entries_in_order_stored_and_without_the_time() -> None:
    data = written(random_cloud(30, sh_degree=1))

    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
    assert [entry.filename for entry in entries] == [
        "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp", "shN_centroids.webp", "shN_labels.webp",
        "meta.json",
    ]  # fmt: skip
    assert {entry.compress_type for entry in entries} == {zipfile.ZIP_STORED}
    assert {entry.date_time for entry in entries} == {(1980, 1, 1, 0, 0, 0)}
    assert data == written(random_cloud(30, sh_degree=1))


@pytest.mark.parametrize(("count", "size"), [(1, (4, 4)), (16, (4, 4)), (17, (8, 4)), (33, (8, 8)), (65, (12, 8))])
def test_images__are_multiples_of_four_and_empty_beyond_the_splats(count: int, size: tuple[int, int]) -> None:
    _, images = parts(written(random_cloud(count, sh_degree=1)))

    for name, image in images.items():
        if name == "shN_centroids":
            continue
        assert image.shape[1::-1] == size, name
        assert not image.reshape(-1, 4)[count:].any(), name
    assert (images["means_l"].reshape(-1, 4)[:count, 3] == 255).all()


def test_positions__are_rounded_in_the_logarithm() -> None:
    cloud = random_cloud(500, sh_degree=0)

    meta, images = parts(written(cloud))

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    n = np.sign(cloud.means) * np.log(np.abs(cloud.means.astype(np.float64)) + 1)
    np.testing.assert_allclose([low, high], [n.min(axis=0), n.max(axis=0)], rtol=1e-12)
    codes = images["means_l"].reshape(-1, 4)[:500, :3] + 256.0 * images["means_u"].reshape(-1, 4)[:500, :3]
    errors = codes - (n - low) / (high - low) * 65535
    assert np.abs(errors).max() <= 0.5 + 1e-9
    assert abs(errors.mean()) < 0.03  # the existing writer truncates: -0.5


def test_opacity__is_rounded_and_colors_survive_where_it_is_zero() -> None:
    opacities = np.array([0.4, 0.6, 127.4, 127.6, 254.4, 254.6, 0.0]) / 255
    with np.errstate(divide="ignore"):
        logits = np.log(opacities / (1 - opacities))
    cloud = random_cloud(7, sh_degree=0).replace(opacity_logits=logits)

    decoded = round_trip(cloud)

    _, images = parts(written(cloud))
    assert images["sh0"].reshape(-1, 4)[:7, 3].tolist() == [0, 1, 127, 128, 254, 255, 0]
    np.testing.assert_allclose(decoded.sh0, cloud.sh0, atol=1e-6)  # 21 values fit the codebook


@pytest.mark.parametrize(
    ("model", "tags"),
    [("default", {}), ("antialiased", {"model": "antialiased", "antialias": True}), ("2dgs", {"model": "2dgs"})],
)
def test_splat_model__is_written_in_both_spellings(model: Any, tags: dict[str, Any]) -> None:
    cloud = random_cloud(4, sh_degree=0).replace(splat_model=model)

    meta, _ = parts(written(cloud))

    assert {key: meta[key] for key in ("model", "antialias") if key in meta} == tags
    assert round_trip(cloud).splat_model == model


def test_codebooks__span_the_data_and_come_back_as_float32() -> None:
    cloud = random_cloud(2000, sh_degree=0)

    meta, _ = parts(written(cloud, rotation="reference"))

    for name, values in (("scales", cloud.log_scales), ("sh0", cloud.sh0)):
        codebook = np.array(meta[name]["codebook"])
        assert len(codebook) == 256
        assert (np.diff(codebook) >= 0).all()
        assert codebook[0].astype(np.float32) == values.min()
        assert codebook[-1].astype(np.float32) == values.max()


def test_flat_axes__get_an_entry_of_their_own() -> None:
    cloud = random_cloud(400, sh_degree=0)
    log_scales = cloud.log_scales.copy()
    log_scales[::7, 1] = -np.inf
    flat = cloud.replace(log_scales=log_scales)

    with pytest.warns(LossyConversionWarning, match="58 flat splats"):
        write(flat, io.BytesIO(), SogOptions())

    decoded = round_trip(flat, rotation="reference")
    finite = log_scales[np.isfinite(log_scales)]
    assert decoded.log_scales[::7, 1] == pytest.approx(finite.min() - 20)
    assert np.abs(decoded.log_scales - log_scales)[np.isfinite(log_scales)].max() < 0.3


def test_nothing_but_flat_axes__is_written() -> None:
    cloud = random_cloud(5, sh_degree=0).replace(log_scales=np.full((5, 3), -np.inf, np.float32))

    assert (round_trip(cloud).log_scales == -20).all()


@pytest.mark.parametrize("rotation", ["best", "small", "reference"])
def test_rotation_frames__keep_the_covariances(rotation: Any) -> None:
    cloud = random_cloud(1500, sh_degree=0)
    data = written(cloud, rotation=rotation)

    errors = attribute_errors(cloud, read(io.BytesIO(data), SogReadOptions()))["covariances"]

    assert FORMAT.bounds is not None
    bound = FORMAT.bounds(cloud, io.BytesIO(data), 0)["covariances"]
    assert (errors <= bound + 1e-5).all()
    assert bound.max() < 0.2


def test_best_rotation__errs_less_than_the_others() -> None:
    cloud = random_cloud(1500, sh_degree=0)
    cloud = cloud.replace(log_scales=np.rint(cloud.log_scales * 10) / 10)  # few enough to be exact

    errors = {
        rotation: np.sqrt(np.square(attribute_errors(cloud, round_trip(cloud, rotation=rotation))["covariances"]).mean())
        for rotation in ("best", "small", "reference")
    }

    assert errors["best"] < 0.75 * errors["small"]
    assert errors["best"] < 0.6 * errors["reference"]


def test_labels__name_the_nearest_entry_as_stored() -> None:
    cloud = random_cloud(900, sh_degree=2)

    meta, images = parts(written(cloud, sh_palette_size=90))

    codebook = np.array(meta["shN"]["codebook"])
    count = meta["shN"]["count"]
    assert images["shN_centroids"].shape == (math.ceil(count / 64), 64 * 8, 4)
    entries = codebook[images["shN_centroids"].reshape(-1, 8, 4)[:count, :, :3]].reshape(count, -1)
    pixels = images["shN_labels"].reshape(-1, 4)[:900].astype(np.int64)
    labels = pixels[:, 0] + 256 * pixels[:, 1]
    distances = np.square(cloud.shN.reshape(900, 1, -1) - entries[None]).sum(axis=2)
    np.testing.assert_allclose(distances[np.arange(900), labels], distances.min(axis=1), rtol=1e-4)
    assert count <= 90
    assert len(np.unique(entries, axis=0)) == count
    assert len(np.unique(labels)) == count


def test_palette__is_exact_where_it_holds_every_row() -> None:
    rng = np.random.default_rng(4)
    rows = (rng.integers(-100, 100, (20, 3, 3)) / 128).astype(np.float32)
    cloud = random_cloud(300, sh_degree=1).replace(shN=rows[rng.integers(0, 20, 300)])

    np.testing.assert_array_equal(round_trip(cloud, sh_palette_size=64).shN, cloud.shN)


def test_palette_size__follows_what_the_eye_can_tell() -> None:
    cloud = random_cloud(8000, sh_degree=1)
    rows, weights = cloud.shN.reshape(8000, -1), np.ones(8000, np.float32)

    rich = choose_palette_size(rows, weights)
    poor = choose_palette_size(rows * np.float32(0.05), weights)

    assert rich == largest_palette_size(8000) == 4096
    assert poor < 1000
    assert largest_palette_size(100) == 512
    assert largest_palette_size(10**6) == 16384


def test_values_that_are_not_finite__are_refused() -> None:
    cloud = random_cloud(3, sh_degree=1)
    for name in ("means", "quats", "sh0", "shN", "log_scales", "opacity_logits"):
        values = getattr(cloud, name).copy()
        values.flat[0] = np.nan
        with pytest.raises(CloudError, match="1 of 3"):
            write(cloud.replace(**{name: values}), io.BytesIO(), SogOptions())


def test_scenes_that_do_not_fit__are_refused() -> None:
    with pytest.raises(CapabilityError, match="1 to"):
        write(random_cloud(0, sh_degree=0), io.BytesIO(), SogOptions())
    with pytest.raises(CapabilityError, match="up to 3"):
        write(random_cloud(2, sh_degree=4), io.BytesIO(), SogOptions())


@pytest.mark.parametrize(
    "options", [{"sh_palette_size": 0}, {"sh_palette_size": 65537}, {"webp_effort": 10}, {"rotation": "none"}]
)
def test_options__are_checked(options: dict[str, Any]) -> None:
    with pytest.raises(CapabilityError):
        SogOptions(**options)


def test_far_positions__come_back_finite() -> None:
    largest = np.finfo(np.float32).max
    means = np.array([[largest, -largest, 0], [-largest, 1e-30, 5], [0, 0, 5]], np.float32)
    cloud = random_cloud(3, sh_degree=0).replace(means=means)

    decoded = round_trip(cloud)

    assert np.isfinite(decoded.means).all()
    np.testing.assert_allclose(decoded.means[[0, 1], [0, 0]], [largest, -largest], rtol=1e-6)
