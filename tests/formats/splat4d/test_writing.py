import io
import math
import struct

import numpy as np
import pytest

from gsplat_tools.attributes.quaternions import to_matrix
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats.splat4d import Splat4dOptions, Splat4dReadOptions, read, write
from gsplat_tools.formats.splat4d.container import parse
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.formats.splat4d.by_hand import plain, record


def written(cloud: GaussianCloud, **options: object) -> bytes:
    stream = io.BytesIO()
    write(cloud, stream, Splat4dOptions(**options))  # type: ignore[arg-type]
    return stream.getvalue()


def known(**changes: object) -> GaussianCloud:
    """The splat of `by_hand.record`."""
    c0 = 0.28209479177387814
    cloud = GaussianCloud(
        means=np.array([[1, 2, 3]]),
        log_scales=np.log([[0.5, 0.25, 2]]),
        quats=np.array([[0, 1, 0, 0]]),
        opacity_logits=np.array([math.log(0.8 / 0.2)]),
        sh0=np.array([[0.5 / c0, -0.5 / c0, -0.3 / c0]]),
        shN=np.zeros((1, 0, 3)),
        velocities=np.array([[0.5, 0, -1]]),
        times=np.array([0.25]),
        durations=np.array([0.5]),
    )
    return cloud.replace(**changes)


def modest(count: int, sh_degree: int = 3, *, motion: bool = True) -> GaussianCloud:
    """Splats that nothing has to be clamped of."""
    cloud = random_cloud(count, sh_degree=sh_degree, motion=motion)
    return cloud.replace(sh0=np.clip(cloud.sh0, -1.7, 1.7))


def test_write__puts_the_bytes_of_the_record() -> None:
    one = written(known(), version=1, rotation="reference")

    assert len(one) == 64
    assert one == record()
    assert struct.unpack_from("<3f", one, 12) == (0.5, 0.25, 2)


def test_write__puts_header_sections_and_table() -> None:
    data = written(known(), rotation="reference")

    expected = plain()
    assert len(data) == 64 + 64 + 64 + 16 + 2 * 32
    assert data == expected.build()


def test_write__of_a_still_cloud_is_always_visible() -> None:
    data = written(known(velocities=None, times=None, durations=None), version=1)

    assert struct.unpack_from("<5f", data, 32) == (0, 0, 0, 0, 1)
    assert not read(io.BytesIO(data)).has_motion


@pytest.mark.parametrize("rotation", ["best", "small", "reference"])
def test_write__keeps_shapes_however_axes_are_named(rotation: str) -> None:
    cloud = modest(300)

    decoded = read(io.BytesIO(written(cloud, rotation=rotation)))

    def covariances(c: GaussianCloud) -> np.ndarray:
        axes = to_matrix(c.quats.astype(np.float64)) * np.exp(c.log_scales.astype(np.float64))[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    a, b = covariances(cloud), covariances(decoded)
    errors = np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(a, axis=(1, 2))
    assert errors.max() < math.sqrt(8 / 3) * math.sin(math.radians(0.91))
    assert np.allclose(np.sort(cloud.log_scales, axis=1), np.sort(decoded.log_scales, axis=1), atol=2e-6)


def test_write__best_turns_less_than_reference() -> None:
    from gsplat_tools.comparison import attribute_errors

    cloud = modest(500)
    errors = {
        rotation: float(attribute_errors(cloud, read(io.BytesIO(written(cloud, rotation=rotation))))["covariances"].mean())
        for rotation in ("best", "reference")
    }

    assert errors["best"] < 0.6 * errors["reference"]


@pytest.mark.parametrize("version", [1, 2])
def test_write__keeps_motion_to_the_bit(version: int) -> None:
    cloud = modest(200, 0)

    decoded = read(io.BytesIO(written(cloud, version=version)))

    for name in ("means", "velocities", "times", "durations"):
        assert np.array_equal(getattr(decoded, name), getattr(cloud, name)), name


@pytest.mark.parametrize("cutoff", [0.01, 0.3])
def test_write__keeps_the_gaussian_model_and_its_cutoff(cutoff: float) -> None:
    cloud = modest(50).replace(time_model="gaussian", temporal_cutoff=cutoff, times=np.linspace(-1, 2, 50))

    decoded = read(io.BytesIO(written(cloud)))

    assert decoded.time_model == "gaussian"
    assert decoded.temporal_cutoff == pytest.approx(cutoff, rel=1e-6)
    assert decoded.times is not None
    assert np.array_equal(decoded.times, cloud.times)  # type: ignore[arg-type]


def test_write__of_version_1_is_never_taken_for_gaussian() -> None:
    cloud = modest(100, 0).replace(times=np.linspace(-1, 2, 100), durations=np.linspace(-1, 2, 100))

    with pytest.warns(LossyConversionWarning, match=r"window time model needs \[0, 1\]"):
        data = written(cloud, version=1)

    assert read(io.BytesIO(data)).time_model == "window"  # and no warning


def test_write__refuses_gaussians_in_version_1() -> None:
    with pytest.raises(CapabilityError, match=r"use version 2.*with_time_model"):
        written(known(time_model="gaussian"), version=1)


def test_write__says_what_version_1_leaves_out() -> None:
    with pytest.warns(LossyConversionWarning, match="dropped bands 1 to 2 of 20 splats"):
        data = written(modest(20, 2), version=1)

    assert len(data) == 20 * 64


def test_write__refuses_a_version_1_that_reads_as_version_2() -> None:
    x, y = struct.unpack("<2f", b"SPL4DV02")
    with pytest.raises(CapabilityError, match="magic"):
        written(known(means=np.array([[x, y, 0]])), version=1)


def test_write__repairs_sigma_and_counts_it() -> None:
    cloud = known(time_model="gaussian", durations=np.array([0.0]))

    with pytest.warns(LossyConversionWarning, match="1 durations"):
        decoded = read(io.BytesIO(written(cloud)))

    assert decoded.durations is not None
    assert decoded.durations[0] == np.float32(1e-6)


def test_write__clamps_colors_and_scales_and_counts_them() -> None:
    with pytest.warns(LossyConversionWarning, match="clamped the colors of 1 of 1"):
        bright = read(io.BytesIO(written(known(sh0=np.array([[3.0, 0, -3]])))))
    with pytest.warns(LossyConversionWarning, match="clamped the scales of 1 of 1"):
        huge = read(io.BytesIO(written(known(log_scales=np.array([[95.0, 0, -95]])))))

    assert bright.sh0[0] == pytest.approx([1.7724538, 0.0069508, -1.7724538], rel=1e-4)
    assert np.sort(huge.log_scales[0]) == pytest.approx([-87.33655, 0, 88.72], abs=1e-3)


def test_write__keeps_flat_axes_flat() -> None:
    decoded = read(io.BytesIO(written(known(log_scales=np.array([[0.0, -np.inf, 1]])))))

    low, *others = np.sort(decoded.log_scales[0])
    assert np.isneginf(low)
    assert others == pytest.approx([0, 1], abs=2.0**-23)


@pytest.mark.parametrize("centroids", ["f16", "f32"])
@pytest.mark.parametrize("sh_degree", [1, 2, 3])
def test_write__gives_few_splats_entries_of_their_own(centroids: str, sh_degree: int) -> None:
    cloud = modest(100, sh_degree)

    decoded = read(io.BytesIO(written(cloud, centroids=centroids)))

    assert decoded.sh_degree == sh_degree
    # 100 splats and at least 256 entries: what is left is the rounding of the entries.
    bound = np.abs(cloud.shN) * 2.0**-11 + 2.0**-25 if centroids == "f16" else np.abs(cloud.shN) * 1e-6 + 1e-7
    assert (np.abs(decoded.shN - cloud.shN) <= bound).all()


def test_write__takes_the_nearest_entry() -> None:
    cloud = modest(400)
    data = written(cloud, sh_palette_size=16, centroids="f32")
    stream = io.BytesIO(data)
    contents = parse(stream)

    decoded = read(stream)

    first = 0
    for band in contents.bands:
        count = 2 * band.number + 1
        stream.seek(band.centroids.offset)
        entries = np.frombuffer(stream.read(band.centroids.length), "<f4").reshape(-1, 3 * count)
        assert len(entries) == 16
        points = cloud.shN[:, first : first + count].reshape(400, -1).astype(np.float64)
        found = decoded.shN[:, first : first + count].reshape(400, -1)
        best = np.square(points[:, None] - entries).sum(axis=2).min(axis=1)
        assert np.allclose(np.square(points - found).sum(axis=1), best, rtol=1e-4)
        first += count


@pytest.mark.parametrize(("frames", "length", "segments"), [(1, 0, 1), (5, 0, 1), (5, 2, 3), (6, 3, 2)])
def test_write__of_deltas_changes_nothing_in_any_frame(frames: int, length: int, segments: int) -> None:
    cloud = modest(30, 2)
    data = written(cloud, labels="delta-v1", frame_count=frames, delta_segment_length=length)
    contents = parse(io.BytesIO(data))

    assert contents.frame_count == frames
    assert contents.delta_segment_length == length
    assert [len(band.deltas) for band in contents.bands] == [segments, segments]
    assert b"SPL4DLB1" in data
    full = read(io.BytesIO(written(cloud)))
    for frame in range(frames):
        decoded = read(io.BytesIO(data), Splat4dReadOptions(frame=frame))  # and no warning
        assert np.array_equal(decoded.shN, full.shN)


@pytest.mark.parametrize("count", [1, 2, 17])
def test_write__aligns_sections_and_records(count: int) -> None:
    contents = parse(io.BytesIO(written(modest(count))))

    assert contents.records.offset == 64
    assert all(section.offset % 16 == 0 for section in contents.sections)


def test_write__refuses_what_it_cannot_hold() -> None:
    cloud = modest(2)
    with pytest.raises(CapabilityError, match="at least one splat"):
        written(cloud.take(slice(0, 0)))
    with pytest.raises(CapabilityError, match="bands up to 3"):
        written(random_cloud(2, sh_degree=4))
    with pytest.raises(CapabilityError, match="one cloud"):
        written(GaussianSequence(lambda _: cloud, num_splats=2, sh_degree=3, num_frames=2))  # type: ignore[arg-type]
    with pytest.raises(CloudError, match="means-nan"):
        written(known(means=np.array([[np.nan, 0, 0]])))


@pytest.mark.parametrize(
    "options", [{"version": 3}, {"sh_palette_size": 0}, {"sh_palette_size": 65536}, {"labels": "delta"}, {"frame_count": 0}]
)
def test_options__refuse_what_they_do_not_know(options: dict[str, object]) -> None:
    with pytest.raises(CapabilityError):
        Splat4dOptions(**options)  # type: ignore[arg-type]
