import io
import struct
import warnings

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import (
    CloudError,
    CorruptDataError,
    FormatError,
    GsplatError,
    LossyConversionWarning,
    TruncatedDataError,
    UnsupportedVersionError,
)
from gsplat_tools.formats import compressed_ply, load, ply, save
from gsplat_tools.formats.compressed_ply import CompressedPlyOptions
from tests.builders import PlyElement, ply_file
from tests.clouds import random_cloud
from tests.oracles import smallest_three as oracle

C0 = 0.28209479177387814
BOX = {
    "min_x": -1.0, "min_y": 2.0, "min_z": 0.0, "max_x": 1.0, "max_y": 3.0, "max_z": 8.0,
    "min_scale_x": -8.0, "min_scale_y": -6.0, "min_scale_z": -4.0,
    "max_scale_x": -1.0, "max_scale_y": -2.0, "max_scale_z": -3.0,
    "min_r": 0.0, "min_g": -1.0, "min_b": 0.5, "max_r": 1.0, "max_g": 2.0, "max_b": 0.5,
}  # fmt: skip
WORDS = {
    "packed_position": [2047 << 21 | 0 << 11 | 1024],
    "packed_rotation": [1 << 30 | 1023 << 20 | 512 << 10 | 0],
    "packed_scale": [0 << 21 | 1023 << 11 | 2047],
    "packed_color": [255 << 24 | 51 << 16 | 7 << 8 | 128],
}


def elements(count=1, *, box=None, words=None, sh=0, chunk_count=None, kinds=("float", "uint", "uchar")):
    box, words = BOX if box is None else box, WORDS if words is None else words
    boxes = -(-count // 256) if chunk_count is None else chunk_count
    rng = np.random.default_rng(0)
    parts = [
        PlyElement("chunk", {name: (kinds[0], [value] * boxes) for name, value in box.items()}),
        PlyElement("vertex", {name: (kinds[1], values * count) for name, values in words.items()}),
    ]
    if sh:
        parts.append(PlyElement("sh", {f"f_rest_{i}": (kinds[2], rng.integers(0, 256, count).tolist()) for i in range(sh)}))
    return parts


def read(data):
    return compressed_ply.read(io.BytesIO(data))


def write(cloud, **options):
    stream = io.BytesIO()
    compressed_ply.write(cloud, stream, CompressedPlyOptions(**options))
    return stream.getvalue()


def mild_cloud(count, sh_degree=0, **changes):
    return random_cloud(count, sh_degree=sh_degree).replace(**changes)


def test_values__are_what_the_specification_says():
    cloud = read(ply_file(*elements()))

    np.testing.assert_allclose(cloud.means, [[1, 2, 8 * 1024 / 2047]], rtol=1e-6)
    np.testing.assert_allclose(cloud.log_scales, [[-8, -2, -3]])
    np.testing.assert_allclose(cloud.sh0, [[0.5 / C0, (-1 + 3 * 0.2 - 0.5) / C0, 0]], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(cloud.opacity_logits, [np.log(128 / 127)], rtol=1e-5)
    np.testing.assert_allclose(cloud.quats, [oracle.unpack_unsigned(WORDS["packed_rotation"][0])], atol=1.2e-7)


def test_old_files_without_colors_in_the_box__are_read():
    box = {name: value for name, value in BOX.items() if name[-1] not in "rgb"}

    cloud = read(ply_file(*elements(box=box)))

    np.testing.assert_allclose(cloud.sh0, [[0.5 / C0, (0.2 - 0.5) / C0, (7 / 255 - 0.5) / C0]], rtol=1e-6)


def test_every_byte_of_opacity_and_sh__decodes_as_the_specification_says():
    words = dict(WORDS)
    words["packed_color"] = list(range(256))
    words = {name: values * (256 // len(values)) for name, values in words.items()}
    parts = elements(words={name: values[:1] for name, values in words.items()}, count=256)
    parts[1] = PlyElement("vertex", {name: ("uint", values) for name, values in words.items()})
    parts.append(PlyElement("sh", {f"f_rest_{i}": ("uchar", list(range(256))) for i in range(9)}))

    cloud = read(ply_file(*parts))

    codes = np.arange(256.0)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(cloud.opacity_logits, -np.log(1 / (codes / 255) - 1), rtol=1e-5, atol=1e-6)
    values = 8 * ((codes + 0.5) / 256 - 0.5)
    values[[0, 255]] = -4, 4
    np.testing.assert_array_equal(cloud.shN[:, 2, 1], values.astype(np.float32))


def test_sh__is_channel_major():
    parts = elements(sh=9)
    parts[2] = PlyElement("sh", {f"f_rest_{i}": ("uchar", [10 * i + 1]) for i in range(9)})

    cloud = read(ply_file(*parts))

    expected = [[8 * ((10 * (3 * c + k) + 1.5) / 256 - 0.5) for c in range(3)] for k in range(3)]
    np.testing.assert_allclose(cloud.shN[0], expected, rtol=1e-6)


def test_each_block_of_256__has_its_own_box():
    parts = elements(count=600)
    lows = [float(i) for i in range(3)]
    parts[0] = PlyElement("chunk", {name: ("float", lows if name.endswith("_x") else [0.0] * 3) for name in BOX})

    cloud = read(ply_file(*parts))

    np.testing.assert_array_equal(cloud.means[:, 0], np.arange(600) // 256)
    np.testing.assert_array_equal(cloud.log_scales[:, 0], np.arange(600) // 256)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kinds", [("float", "uint", "uchar"), ("float32", "int", "uint8")])
def test_dialects__are_read_alike(encoding, kinds):
    words = {name: [values[0] if kinds[1] == "uint" else values[0] - (values[0] >> 31 << 32)] for name, values in WORDS.items()}

    cloud = read(ply_file(*elements(5, sh=24, words=words, kinds=kinds), encoding=encoding, newline=b"\r\n"))

    expected = read(ply_file(*elements(5, sh=24)))
    for name, values in expected.arrays().items():
        np.testing.assert_array_equal(getattr(cloud, name), values)


def test_order_of_elements_and_properties__does_not_matter():
    chunk, vertex, sh = elements(3, sh=9)
    chunk.columns = dict(reversed(chunk.columns.items()))
    vertex.columns = dict(reversed(vertex.columns.items()))

    cloud = read(ply_file(sh, vertex, chunk))

    np.testing.assert_array_equal(cloud.means, read(ply_file(*elements(3, sh=9))).means)


def test_comments__say_what_they_say_in_any_ply():
    comments = ["SplatRenderMode: mip", "coordinate_system RUF", "origin 1 2 3.5"]

    data = ply_file(*elements(), comments=comments)
    cloud, info = read(data), compressed_ply.inspect(io.BytesIO(data))

    assert cloud.splat_model == info.splat_model == "antialiased"
    assert cloud.coordinate_system == info.coordinate_system == "RUF"
    assert tuple(cloud.origin) == info.origin == (1, 2, 3.5)


def test_what_a_cloud_has_no_place_for__is_left_out_with_a_warning():
    chunk, vertex = elements()
    vertex.columns["id"] = ("int", [7])

    with pytest.warns(LossyConversionWarning, match=r"face \(1 rows\), vertex property id"):
        read(ply_file(chunk, vertex, PlyElement("face", {"a": ("int", [1])})))


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (elements(chunk_count=2), "1 splats have 1 chunks of 256, found 2"),
        (elements(300, chunk_count=1), "300 splats have 2 chunks of 256, found 1"),
        (elements(sh=10), "found 10"),
        (elements(box={name: value for name, value in BOX.items() if name != "max_y"}), "lacks max_y"),
        (elements(box={name: value for name, value in BOX.items() if name != "max_b"}), "lacks max_b"),
        (elements(words={name: value for name, value in WORDS.items() if "scale" not in name}), "lacks packed_scale"),
        (elements(kinds=("double", "uint", "uchar")), "expected float32, found float64"),
        (elements(kinds=("float", "float", "uchar")), "expected uint32, found float32"),
        (elements(sh=9, kinds=("float", "uint", "ushort")), "expected uint8, found uint16"),
        ([elements()[0]], "elements chunk and vertex, found chunk"),
    ],
)
def test_header_that_does_not_fit__is_refused(parts, words):
    with pytest.raises(CorruptDataError, match=words):
        read(ply_file(*parts))


def test_sh_rows_for_other_splats__are_refused():
    parts = elements(3, sh=9)
    parts[2] = elements(2, sh=9)[2]

    with pytest.raises(CorruptDataError, match="a row for each of 3 splats, found 2"):
        read(ply_file(*parts))


def test_sh_rows_without_properties__are_no_sh():
    plain = ply_file(*elements(3))

    cloud = read(plain.replace(b"end_header", b"element sh 3\nend_header"))

    assert cloud.sh_degree == 0
    for name, values in read(plain).arrays().items():
        np.testing.assert_array_equal(cloud.arrays()[name], values)


def test_text__is_refused():
    with pytest.raises(UnsupportedVersionError, match="binary"):
        read(ply_file(*elements(), encoding="ascii"))


def test_counts_beyond_the_file__are_refused_before_anything_is_allocated():
    data = ply_file(*elements()).replace(b"element chunk 1\n", b"element chunk 15625000\n")

    with pytest.raises(TruncatedDataError):
        read(data.replace(b"element vertex 1\n", b"element vertex 4000000000\n"))


def test_prefixes__are_refused():
    data = write(mild_cloud(300, sh_degree=1))

    for length in [*range(1300), *range(1300, len(data), 37)]:
        with pytest.raises(FormatError):
            read(data[:length])


def test_ply_and_compressed_ply__do_not_claim_each_other():
    packed, plain = write(mild_cloud(3))[:4096], io.BytesIO()
    ply.write(mild_cloud(3), plain)

    assert compressed_ply.matches(packed)
    assert not ply.FORMAT.matches(packed)
    assert not compressed_ply.matches(plain.getvalue()[:4096])


def test_written_words__are_those_of_the_specification():
    cloud = GaussianCloud(
        means=[[-1, 2, 0], [1, 3, 8], [0, 2.25, 2]], log_scales=[[-8, -6, -30], [-1, -2, 25], [-4.5, -3, 0]],
        quats=[[1, 0, 0, 0], [0, -2, 0, 0], [1, 1, 1, -1]], opacity_logits=[0, np.inf, -np.inf],
        sh0=np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.25, 0.5]]) / C0, shN=np.zeros((3, 0, 3)),
    )  # fmt: skip

    with pytest.warns(LossyConversionWarning, match="2 scale axes") as caught:
        data = write(cloud, rotation="reference")
    assert caught[0].message.code == "clamped"

    body = data[data.index(b"end_header\n") + 11 :]
    assert len(body) == 72 + 3 * 16
    box = struct.unpack("<18f", body[:72])
    assert box[:12] == (-1, 2, 0, 1, 3, 8, -8, -6, -20, -1, -2, 20)
    np.testing.assert_allclose(box[12:], [0.5] * 3 + [1.5] * 3, rtol=1e-6)
    words = np.frombuffer(body[72:], "<u4").reshape(3, 4)
    assert words[:, 0].tolist() == [0, 2047 << 21 | 1023 << 11 | 2047, 1024 << 21 | 256 << 11 | 512]
    assert words[:, 2].tolist() == [0, 2047 << 21 | 1023 << 11 | 2047, 1024 << 21 | 767 << 11 | 1024]
    assert words[:, 1].tolist() == [oracle.pack_unsigned(quat) for quat in cloud.quats]
    assert words[:, 3].tolist() == [128, 255 << 24 | 255 << 16 | 255 << 8 | 255, 128 << 24 | 64 << 16 | 128 << 8]


def test_sh__of_zeros_goes_up_and_down_in_turn():
    decoded = read(write(mild_cloud(512, sh_degree=2).replace(shN=np.zeros((512, 8, 3)))))

    np.testing.assert_array_equal(np.abs(decoded.shN), np.full((512, 8, 3), 1 / 64, np.float32))
    assert (decoded.shN.sum(axis=0) == 0).all()
    assert (decoded.shN.sum(axis=1) == 0).all()


def test_sh__is_stored_as_the_nearest_value_that_readers_know():
    values = np.linspace(-4.2, 4.2, 3 * 3001).reshape(3001, 1, 3)
    cloud = mild_cloud(3001, sh_degree=1).replace(shN=np.repeat(values, 3, axis=1))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LossyConversionWarning)
        decoded = read(write(cloud))

    known = np.array([-4, *[8 * ((code + 0.5) / 256 - 0.5) for code in range(1, 255)], 4])
    nearest = np.abs(known[:, None] - values.reshape(-1)).min(axis=0)
    np.testing.assert_allclose(np.abs(decoded.shN[:, 0].reshape(-1) - values.reshape(-1)), nearest, atol=2e-6)


def test_boxes_without_extent__give_back_their_value():
    cloud = mild_cloud(10).replace(means=np.full((10, 3), 0.1), log_scales=np.full((10, 3), -3.3), sh0=np.full((10, 3), 0.7))

    decoded = read(write(cloud, rotation="reference"))

    np.testing.assert_array_equal(decoded.means, cloud.means)
    np.testing.assert_array_equal(decoded.log_scales, cloud.log_scales)
    np.testing.assert_allclose(decoded.sh0, cloud.sh0, rtol=1e-6)


def test_narrow_boxes__are_divided_like_wide_ones():
    """The format's own encoder gives up below an extent of 1e-5."""
    means = 5e-6 * np.random.default_rng(0).random((200, 3)).astype(np.float32)

    decoded = read(write(mild_cloud(200).replace(means=means)))

    assert np.abs(decoded.means - means).max() <= 5e-6 / 2046 * 1.01


@pytest.mark.parametrize("count", [1, 255, 256, 257, 1000])
def test_last_block__may_be_short(count):
    cloud = mild_cloud(count)
    data = write(cloud)
    decoded = read(data)

    assert f"element chunk {-(-count // 256)}\n".encode() in data
    for start in range(0, count, 256):
        block = cloud.means[start : start + 256]
        error = np.abs(decoded.means[start : start + 256] - block).max(axis=0)
        assert (error <= np.ptp(block, axis=0) / [4094, 2046, 4094] * 1.001 + 1e-7).all()


def covariance_errors(cloud, decoded):
    pairs = zip(cloud.quats, cloud.log_scales, decoded.quats, decoded.log_scales, strict=True)
    sources = [(oracle.covariance(a, b), oracle.covariance(c, d)) for a, b, c, d in pairs]
    return np.array([np.linalg.norm(after - before) / np.linalg.norm(before) for before, after in sources])


def test_best_frames__err_less_than_the_reference():
    cloud = random_cloud(1024, sh_degree=0)
    cloud = cloud.replace(log_scales=np.random.default_rng(0).uniform(-8, -2, (1024, 3)))

    errors = {name: covariance_errors(cloud, read(write(cloud, rotation=name))) for name in ("reference", "best")}

    assert errors["best"].mean() < 0.85 * errors["reference"].mean()


def test_best_frames__keep_blocks_that_the_reference_holds_better():
    """What a file held before is on its grid; sorting the axes would move it."""
    first = read(write(random_cloud(512, sh_degree=0), rotation="reference"))

    again = read(write(first, rotation="best"))

    assert np.array_equal(again.log_scales, read(write(first, rotation="reference")).log_scales)


def test_estimated_errors__are_those_of_the_decoded_covariances():
    from gsplat_tools.kernels.compressed_ply import block_errors

    cloud = random_cloud(300, sh_degree=0, seed=5)
    cloud = cloud.replace(log_scales=np.clip(cloud.log_scales, -9, 0))
    estimated = np.empty(2)
    block_errors(cloud.quats, cloud.log_scales, estimated)

    squares = covariance_errors(cloud, read(write(cloud, rotation="reference"))) ** 2
    np.testing.assert_allclose(estimated, [squares[:256].sum(), squares[256:].sum()], rtol=0.05)


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh0", "shN"])
def test_values_that_are_no_numbers__are_refused(name):
    cloud = mild_cloud(5, sh_degree=1)
    values = getattr(cloud, name).copy()
    values.reshape(-1)[3] = np.nan

    with pytest.raises(CloudError):
        write(cloud.replace(**{name: values}))


def test_save__orders_splats_in_space_unless_told_not_to(tmp_path):
    cloud = mild_cloud(5000)
    spread = {}
    for order in ("none", None):
        path = tmp_path / "a.compressed.ply"
        save(cloud, path, overwrite=True, **({"order": order} if order else {}))
        decoded = load(path)
        spread[order] = np.abs(np.sort(decoded.means, axis=0) - np.sort(cloud.means, axis=0)).mean()

    assert spread[None] < 0.7 * spread["none"]


def test_extension__wins_over_the_shorter_one(tmp_path):
    save(mild_cloud(5), tmp_path / "a.compressed.ply")

    assert b"packed_position" in (tmp_path / "a.compressed.ply").read_bytes()


def test_metadata__comes_back():
    cloud = mild_cloud(4, coordinate_system="RDF", splat_model="antialiased")

    decoded = read(write(cloud))

    assert (decoded.coordinate_system, decoded.splat_model) == ("RDF", "antialiased")


def test_header_bytes_changed__are_refused_or_read():
    data = write(mild_cloud(3, sh_degree=1))
    end = data.index(b"end_header\n") + 11
    outcomes = set()
    for position in range(end):
        for change in (1, 0x20, 0x80):
            damaged = bytearray(data)
            damaged[position] ^= change
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    read(bytes(damaged))
                    outcomes.add("read")
                except GsplatError:
                    outcomes.add("refused")
    assert "refused" in outcomes
