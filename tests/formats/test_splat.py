import io
import struct
import warnings

import numpy as np
import pytest

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning, TruncatedDataError, UnknownFormatError
from gsplat_tools.formats import load, save, splat
from gsplat_tools.formats.splat import SplatOptions
from tests.clouds import random_cloud

C0 = 0.28209479177387814


def record(mean=(1.0, -2.0, 0.5), scale=(1.0, 0.5, 0.0), rgba=(0, 255, 51, 128), quat=(255, 128, 128, 0)):
    """One splat as the format's own converter lays it out."""
    return struct.pack("<6f8B", *mean, *scale, *rgba, *quat)


def read(data):
    return splat.read(io.BytesIO(data))


def write(cloud, **options):
    stream = io.BytesIO()
    splat.write(cloud, stream, SplatOptions(**options))
    return stream.getvalue()


def single(**changes):
    fields = {
        "means": [[1.0, -2.0, 0.5]],
        "log_scales": [[0.0, np.log(0.5), -np.inf]],
        "quats": [[1.0, 0.0, 0.0, 0.0]],
        "opacity_logits": [np.log(128 / 127)],
        "sh0": [[-0.5 / C0, 0.5 / C0, -0.3 / C0]],
        "shN": np.zeros((1, 0, 3)),
    }
    return GaussianCloud(**(fields | changes))


def test_record__is_read_as_the_format_says():
    cloud = read(record() + record(rgba=(128, 128, 128, 255), quat=(128, 128, 128, 128)))

    np.testing.assert_array_equal(cloud.means[0], [1, -2, 0.5])
    np.testing.assert_allclose(cloud.log_scales[0], [0, np.log(0.5), -np.inf], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh0[0], np.array([-0.5, 0.5, -0.3]) / C0, rtol=1e-6)
    np.testing.assert_allclose(cloud.opacity_logits, [np.log(128 / 127), np.inf], rtol=1e-5)
    direction = np.array([127, 0, 0, -128]) / np.hypot(127, 128)
    np.testing.assert_allclose(cloud.quats, [direction, [1, 0, 0, 0]], atol=1e-6)
    assert cloud.sh_degree == 0
    assert cloud.coordinate_system == "unknown"


def test_record__is_written_as_the_format_says():
    assert write(single(), rotation="reference") == record(quat=(255, 128, 128, 128))


@pytest.mark.parametrize("size", [0, 1, 31, 33, 63])
def test_length_that_is_no_multiple_of_32__is_refused(size):
    for function in (splat.read, splat.read_chunks, splat.inspect):
        with pytest.raises(TruncatedDataError, match="records of 32 bytes"):
            function(io.BytesIO(bytes(size)))


def test_name_alone__tells_the_format(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(record() * 3)
    assert len(load(path)) == 3

    other = tmp_path / "a.bin"
    other.write_bytes(record() * 3)
    with pytest.raises(UnknownFormatError):
        load(other)


def test_round_trip__is_exact_in_positions_and_within_half_a_step_elsewhere():
    cloud = random_cloud(500, sh_degree=0).replace(sh0=np.random.default_rng(1).uniform(-1.7, 1.7, (500, 3)))
    decoded = read(write(cloud))

    np.testing.assert_array_equal(decoded.means, cloud.means)
    np.testing.assert_allclose(np.sort(decoded.log_scales), np.sort(cloud.log_scales), atol=1e-6)
    assert np.abs(decoded.sh0 - cloud.sh0).max() <= 0.5 / 255 / C0 + 1e-6


def test_order__is_kept():
    cloud = random_cloud(100, sh_degree=0)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LossyConversionWarning)
        np.testing.assert_array_equal(read(write(cloud)).means, cloud.means)


def test_best_rotation__errs_less_than_the_reference():
    from tests.oracles.smallest_three import covariance

    cloud = random_cloud(400, sh_degree=0).replace(sh0=np.zeros((400, 3)))
    errors = {}
    for rotation in ("reference", "best", "small"):
        decoded = read(write(cloud, rotation=rotation))
        pairs = zip(cloud.quats, cloud.log_scales, decoded.quats, decoded.log_scales, strict=True)
        errors[rotation] = np.mean(
            [np.linalg.norm(covariance(c, d) - covariance(a, b)) / np.linalg.norm(covariance(a, b)) for a, b, c, d in pairs]
        )

    assert errors["best"] < 0.3 * errors["reference"]
    assert errors["small"] < 0.6 * errors["reference"]


def test_clamped_values__are_counted():
    cloud = single(sh0=[[9.0, -9.0, 0.0]], log_scales=[[200.0, -200.0, 0.0]])

    with pytest.warns(LossyConversionWarning, match=r"2 color channels .* 2 scale axes") as caught:
        decoded = read(write(cloud))

    assert caught[0].message.code == "clamped"
    assert np.isfinite(decoded.log_scales).all()


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh0"])
def test_values_that_are_no_numbers__are_refused(name):
    with pytest.raises(CloudError):
        write(single(**{name: np.full_like(getattr(single(), name), np.nan)}))


def test_chunks__give_the_bytes_of_the_whole():
    cloud = random_cloud(1000, sh_degree=0).replace(sh0=np.zeros((1000, 3)))
    pieces = CloudChunks(1000, cloud.take(slice(0, 0)), lambda: (cloud.take(slice(s, s + 137)) for s in range(0, 1000, 137)))

    assert write(pieces) == write(cloud)


def test_sh_bands__are_dropped_with_a_warning(tmp_path):
    cloud = random_cloud(10, sh_degree=2).replace(sh0=np.zeros((10, 3)))

    with pytest.warns(LossyConversionWarning, match="SH band"):
        save(cloud, tmp_path / "a.splat")
    assert load(tmp_path / "a.splat").sh_degree == 0


def test_empty_cloud__is_refused(tmp_path):
    with pytest.raises(CapabilityError, match="at least 1"):
        save(random_cloud(0), tmp_path / "a.splat")
