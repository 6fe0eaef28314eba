import gzip
import io
import struct
import subprocess
import sys
import warnings

import numpy as np
import pytest

from gsplat_tools.errors import (
    CorruptDataError,
    FormatError,
    LimitExceededError,
    LossyConversionWarning,
    TruncatedDataError,
    UnsupportedVersionError,
)
from gsplat_tools.formats import spz
from tests.builders_spz import SpzFile, fixed24, random_file
from tests.oracles import smallest_three as oracle

VERSIONS = (1, 2, 3, 4)
every_version = pytest.mark.parametrize("version", VERSIONS)


def read(file):
    return spz.read(io.BytesIO(file if isinstance(file, bytes) else file.data()))


def one_splat(version=4, **changes):
    fields = {
        "positions": fixed24([4096, -2048, 8388607]) if version > 1 else np.array([1, -0.5, 2048], "<f2").tobytes(),
        "alphas": bytes([128]),
        "colors": bytes([0, 255, 51]),
        "scales": bytes([0, 255, 160]),
        "rotations": struct.pack("<I", 3 << 30 | 512 << 20 | 511 << 20) if version >= 3 else bytes([255, 128, 127]),
    }
    return SpzFile(version=version, **(fields | changes))


def test_values__are_what_the_specification_says():
    cloud = read(one_splat(sh_degree=1, sh=bytes([0, 128, 255, 64, 192, 129, 127, 1, 254])))

    np.testing.assert_array_equal(cloud.means, np.array([[1, -0.5, 8388607 / 4096]], np.float32))
    np.testing.assert_array_equal(cloud.log_scales, [[-10, 5.9375, 0]])
    np.testing.assert_allclose(cloud.opacity_logits, [np.log(128 / 127)], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh0, [[-0.5 / 0.15, 0.5 / 0.15, -0.3 / 0.15]], rtol=1e-6)
    expected = [[-1, 0, 127 / 128], [-0.5, 0.5, 1 / 128], [-1 / 128, -127 / 128, 126 / 128]]
    np.testing.assert_array_equal(cloud.shN[0], np.array(expected, np.float32))
    # Index 3 is w; the first field is x: sign, then 511 of 511 of sqrt(1/2).
    np.testing.assert_allclose(cloud.quats, [[np.sqrt(0.5), -np.sqrt(0.5), 0, 0]], atol=1e-7)


def test_opacity_bytes_at_the_ends__are_infinite_logits():
    cloud = read(random_file(2).__class__(**(random_file(2).__dict__ | {"alphas": bytes([0, 255])})))

    np.testing.assert_array_equal(cloud.opacity_logits, [-np.inf, np.inf])


@every_version
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3, 4])
def test_every_version_and_degree__is_read_as_plain_arithmetic_reads_it(version, sh_degree):
    file = random_file(300, version=version, sh_degree=sh_degree)
    cloud = read(file)

    if version == 1:
        means = np.frombuffer(file.positions, "<f2").reshape(-1, 3).astype(np.float32)
    else:
        bytes_ = np.frombuffer(file.positions, np.uint8).reshape(-1, 3, 3).astype(np.int64)
        whole = bytes_[:, :, 0] + 256 * bytes_[:, :, 1] + 65536 * bytes_[:, :, 2]
        means = np.where(whole >= 1 << 23, whole - (1 << 24), whole) / 4096
    np.testing.assert_array_equal(cloud.means, means.astype(np.float32))
    sh = np.frombuffer(file.sh, np.uint8).reshape(300, -1, 3)
    np.testing.assert_array_equal(cloud.shN, ((sh.astype(np.float64) - 128) / 128).astype(np.float32))
    if version >= 3:
        quats = [oracle.unpack_signed(int(word)) for word in np.frombuffer(file.rotations, "<u4")]
    else:
        quats = [oracle.unpack_first_three(row) for row in np.frombuffer(file.rotations, np.uint8).reshape(-1, 3)]
    np.testing.assert_allclose(cloud.quats, quats, atol=1.2e-7)


@every_version
def test_flag__makes_the_cloud_antialiased(version):
    assert read(one_splat(version)).splat_model == "default"
    assert read(one_splat(version, flags=1)).splat_model == "antialiased"


@every_version
@pytest.mark.parametrize(("number", "system"), [(0, "unknown"), (4, "RUB"), (6, "RDF"), (8, "RUF"), (9, "LFD"), (16, "RBU")])
def test_extension__names_the_coordinate_system(version, number, system):
    file = one_splat(version, flags=2, extensions=[(0xADBE0003, struct.pack("<I", number))])

    cloud = read(file)
    info = spz.inspect(io.BytesIO(file.data()))

    assert cloud.coordinate_system == info.coordinate_system == system


def test_without_extension__the_axes_are_unknown():
    assert read(one_splat()).coordinate_system == "unknown"


@every_version
def test_other_extensions__are_left_out_with_a_warning(version):
    records = [(0xADBE0002, bytes(12)), (0x12340001, b"xyz"), (0xADBE0003, struct.pack("<I", 4))]

    with pytest.warns(LossyConversionWarning, match=r"0xadbe0002 \(12 bytes\), 0x12340001 \(3 bytes\)") as caught:
        cloud = read(one_splat(version, flags=2, extensions=records))

    assert caught[0].message.code == "left-out-extensions"
    assert cloud.coordinate_system == "RUB"


@every_version
@pytest.mark.parametrize(
    ("block", "words"),
    [
        (struct.pack("<II", 1, 5) + b"four", "claims 5 bytes and 4 are left"),
        (b"\x01\x02\x03", "3 bytes are left"),
        (struct.pack("<III", 0xADBE0003, 4, 17), "number of a coordinate system"),
        (struct.pack("<IIH", 0xADBE0003, 2, 1), "number of a coordinate system"),
    ],
)
def test_broken_extension__is_refused_with_its_place(version, block, words):
    class Broken(SpzFile):
        def extension_block(self):
            return block

    file = Broken(**(one_splat(version).__dict__ | {"flags": 2}))

    with pytest.raises(CorruptDataError, match=words) as caught:
        read(file)
    start = 32 if version == 4 else len(file.raw()) - len(block)
    assert caught.value.field == "extensions"
    assert caught.value.offset >= start


@every_version
def test_prefixes__are_refused(version):
    data = random_file(7, version=version, sh_degree=1).data()

    for length in range(len(data)):
        with pytest.raises(FormatError):
            read(data[:length])


@pytest.mark.parametrize(
    ("changes", "error", "field"),
    [
        ({"version": 5}, UnsupportedVersionError, "version"),
        ({"sh_degree": 5}, CorruptDataError, "shDegree"),
        ({"fractional_bits": 25}, CorruptDataError, "fractionalBits"),
        ({"count": 2}, CorruptDataError, "positions"),
        ({"count": 0}, CorruptDataError, "numStreams"),
        ({"count": (1 << 31) - 1}, LimitExceededError, "numPoints"),
        ({"count": 1 << 31}, LimitExceededError, "numPoints"),
        ({"streams": 4}, CorruptDataError, "numStreams"),
        ({"sh_degree": 1}, CorruptDataError, "numStreams"),
        ({"alphas": b""}, CorruptDataError, "numStreams"),
    ],
)
def test_zstd_header_that_contradicts_itself__is_refused(changes, error, field):
    with pytest.raises(error) as caught:
        read(SpzFile(**(one_splat().__dict__ | {"count": 1} | changes)).zstd())
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"version": 4}, UnsupportedVersionError),
        ({"version": 0}, UnsupportedVersionError),
        ({"sh_degree": 9}, CorruptDataError),
        ({"fractional_bits": 200}, CorruptDataError),
        ({"count": 2}, TruncatedDataError),
        ({"count": 0}, CorruptDataError),
        ({"count": 0xFFFFFFFF}, LimitExceededError),
    ],
)
def test_gzip_header_that_contradicts_itself__is_refused(changes, error):
    with pytest.raises(error):
        read(SpzFile(**(one_splat(3).__dict__ | changes)).legacy())


def test_bytes_after_either_container__are_refused():
    for version in (3, 4):
        with pytest.raises(FormatError):
            read(one_splat(version).data() + b"\0")


def test_gzip_that_never_ends__is_refused_before_it_fills_memory():
    """A header for one splat in front of a gigabyte of zeros."""
    data = gzip.compress(one_splat(3).raw() + bytes(1 << 26), 9)

    with pytest.raises(CorruptDataError, match="follow the attributes"):
        read(data)


def test_zstd_stream_of_the_wrong_length__is_refused():
    shorter, longer = one_splat(), one_splat()
    for file, data in ((shorter, bytes(8)), (longer, bytes(10))):
        right = file.zstd()
        wrong = SpzFile(**(file.__dict__ | {"positions": data})).zstd()
        # The table says nine bytes, the frame holds more or fewer.
        start = 32 + 5 * 16
        length = struct.unpack_from("<Q", wrong, 32)[0]
        with pytest.raises(CorruptDataError, match=r"must hold 9 bytes|does not decompress"):
            read(right[:32] + struct.pack("<QQ", length, 9) + wrong[48:start] + wrong[start:])


def test_files_of_equal_splats__are_read_however_well_they_compress():
    file = SpzFile(positions=bytes(9 * 100_000), alphas=bytes(100_000), colors=bytes(300_000), scales=bytes(300_000),
                   rotations=bytes(400_000))  # fmt: skip

    assert len(file.data()) < 2000
    assert len(read(file)) == 100_000


def test_uncompressed_old_header__says_that_the_version_is_wrong():
    with pytest.raises(UnsupportedVersionError, match="version 3"):
        read(one_splat(3).raw() + bytes(64))


def test_matches__knows_both_containers_and_no_other_gzip():
    assert spz.matches(one_splat(4).data())
    assert spz.matches(random_file(50, version=3).data())
    assert not spz.matches(gzip.compress(b"something else"))
    assert not spz.matches(b"\x1f\x8b")
    assert not spz.matches(b"ply\n")


@every_version
def test_inspect__tells_the_header_without_the_compiler(version, tmp_path):
    path = tmp_path / "scene.spz"
    path.write_bytes(random_file(5, version=version, sh_degree=2).data())
    code = (
        "import sys; from gsplat_tools.formats.loading import inspect_file; "
        f"r, i = inspect_file({str(path)!r}); print(r.id, i.version, i.splats, i.sh_degree, 'numba' in sys.modules)"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.split() == ["spz", str(version), "5", "2", "False"]


def test_chunks__give_what_a_whole_read_gives(monkeypatch):
    from gsplat_tools.formats.spz import payload

    monkeypatch.setattr(payload, "_IN_MEMORY", 0)  # the temporary file
    for version in (2, 4):
        data = random_file(2000, version=version, sh_degree=1).data()
        chunks = spz.read_chunks(io.BytesIO(data))
        whole = read(data)
        for _ in range(2):
            pieces = chunks.read()
            for name, values in whole.arrays().items():
                np.testing.assert_array_equal(getattr(pieces, name), values)


def test_reading__warns_about_nothing_else():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(random_file(10, sh_degree=3))
