import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsplat_tools.codecs import quaternion_u8
from gsplat_tools.errors import CloudError


def angles_deg(quats, codes):
    """Rotation angle between quaternions and what a normalizing decoder makes of their codes, float64."""
    a = quats.astype(np.float64)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = codes.astype(np.float64) - 128
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    b *= np.where((a * b).sum(1, keepdims=True) < 0, -1, 1)
    return np.rad2deg(4 * np.arcsin(np.linalg.norm(a - b, axis=1) / 2))


def test_encode__stores_known_bytes_as_the_plain_rounding_does():
    quats = np.array([[1, 0, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 0], [2, 2, -2, 2], [0.5, 0.5, 0.5, -0.5]], np.float32)

    codes = quaternion_u8.encode(quats, mode="reference")

    expected = [[255, 128, 128, 128], [0, 128, 128, 128], [255, 128, 128, 128], [192, 192, 64, 192], [192, 192, 192, 64]]
    np.testing.assert_array_equal(codes, expected)


def test_encode__keeps_directions_that_the_lattice_holds():
    lattice = np.array([[1, 0, 0, 0], [3, 4, 0, 12], [127, -1, 64, 5], [0, 0, -7, 9]], np.float32)

    decoded = quaternion_u8.decode(quaternion_u8.encode(lattice * np.float32(0.37)))

    np.testing.assert_allclose(decoded, lattice / np.linalg.norm(lattice, axis=1, keepdims=True), atol=1e-6)


def test_encode__reaches_the_best_point_of_an_exhaustive_search_of_the_ray():
    quats = np.random.default_rng(3).normal(size=(40, 4))
    found = angles_deg(quats, quaternion_u8.encode(quats))

    for quat, angle in zip(quats, found, strict=True):
        unit = quat / np.linalg.norm(quat) * (1 if quat[0] >= 0 else -1)
        steps = np.linspace(0.5, 1, 20001)[:, None] * 127.49 / np.abs(unit).max()
        best = angles_deg(np.broadcast_to(unit, (len(steps), 4)), np.rint(unit * steps) + 128).min()
        assert angle <= 1.15 * best + 1e-6  # the search samples the ray at 192 places


def test_encode__errs_little_over_uniform_rotations():
    quats = np.random.default_rng(0).normal(size=(100_000, 4)).astype(np.float32)

    best = angles_deg(quats, quaternion_u8.encode(quats))
    reference = angles_deg(quats, quaternion_u8.encode(quats, mode="reference"))

    assert best.mean() <= 0.125
    assert best.max() <= 0.60
    assert reference.mean() >= 0.40  # what the search is worth
    assert max(best.max(), reference.max()) <= np.rad2deg(quaternion_u8.MAX_ANGLE)


@settings(deadline=None, max_examples=60)
@given(hnp.arrays(np.float32, (7, 4), elements=st.floats(-1, 1, width=32)), st.sampled_from(["best", "reference"]))
def test_encode__holds_its_bound_for_every_direction(quats, mode):
    quats = quats[np.linalg.norm(quats.astype(np.float64), axis=1) > 1e-30]

    codes = quaternion_u8.encode(quats, mode=mode)

    assert (angles_deg(quats, codes) <= np.rad2deg(quaternion_u8.MAX_ANGLE)).all()


def test_encode__gives_the_same_codes_for_every_split_of_the_input():
    quats = np.random.default_rng(1).normal(size=(517, 4)).astype(np.float32)

    parts = [quaternion_u8.encode(quats[start : start + 61]) for start in range(0, 517, 61)]

    np.testing.assert_array_equal(np.concatenate(parts), quaternion_u8.encode(quats))


def test_encode__refuses_what_is_not_finite():
    with pytest.raises(CloudError, match="1 of 2 quaternions are not finite"):
        quaternion_u8.encode(np.array([[1, 0, 0, 0], [np.nan, 0, 0, 0]], np.float32))


def covariances(quats, log_scales):
    w, x, y, z = (quats.astype(np.float64) / np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    axes = np.array(rows).transpose(2, 0, 1) * np.exp(log_scales.astype(np.float64))[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_encode_with_frames__keeps_the_splat_and_lowers_its_error():
    rng = np.random.default_rng(5)
    quats, log_scales = rng.normal(size=(5000, 4)).astype(np.float32), rng.uniform(-6, -1, (5000, 3)).astype(np.float32)
    source = covariances(quats, log_scales)

    def errors(codes, scales):
        return np.linalg.norm(covariances(quaternion_u8.decode(codes), scales) - source, axis=(1, 2)) / np.linalg.norm(
            source, axis=(1, 2)
        )

    plain = errors(quaternion_u8.encode(quats), log_scales)
    best = errors(*quaternion_u8.encode_with_frames(quats, log_scales))
    small = errors(*quaternion_u8.encode_with_frames(quats, log_scales, mode="small"))

    assert best.mean() <= 0.4 * plain.mean()
    assert best.max() <= 0.5 * plain.max()
    assert small.max() <= 2 * plain.max()


def test_encode_with_frames__small_takes_the_smallest_turn():
    quats = np.random.default_rng(6).normal(size=(5000, 4)).astype(np.float32)

    codes, log_scales = quaternion_u8.encode_with_frames(quats, np.tile(np.float32([1, 2, 3]), (5000, 1)), mode="small")

    # No rotation is further than 62.8 degrees from the nearest relabeling of the axes; 1 degree for the rounding.
    assert quaternion_u8.decode(codes)[:, 0].min() >= np.cos(np.deg2rad(63.8 / 2))
    np.testing.assert_array_equal(np.sort(log_scales, axis=1), np.tile([1, 2, 3], (5000, 1)))


def test_encode_with_frames__takes_flat_and_round_splats():
    quats = np.array([[1, 0, 0, 0], [0.3, 0.2, 0.1, 0.9], [0, 0, 0, 0]], np.float32)
    log_scales = np.array([[-np.inf] * 3, [-4] * 3, [0, 0, -np.inf]], np.float32)

    codes, permuted = quaternion_u8.encode_with_frames(quats, log_scales)

    np.testing.assert_array_equal(np.sort(permuted, axis=1), np.sort(log_scales, axis=1))
    assert (np.linalg.norm(codes.astype(int) - 128, axis=1) > 60).all()


def test_decode__is_unit_with_w_not_negative_for_every_code():
    codes = np.random.default_rng(2).integers(0, 256, (20_000, 4)).astype(np.uint8)
    codes[0] = 128

    quats = quaternion_u8.decode(codes)

    assert quats.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(quats.astype(np.float64), axis=1), 1, atol=2e-7)
    assert (quats[:, 0] >= 0).all()
    np.testing.assert_array_equal(quats[0], [1, 0, 0, 0])
