import io
import struct
import warnings
import zlib

import numpy as np
import pytest
import zstandard

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, GsplatWarning, LossyConversionWarning
from gsplat_tools.formats import load, save, spz
from gsplat_tools.formats.spz import SpzOptions
from tests.clouds import random_cloud

every_version = pytest.mark.parametrize("version", [2, 3, 4])


def mild_cloud(count, sh_degree=0, seed=0, **changes):
    """Splats that every field holds without clamping."""
    rng = np.random.default_rng(seed)
    cloud = random_cloud(count, sh_degree=sh_degree, seed=seed)
    return cloud.replace(
        log_scales=rng.uniform(-7, -1, (count, 3)),
        sh0=np.clip(cloud.sh0, -3, 3),
        shN=np.clip(cloud.shN, -0.95, 0.95),
        **changes,
    )


def write(cloud, **options):
    stream = io.BytesIO()
    spz.write(cloud, stream, SpzOptions(**options))
    return stream.getvalue()


def read(data):
    return spz.read(io.BytesIO(data))


def streams_of(data):
    """Attributes of a version 4 file, taken apart by hand."""
    number, toc = data[15], struct.unpack_from("<I", data, 16)[0]
    places = [struct.unpack_from("<QQ", data, toc + 16 * i) for i in range(number)]
    position, found = toc + 16 * number, []
    for stored, raw in places:
        found.append(zstandard.ZstdDecompressor().decompress(data[position : position + stored]))
        assert len(found[-1]) == raw
        position += stored
    assert position == len(data)
    return found


def single(**changes):
    fields = {
        "means": [[1.0, -0.5, 0.0]],
        "log_scales": [[-10.0, 5.9375, 0.0]],
        "quats": [[1.0, 0.0, 0.0, 0.0]],
        "opacity_logits": [0.0],
        "sh0": [[-0.5 / 0.15, 0.5 / 0.15, 0.0]],
        "shN": np.zeros((1, 0, 3)),
    }
    return GaussianCloud(**(fields | changes))


def test_bytes__are_those_of_the_specification():
    positions, alphas, colors, scales, rotations = streams_of(write(single(), fractional_bits=12, rotation="reference"))

    assert positions == bytes([0, 16, 0, 0, 248, 255, 0, 0, 0])
    assert alphas == bytes([128])
    assert colors == bytes([0, 255, 128])
    assert scales == bytes([0, 255, 160])
    assert rotations == struct.pack("<I", 3 << 30)


def test_header__is_that_of_the_specification():
    data = write(mild_cloud(5, sh_degree=2).replace(splat_model="antialiased"), fractional_bits=14)

    assert data[:16] == struct.pack("<4sIIBBBB", b"NGSP", 4, 5, 2, 14, 1, 6)
    assert data[16:32] == struct.pack("<I12s", 32, bytes(12))


@pytest.mark.parametrize("version", [2, 3])
def test_old_versions__are_one_gzip_stream_without_a_time(version):
    data = write(mild_cloud(5, sh_degree=1), version=version, fractional_bits=12)
    raw = zlib.decompress(data, 31)

    assert data[4:8] == bytes(4)
    assert raw[:16] == struct.pack("<4sIIBBBB", b"NGSP", version, 5, 1, 12, 0, 0)
    assert len(raw) == 16 + 5 * (9 + 1 + 3 + 3 + (3 if version == 2 else 4) + 9)


@every_version
@pytest.mark.parametrize("rotation", ["reference", "best", "small"])
def test_round_trip__is_within_half_a_step(version, rotation):
    cloud = mild_cloud(500, sh_degree=3)
    decoded = read(write(cloud, version=version, rotation=rotation, fractional_bits=12))

    assert np.abs(decoded.means - cloud.means).max() <= 0.5 / 4096
    assert np.abs(np.sort(decoded.log_scales) - np.sort(cloud.log_scales)).max() <= 1 / 32 + 1e-6
    assert np.abs(decoded.sh0 - cloud.sh0).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert np.abs(decoded.shN[:, :3] - cloud.shN[:, :3]).max() <= 4 / 128 + 1e-6
    assert np.abs(decoded.shN[:, 3:] - cloud.shN[:, 3:]).max() <= 8 / 128 + 1e-6


@pytest.mark.parametrize("bits", [1, 2, 5, 8])
def test_sh_bits__set_the_buckets(bits):
    cloud = mild_cloud(300, sh_degree=2)
    data = write(cloud, sh1_bits=bits, sh_rest_bits=bits)
    codes = np.frombuffer(streams_of(data)[5], np.uint8)
    bucket = 1 << (8 - bits)

    assert set(codes[codes != 255] % bucket) == {0}
    assert np.abs(read(data).shN - cloud.shN).max() <= bucket / 2 / 128 + 1e-6


def test_sh_of_zero__stays_zero_whatever_the_bits():
    cloud = mild_cloud(4, sh_degree=3).replace(shN=np.zeros((4, 15, 3)))

    for bits in range(1, 9):
        assert not read(write(cloud, sh1_bits=bits, sh_rest_bits=bits)).shN.any()


@pytest.mark.parametrize(
    ("extent", "log_scale", "expected"),
    [
        (1.0, 0.0, 12),
        (2000.0, -3.0, 12),
        (2047.9, -3.0, 12),
        (2049.0, -3.0, 11),
        (1e6, 0.0, 3),
        (1.0, -9.0, 17),
        (0.0, -6.0, 13),
    ],
)
def test_fractional_bits__follow_range_and_size_of_splats(extent, log_scale, expected):
    cloud = single(means=[[extent, -extent, 0.0]], log_scales=[[log_scale] * 3])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        data = write(cloud)

    assert data[13] == expected
    assert np.abs(read(data).means - cloud.means).max() <= 0.5 ** (expected + 1)


def test_coarse_steps__are_warned_about():
    with pytest.warns(GsplatWarning, match="recenter on") as caught:
        write(single(means=[[5000.0, 0, 0]]))
    assert caught[0].message.code == "position-step"


def test_finest__uses_every_bit_and_never_wraps():
    for extent in (0.3, 0.9999, 1.0, 1.0001, 77.0, 8e6):
        cloud = single(means=[[extent, -extent, extent / 3]])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GsplatWarning)
            data = write(cloud, fractional_bits="finest")
        assert np.abs(read(data).means - cloud.means).max() <= 0.5 ** (data[13] + 1)
        assert data[13] == 23 or extent * 2.0 ** (data[13] + 1) > 8388606


@every_version
def test_positions_out_of_range__are_an_error_with_count_and_remedy(version):
    cloud = mild_cloud(10)
    means = cloud.means.copy()
    means[[2, 5]] = 1e9

    with pytest.raises(CapabilityError, match=r"2 of 10 splats .* --recenter on") as caught:
        write(cloud.replace(means=means), version=version)
    assert caught.value.field == "means"
    with pytest.raises(CapabilityError, match="2 of 10"):
        write(cloud.replace(means=np.where(means > 1e8, 3000, means)), version=version, fractional_bits=12)


def test_clamped_values__are_counted():
    cloud = single(log_scales=[[-11.0, 7.0, -np.inf]], sh0=[[9.0, -9.0, 0.0]], shN=[[[1.5, -1.5, 0]] + [[0, 0, 0]] * 2])

    with pytest.warns(LossyConversionWarning, match=r"3 scale axes .* 2 color channels .* 2 SH values") as caught:
        data = write(cloud, rotation="reference")
    assert caught[0].message.code == "clamped"
    decoded = read(data)
    np.testing.assert_array_equal(decoded.log_scales, [[-10, 5.9375, -10]])
    np.testing.assert_array_equal(decoded.shN[0, 0], np.array([127 / 128, -1, 0], np.float32))


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh0", "shN"])
def test_values_that_are_no_numbers__are_refused(name):
    cloud = mild_cloud(5, sh_degree=1)
    values = getattr(cloud, name).copy()
    values.reshape(-1)[3] = np.nan

    with pytest.raises(CloudError):
        write(cloud.replace(**{name: values}))


@every_version
@pytest.mark.parametrize("system", ["RUB", "RDF", "RUF", "LUF", "RFU", "LBD"])
def test_known_axes__are_written_and_come_back(version, system):
    cloud = mild_cloud(3, sh_degree=1, coordinate_system=system)

    decoded = read(write(cloud, version=version))

    assert decoded.coordinate_system == system
    assert np.abs(decoded.means - cloud.means).max() <= 0.5 / 4096  # stored in the axes that they are in


def test_axes_without_a_number__are_refused():
    with pytest.raises(CapabilityError, match="target-coordinates RUB"):
        write(mild_cloud(3, coordinate_system="FUR"))


def test_unknown_axes__write_no_extension():
    assert write(mild_cloud(3))[14] == 0


def test_degree_4__needs_version_3():
    with pytest.raises(CapabilityError, match="degree 3 at most"):
        write(mild_cloud(3, sh_degree=4), version=2)
    assert read(write(mild_cloud(3, sh_degree=4), version=3)).sh_degree == 4


@pytest.mark.parametrize("options", [{"version": 1}, {"version": 5}])
def test_versions_that_are_not_written__are_refused(options):
    with pytest.raises(CapabilityError, match="version 2, 3 or 4"):
        write(mild_cloud(1), **options)


@pytest.mark.parametrize(
    "options", [{"sh1_bits": 0}, {"sh_rest_bits": 9}, {"fractional_bits": 24}, {"fractional_bits": "x"}, {"level": 0}]
)
def test_options_out_of_range__are_value_errors(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        write(mild_cloud(1), **options)


@every_version
def test_chunks__give_the_bytes_of_the_whole(version):
    cloud = mild_cloud(1000, sh_degree=1)
    pieces = CloudChunks(1000, cloud.take(slice(0, 0)), lambda: (cloud.take(slice(s, s + 137)) for s in range(0, 1000, 137)))

    assert write(pieces, version=version) == write(cloud, version=version)


@every_version
def test_chunks_that_hold_other_than_announced__are_refused(version):
    cloud = mild_cloud(10)
    pieces = CloudChunks(11, cloud.take(slice(0, 0)), lambda: iter([cloud]))

    with pytest.raises(CloudError, match="announced 11"):
        write(pieces, version=version)


def test_flat_splats__lose_their_model_with_a_warning():
    with pytest.warns(LossyConversionWarning) as caught:
        write(mild_cloud(3).replace(splat_model="2dgs"))
    assert caught[0].message.code == "dropped-splat-model"


def test_small_frames__make_files_smaller_than_reference_frames():
    cloud = mild_cloud(20_000)

    assert len(write(cloud, rotation="small")) < len(write(cloud, rotation="reference"))


def test_presets__trade_size_for_accuracy(tmp_path):
    cloud = mild_cloud(2000, sh_degree=2)
    errors, sizes = {}, {}
    for preset in ("fast", "balanced", "best"):
        path = tmp_path / f"{preset}.spz"
        sizes[preset] = save(cloud, path, preset=preset, order="none").bytes
        errors[preset] = np.abs(load(path).shN - cloud.shN).mean()

    assert sizes["balanced"] < 0.8 * sizes["best"]
    assert errors["best"] < 0.2 * errors["balanced"]


@every_version
def test_second_trip__changes_no_byte(version):
    first = read(write(mild_cloud(200, sh_degree=2), version=version, rotation="reference", fractional_bits=12))
    data = write(first, version=version, rotation="reference", fractional_bits=12)
    again = write(read(data), version=version, rotation="reference", fractional_bits=12)

    assert again == data
