import io
import struct

import numpy as np
import pytest

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.errors import (
    CapabilityError,
    CloudError,
    CorruptDataError,
    FormatError,
    TruncatedDataError,
    UnsupportedVersionError,
)
from gsplat_tools.formats import FORMATS, detect
from gsplat_tools.formats.pack import gscc, spark
from gsplat_tools.sequence import GaussianSequence
from tests.formats.pack.clouds import make_cloud


def written(scene, **options):
    stream = io.BytesIO()
    gscc.write(scene, stream, gscc.GsccOptions(**options))
    return stream.getvalue()


def by_hand(cloud, degree):
    """A file put together from docs/formats/gscc.md."""
    pack = spark.encode(cloud)
    positions = spark.decode(pack).means.astype(np.float64)
    low, high = positions.min(axis=0), positions.max(axis=0)
    header = struct.pack("<IIIB3x6f", 0x43435347, 2, len(cloud), degree, *((low + high) / 2), *(high - low))
    return header + b"".join(getattr(pack, name).tobytes() for name in ["packed", *(f"sh{b}" for b in range(1, degree + 1))])


@pytest.mark.parametrize("degree", [0, 1, 4])
def test_write__puts_the_bytes_that_the_specification_says(degree):
    cloud = make_cloud(7, degree, coordinate_system="RUF")

    data = written(cloud, rotation="reference")

    assert data == by_hand(cloud, degree)
    assert len(data) == 40 + 7 * (16 + {0: 0, 1: 8, 4: 56}[degree])


def test_read__takes_files_assembled_from_the_specification():
    cloud = make_cloud(9, 3)

    decoded = gscc.read(io.BytesIO(by_hand(cloud, 3)))

    expected = spark.decode(spark.encode(cloud))
    for name, values in expected.arrays().items():
        np.testing.assert_array_equal(getattr(decoded, name), values)
    assert decoded.coordinate_system == "RUF"


def test_write__gives_the_same_bytes_in_chunks(monkeypatch):
    monkeypatch.setattr(gscc, "_CHUNK", 32)
    cloud = make_cloud(150, 2)
    chunks = CloudChunks(150, cloud.take(slice(0, 0)), lambda: (cloud.take(slice(i, i + 40)) for i in range(0, 150, 40)))

    data = written(chunks)

    assert data == written(cloud)
    assert len(gscc.read_chunks(io.BytesIO(data)).read()) == 150
    np.testing.assert_array_equal(gscc.read(io.BytesIO(data)).shN, spark.decode(spark.encode(cloud)).shN)


def test_write__takes_an_empty_cloud():
    data = written(make_cloud(0, 3))

    assert len(data) == 40
    assert len(gscc.read(io.BytesIO(data))) == 0
    assert gscc.inspect(io.BytesIO(data)).bounds is None


def test_inspect__reads_the_box():
    cloud = make_cloud(3, 0).replace(means=np.array([[0, 1, 2], [-4, 1, 8], [2, 3, 4]]))

    info = gscc.inspect(io.BytesIO(written(cloud)))

    assert info.bounds == ([-4, 1, 2], [2, 3, 8])
    assert (info.splats, info.sh_degree, info.coordinate_system, info.version) == (3, 0, "RUF", "2")


def test_write__refuses_other_axes_and_other_ranges():
    with pytest.raises(CapabilityError, match="GSCC data are RUF, this cloud is RUB; use --target-coordinates RUF"):
        written(make_cloud(1, 0, coordinate_system="RUB"))
    with pytest.raises(CapabilityError, match="use --spark-encoding default"):
        written(make_cloud(1, 0), spark_encoding="fit")
    with pytest.raises(CapabilityError, match="2\\^32 - 1"):
        written(CloudChunks(1 << 32, make_cloud(0, 0), lambda: iter([])))
    with pytest.raises(CapabilityError, match="one moment"):
        written(GaussianSequence(lambda _: make_cloud(1, 0), num_frames=1, num_splats=1, sh_degree=0))


@pytest.mark.parametrize("announced", [4, 6])
def test_write__refuses_chunks_that_hold_another_number(announced):
    cloud = make_cloud(5, 0)

    with pytest.raises(CloudError, match=f"announced {announced} splats"):
        written(CloudChunks(announced, cloud.take(slice(0, 0)), lambda: iter([cloud])))


def test_read__refuses_every_proper_beginning_and_trailing_bytes():
    data = written(make_cloud(3, 1))

    for length in range(len(data)):
        with pytest.raises(TruncatedDataError):
            gscc.read(io.BytesIO(data[:length]))
    with pytest.raises(CorruptDataError, match="3 splats of degree 1 take 112 bytes but the file has 113"):
        gscc.read(io.BytesIO(data + b"\0"))


@pytest.mark.parametrize(
    ("offset", "value", "error", "field"),
    [
        (0, b"GSPK", CorruptDataError, "magic"),
        (4, struct.pack("<I", 3), UnsupportedVersionError, "version"),
        (8, struct.pack("<I", 0xFFFFFFFF), TruncatedDataError, "count"),
        (8, struct.pack("<I", 2), CorruptDataError, "count"),
        (12, b"\x05", CorruptDataError, "bands"),
        (13, b"\x01", CorruptDataError, "bands"),
        (16, struct.pack("<f", float("nan")), CorruptDataError, "bounds"),
    ],
)
def test_read__names_the_field_of_a_header_that_lies(offset, value, error, field):
    data = written(make_cloud(3, 1))

    with pytest.raises(FormatError) as caught:
        gscc.read(io.BytesIO(data[:offset] + value + data[offset + len(value) :]))

    assert type(caught.value) is error
    assert caught.value.field == field


def test_format__is_known_by_its_magic_and_states_its_axes():
    data = written(make_cloud(1, 0))

    assert detect(data[:64]) is FORMATS["gscc"]
    assert FORMATS["gscc"].required_coordinates == "RUF"


def test_bounds__are_those_of_the_default_ranges():
    cloud = make_cloud(5, 1)
    stream = io.BytesIO(written(cloud))

    bounds = gscc.bounds(cloud, stream, 0)

    np.testing.assert_allclose(bounds["scales"], 21 / 254 / 2, rtol=1e-3)
    np.testing.assert_allclose(bounds["shN"], 1 / 126, rtol=1e-3)
