import io
import json
import struct
import subprocess
import sys
import warnings
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.errors import (
    CapabilityError,
    CloudError,
    CorruptDataError,
    FormatError,
    LimitExceededError,
    TruncatedDataError,
    UnsupportedVersionError,
)
from gsplat_tools.formats import FORMATS, detect
from gsplat_tools.formats.pack import container_writing, gspk, limits, spark, uncompressed
from gsplat_tools.parallel import use_jobs
from gsplat_tools.sequence import GaussianSequence
from tests.formats.pack.clouds import make_cloud, relative_covariance_errors
from tests.formats.pack.gspk_by_hand import assemble, spark_description

LAYOUTS = ["spark", "uncompressed"]


def written(cloud, layout, **options):
    stream = io.BytesIO()
    record = FORMATS[layout]
    record.write(cloud, stream, record.write_options(**options))
    return stream.getvalue()


def read(data):
    return gspk.read(io.BytesIO(data))


def described(data):
    offset, length = struct.unpack_from("<QQ", data, 16)
    return json.loads(data[offset : offset + length])


def assert_same(a, b):
    for name, values in a.arrays().items():
        np.testing.assert_array_equal(values, getattr(b, name), err_msg=name)
    for name in ("coordinate_system", "splat_model", "time_model"):
        assert getattr(a, name) == getattr(b, name)
    np.testing.assert_array_equal(a.origin, b.origin)


def hand_made(codec="zstd", count=5, **options):
    pack = spark.encode(make_cloud(count, 1))
    arrays = {"packed": ("u32", pack.packed), "sh1": ("u32", pack.sh1), "unknown": ("f32", np.zeros((count, 2)))}
    return assemble(spark_description(count, 1), arrays, codec=codec, **options), pack


@pytest.mark.parametrize("codec", ["zstd", "none"])
@pytest.mark.parametrize("json_last", [False, True])
def test_read__takes_files_assembled_from_the_specification(codec, json_last):
    data, pack = hand_made(codec, json_last=json_last)

    cloud = read(data)

    expected = spark.decode(pack)
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(expected, name))
    assert (cloud.coordinate_system, cloud.splat_model, list(cloud.origin)) == ("RUB", "antialiased", [0.5, 0, 1e6])


def test_read__takes_concatenated_frames_as_one_stream():
    data, pack = hand_made()
    entry = next(entry for entry in described(data)["streams"] if entry["name"] == "packed")
    stored = data[entry["offset"] : entry["offset"] + entry["stored_length"]]

    raw = zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True).read()

    assert raw == pack.packed.tobytes()


def test_write__puts_the_header_that_the_specification_says():
    data = written(make_cloud(3, 0), "uncompressed")

    fields = struct.unpack("<4sIQQQII24s", data[:64])

    text = data[64 : 64 + fields[4]]
    assert fields == (b"GSPK", 1, len(data), 64, len(text), zlib.crc32(text), 1, bytes(24))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_write__without_codec_can_be_mapped_to_gpu_buffers(layout, tmp_path):
    cloud = make_cloud(70_000, 2)
    path = tmp_path / "scene.gspk"
    path.write_bytes(written(cloud, layout, codec="none", **({"rotation": "reference"} if layout == "spark" else {})))
    pack = spark.encode(cloud) if layout == "spark" else uncompressed.encode(cloud)

    for entry in described(path.read_bytes())["streams"]:
        dtype = {"f32": "<f4", "u32": "<u4"}[entry["dtype"]]
        mapped = np.memmap(path, dtype, "r", offset=entry["offset"], shape=tuple(entry["shape"]))
        assert entry["offset"] % 64 == 0
        np.testing.assert_array_equal(mapped, getattr(pack, entry["name"]))
        assert entry["crc32"] == [zlib.crc32(mapped[:65536].tobytes()), zlib.crc32(mapped[65536:].tobytes())]


@pytest.mark.parametrize("codec", ["zstd", "none"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("count", "degree", "has_motion"), [(0, 3, True), (1, 0, False), (301, 4, True), (70_001, 1, False)])
def test_round_trip__is_what_encode_and_decode_give(layout, codec, count, degree, has_motion):
    metadata = {"origin": [1e6, -2, 0.1], "coordinate_system": "LUF", "splat_model": "2dgs", "time_model": "gaussian"}
    cloud = make_cloud(
        count, degree, has_motion=has_motion, **(metadata if has_motion else metadata | {"time_model": "window"})
    )
    module = spark if layout == "spark" else uncompressed

    data = written(cloud, layout, codec=codec)

    expected = spark.decode(spark.encode(cloud, rotation="best")) if layout == "spark" else module.decode(module.encode(cloud))
    assert_same(read(data), expected)
    assert_same(gspk.read_chunks(io.BytesIO(data)).read(), expected)
    info = gspk.inspect(io.BytesIO(data))
    assert (info.splats, info.sh_degree, info.splat_model, info.origin) == (count, degree, "2dgs", (1e6, -2, 0.1))
    assert info.bounds == (None if count == 0 else tuple(corner.tolist() for corner in expected.bounds()))
    assert (info.motion_bounds is None) == (not has_motion or count == 0)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_write__gives_the_same_bytes_for_any_threads_chunks_and_run(layout, monkeypatch):
    monkeypatch.setattr(container_writing, "FRAME_ROWS", 256)
    cloud = make_cloud(1000, 1, has_motion=True)

    def chunks(size):
        parts = lambda: (cloud.take(slice(start, start + size)) for start in range(0, 1000, size))  # noqa: E731
        return CloudChunks(1000, cloud.take(slice(0, 0)), parts)

    with use_jobs(1):
        first = written(cloud, layout)
    with use_jobs(3):
        assert written(cloud, layout) == first
    for size in (1, 37, 256, 300, 999):
        assert written(chunks(size), layout) == first
    assert len(described(first)["streams"][0]["frames"]) == 4


def test_write__fit_looks_at_all_chunks_first():
    cloud = make_cloud(100, 1)
    cloud = cloud.replace(log_scales=np.linspace(-5, -3, 300).reshape(100, 3))

    entry = described(written(cloud, "spark", spark_encoding="fit"))["splat_encoding"]

    assert (entry["lnScaleMin"], entry["lnScaleMax"]) == (-5, -3)


def test_motion_bounds__grow_by_the_largest_speed_times_the_longest_time():
    cloud = make_cloud(2, 0, has_motion=True).replace(
        means=np.array([[0, 0, 0], [1, 2, 4]]), velocities=np.array([[3, 0, 4], [0, 0, 0]]), durations=np.array([0.1, 0.5])
    )

    window = gspk.inspect(io.BytesIO(written(cloud, "spark"))).motion_bounds
    gaussian = gspk.inspect(io.BytesIO(written(cloud.replace(time_model="gaussian"), "spark"))).motion_bounds

    assert window == ([-2.5, -2.5, -2.5], [3.5, 4.5, 6.5])
    np.testing.assert_allclose(gaussian[1], np.array([1, 2, 4]) + 2.5 * np.sqrt(-2 * np.log(0.01)))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_detect__tells_the_layouts_apart(layout):
    data = written(make_cloud(2, 0), layout)

    assert detect(data[:64]).id == layout
    assert_same(FORMATS["spark"].read(io.BytesIO(data), None), FORMATS["uncompressed"].read(io.BytesIO(data), None))


def test_read__refuses_every_proper_beginning_of_a_file():
    data = written(make_cloud(3, 1, has_motion=True), "spark")

    for length in range(len(data)):
        with pytest.raises(TruncatedDataError):
            read(data[:length])


@pytest.mark.parametrize("layout", LAYOUTS)
@settings(max_examples=300)
@given(st.data())
def test_read__refuses_or_reads_every_changed_byte(layout, data):
    content = bytearray(written(make_cloud(3, 1), layout))
    place = data.draw(st.one_of(st.integers(0, 63), st.integers(0, len(content) - 1)))
    content[place] ^= data.draw(st.integers(1, 255))

    try:
        cloud = read(bytes(content))
    except FormatError:
        return
    # What is left is padding: the cloud is the one that was written.
    assert_same(cloud, read(written(make_cloud(3, 1), layout)))


def at(*keys):
    """Function that sets one value of a description."""

    def setter(value):
        def change(description):
            target = description
            for key in keys[:-1]:
                target = target[key]
            if value is KeyError:
                del target[keys[-1]]
            else:
                target[keys[-1]] = value

        return change

    return setter


PACKED = ("streams", 2)  # streams are stored in reverse
SH1 = ("streams", 1)
LIES = [
    ("count", at("count")(4), "streams.packed.shape"),
    ("count", at("count")(-1), "count"),
    ("count", at("count")(5.0), "count"),
    ("count", at("count")(True), "count"),
    ("count", at("count")(10**30), "count"),
    ("layout", at("layout")("uncompressed"), "streams.positions"),
    ("layout", at("layout")("other"), "layout"),
    ("degree", at("degree")(5), "degree"),
    ("degree", at("degree")(2), "streams.sh2"),
    ("degree", at("degree")(KeyError), "degree"),
    ("bounds", at("bounds")([1, 2]), "bounds"),
    ("bounds", at("bounds", "min")([1, 2, "3"]), "bounds.min"),
    ("bounds", at("bounds", "max")([1, 2, 1e300 * 10]), None),
    ("origin", at("origin")([1, 2]), "origin"),
    ("origin", at("origin")([1, 2, None]), "origin"),
    ("system", at("coordinate_system")("XYZ"), "coordinate_system"),
    ("system", at("coordinate_system")(["RUB"]), "coordinate_system"),
    ("model", at("splat_model")("3dgs"), "splat_model"),
    ("model", at("splat_model")({}), "splat_model"),
    ("ranges", at("splat_encoding", "rgbMax")(0), "splat_encoding"),
    ("ranges", at("splat_encoding", "lnScaleMax")("9"), "splat_encoding.lnScaleMax"),
    ("ranges", at("splat_encoding")([]), "splat_encoding"),
    ("time", at("time_model")("window"), "streams.velocities"),
    ("time", at("time_model")(3), "time_model"),
    ("rows", at("frame_rows")(0), "frame_rows"),
    ("rows", at("frame_rows")(3), "streams.packed.frames"),
    ("streams", at("streams")({}), "streams"),
    ("streams", at("streams")([1]), "streams"),
    ("name", at(*PACKED, "name")("sh1"), "streams"),
    ("name", at(*PACKED, "name")(7), "streams"),
    ("dtype", at(*PACKED, "dtype")("f32"), "streams.packed.dtype"),
    ("shape", at(*PACKED, "shape")([5, 3]), "streams.packed.shape"),
    ("length", at(*PACKED, "raw_length")(79), "streams.packed.raw_length"),
    ("stored", at(*PACKED, "stored_length")(1), "streams.packed.frames"),
    ("stored", at(*PACKED, "stored_length")(10**9), "streams.packed.offset"),
    ("codec", at(*PACKED, "codec")("gzip"), "streams.packed.codec"),
    ("codec", at(*PACKED, "codec")("none"), "streams.packed.frames"),
    ("offset", at(*PACKED, "offset")(4097), "streams.packed.offset"),
    ("offset", at(*PACKED, "offset")(0), "streams.packed.offset"),
    ("offset", at(*PACKED, "offset")(64), None),
    ("offset", at(*PACKED, "offset")(1 << 40), "streams.packed.offset"),
    ("frames", at(*PACKED, "frames")([1, 2]), "streams.packed.frames"),
    ("frames", at(*PACKED, "frames")("abc"), "streams.packed.frames"),
    ("frames", at(*PACKED, "frames", 0)(-5), "streams.packed.frames"),
    ("crc32", at(*PACKED, "crc32")([0]), "streams.packed.crc32"),
    ("crc32", at(*PACKED, "crc32", 1)(0), "streams.packed"),
    ("crc32", at(*SH1, "crc32", 1)(None), "streams.sh1.crc32"),
]


@pytest.mark.parametrize(("change", "field"), [lie[1:] for lie in LIES], ids=[f"{i}-{lie[0]}" for i, lie in enumerate(LIES)])
def test_read__names_the_field_of_a_description_that_lies(change, field):
    data, _ = hand_made(change=change)

    with pytest.raises(FormatError) as caught:
        read(data)

    assert field is None or caught.value.field == field


def test_read__refuses_streams_that_overlap():
    def overlap(description):
        description["streams"][1]["offset"] = description["streams"][2]["offset"]

    data, _ = hand_made(change=overlap)

    with pytest.raises(CorruptDataError, match="overlaps"):
        read(data)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        (zstandard.ZstdCompressor().compress(bytes(31)), "says that it holds 31 bytes, expected 32"),
        (zstandard.ZstdCompressor(write_content_size=False).compress(bytes(32)), "says that it holds"),
        (zstandard.ZstdCompressor().compress(bytes(32)) * 2, "does not decompress"),
        (zstandard.ZstdCompressor().compress(bytes(32))[:-1], "does not decompress"),
        (zstandard.ZstdCompressor().compress(bytes(32)), "checksum of frame 1 differs"),
        (b"", "does not decompress"),
        (b"not zstd at all", "does not decompress"),
    ],
)
def test_read__refuses_frames_that_are_not_what_they_should_be(stored, message):
    data, _ = hand_made(raw_change={("packed", 1): stored})

    with pytest.raises(CorruptDataError, match=message) as caught:
        read(data)

    assert caught.value.field == "streams.packed"
    assert caught.value.offset > 64


def test_read__refuses_claims_that_no_honest_file_makes():
    def claim(description):
        description["count"] = 1 << 40
        description["frame_rows"] = 1 << 41

    data, _ = hand_made(change=claim)

    with pytest.raises(LimitExceededError, match="more than 1024 times"):
        read(data)


@pytest.mark.parametrize(
    ("offset", "value", "error", "field"),
    [
        (0, b"GSPX", CorruptDataError, "magic"),
        (4, struct.pack("<I", 2), UnsupportedVersionError, "version"),
        (8, struct.pack("<Q", 10), CorruptDataError, "file_length"),
        (8, struct.pack("<Q", 1 << 50), TruncatedDataError, "file_length"),
        (16, struct.pack("<Q", 63), CorruptDataError, "json_offset"),
        (16, struct.pack("<Q", 1 << 63), CorruptDataError, "json_offset"),
        (24, struct.pack("<Q", (1 << 64) - 1), CorruptDataError, "json_offset"),
        (32, struct.pack("<I", 0), CorruptDataError, "json_crc32"),
        (36, struct.pack("<I", 1), CorruptDataError, "layout"),
        (36, struct.pack("<I", 99), CorruptDataError, "layout"),
        (63, b"\x01", CorruptDataError, "reserved"),
    ],
)
def test_read__names_the_field_of_a_header_that_lies(offset, value, error, field):
    data, _ = hand_made()

    with pytest.raises(error) as caught:
        read(data[:offset] + value + data[offset + len(value) :])

    assert caught.value.field == field


@pytest.mark.parametrize("text", [b"[" * 100_000, b"\xff", b"[]", b'{"count": NaN}', b"", b'{"count": 1' + b"0" * 5000 + b"}"])
def test_read__refuses_descriptions_that_are_not_what_json_should_be(text):
    data = struct.pack("<4sIQQQII24x", b"GSPK", 1, 64 + len(text), 64, len(text), zlib.crc32(text), 0) + text

    with pytest.raises(FormatError):
        read(data)


def test_write__refuses_sequences_and_chunks_that_hold_another_number():
    cloud = make_cloud(5, 0)
    short = CloudChunks(6, cloud.take(slice(0, 0)), lambda: iter([cloud]))

    with pytest.raises(CapabilityError, match="holds one moment"):
        written(GaussianSequence(lambda _: cloud, num_frames=1, num_splats=5, sh_degree=0), "spark")
    with pytest.raises(CloudError, match="announced 6 splats but its chunks hold 5"):
        written(short, "uncompressed")


def test_write__counts_positions_beyond_half_over_all_chunks():
    cloud = make_cloud(300, 0)
    means = cloud.means.copy()
    means[[5, 150, 299]] = 1e5
    cloud = cloud.replace(means=means)
    parts = CloudChunks(300, cloud.take(slice(0, 0)), lambda: iter([cloud.take(slice(i, i + 50)) for i in range(0, 300, 50)]))

    with pytest.raises(CapabilityError, match="3 of 300 splats"):
        written(parts, "spark")


@pytest.mark.parametrize("options", [{"codec": "gzip"}, {"zstd_level": 0}, {"zstd_level": 23}])
def test_write__refuses_unknown_codecs_and_levels(options):
    with pytest.raises(CapabilityError, match="expected codec zstd of level 1 to 22, or none"):
        written(make_cloud(1, 0), "uncompressed", **options)


def test_write__refuses_an_unknown_range_choice():
    with pytest.raises(CapabilityError, match="'default' or 'fit'"):
        written(make_cloud(1, 0), "spark", spark_encoding="tight")


@settings(max_examples=30)
@given(st.integers(0, 2**32))
def test_uncompressed_bounds__hold(seed):
    rng = np.random.default_rng(seed)
    cloud = make_cloud(64, 3, seed)
    cloud = cloud.replace(
        log_scales=np.where(rng.random((64, 3)) < 0.1, -np.inf, cloud.log_scales * np.float32(rng.choice([1, 4, 7.9]))),
        opacity_logits=cloud.opacity_logits * np.float32(rng.choice([1, 6])),
        quats=cloud.quats * np.exp(rng.uniform(-8, 8, (64, 1))),
    )
    data = written(cloud, "uncompressed")
    decoded = read(data)

    bounds = gspk.bounds(cloud, io.BytesIO(data), 0)

    a, b = np.sort(cloud.log_scales, axis=1).astype(np.float64), np.sort(decoded.log_scales, axis=1)
    with np.errstate(invalid="ignore"):
        assert (np.where(a == b, 0, np.abs(a - b)) <= bounds["scales"]).all()
    opacities = [1 / (1 + np.exp(-c.opacity_logits.astype(np.float64))) for c in (cloud, decoded)]
    assert (np.abs(opacities[0] - opacities[1]) <= bounds["opacities"]).all()
    is_round = np.isfinite(cloud.log_scales).all(axis=1) & (cloud.log_scales > -80).all(axis=1)
    narrow = cloud.take(is_round), decoded.take(is_round)
    assert (relative_covariance_errors(*narrow) <= bounds["covariances"][is_round]).all()
    for name in ("means", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(decoded, name))


def test_uncompressed_encode__has_known_values():
    cloud = make_cloud(2, 1).replace(
        quats=np.array([[0, 0, 3, 4], [0, 0, 0, 0]]), log_scales=np.array([[0, np.log(2), -np.inf], [1, 1, 1]]),
        opacity_logits=np.array([0, -np.inf]), sh0=np.array([[5, -6, 7], [0, 0, 0]]),
    )  # fmt: skip

    pack = uncompressed.encode(cloud)

    np.testing.assert_allclose(pack.rotations, [[0, 0, 0.6, 0.8], [1, 0, 0, 0]])
    np.testing.assert_allclose(pack.scales[0], [1, 2, 0])
    np.testing.assert_allclose(pack.colors, [[5, -6, 7, 0.5], [0, 0, 0, 0]])


def test_uncompressed_encode__clamps_and_flattens_with_a_count():
    cloud = make_cloud(2, 0).replace(log_scales=np.array([[89, 200, 0], [-104, -103, 0]]))

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pack = uncompressed.encode(cloud)

    assert [(w.message.code, str(w.message).split()[1 if w.message.code == "clamped" else 0]) for w in caught] == [
        ("clamped", "2"),
        ("flattened", "1"),
    ]
    assert np.isfinite(pack.scales).all()
    with pytest.raises(CloudError, match="1 splats have positions that are not finite"):
        uncompressed.encode(cloud.replace(means=np.array([[np.nan, 0, 0], [0, 0, 0]])))


def test_spark_bounds__come_from_the_ranges_in_the_file():
    cloud = make_cloud(50, 1)
    data = written(cloud, "spark", spark_encoding="fit")

    bounds = gspk.bounds(cloud, io.BytesIO(data), 0)

    assert bounds["scales"].max() < limits.spark_bounds(cloud, spark.SplatEncoding())["scales"].min()


def test_inspect__loads_no_compiler(tmp_path):
    path = tmp_path / "a.gspk"
    path.write_bytes(written(make_cloud(10, 2), "spark"))
    code = (
        "import sys; from gsplat_tools.formats import FORMATS\n"
        f"info = FORMATS['spark'].inspect(open({str(path)!r}, 'rb'))\n"
        "assert info.splats == 10 and 'numba' not in sys.modules, 'numba was loaded'"
    )

    subprocess.run([sys.executable, "-c", code], check=True)
