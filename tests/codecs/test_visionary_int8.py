"""Our int8: ranges, their calibration, and sorted axes."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.codecs import quaternion_u8
from gsplat_tools.codecs import visionary_int8 as codec


def test_ranges__err_by_half_a_step_inside_and_by_the_distance_outside(rng: np.random.Generator) -> None:
    values = rng.normal(size=(4000, 3)) * [1, 100, 1e-3] + [0, 5, -7]
    ranges = codec.make_ranges([-1, -200, -7.001], [1, 200, -6.999])

    codes, clamped = ranges.encode(values)
    errors = np.abs(ranges.decode(codes) - values)

    outside = np.maximum(np.maximum(ranges.low - values, values - ranges.high), 0)
    assert (errors <= outside + ranges.max_error + 2.0**-23 * np.abs(values)).all()
    assert errors.max(axis=0)[1] > 0.9 * ranges.max_error[1]
    assert np.abs(codes).max() == 127
    assert clamped == pytest.approx(np.count_nonzero(outside > ranges.max_error), abs=20)


def test_make_ranges__hold_their_ends_in_spite_of_float32() -> None:
    low, high = np.array([1e6 + 0.1, 3.0, -1e-20]), np.array([1e6 + 0.3, 3.0, 1e-20])

    ranges = codec.make_ranges(low, high)

    assert (ranges.low <= low).all()
    assert (ranges.high >= high).all()
    assert (ranges.scales > 0).all()


def test_clipped_ranges__leave_out_a_share_at_either_end() -> None:
    values = np.arange(1001.0)[:, None]
    values = np.concatenate([values, np.where(values < 500, -np.inf, values)], axis=1)

    whole, cut = codec.clipped_ranges(values, 0.0), codec.clipped_ranges(values, 0.1)

    assert whole.low == pytest.approx([0, 500], abs=1e-3)
    assert whole.high == pytest.approx([1000, 1000], abs=1e-3)
    assert cut.low == pytest.approx([100, 550], abs=1e-2)
    assert cut.high == pytest.approx([900, 950], abs=1e-2)


def test_calibrated_ranges__give_up_outliers_only_where_that_pays(rng: np.random.Generator) -> None:
    values = rng.uniform(-1, 1, (20_000, 2))
    values[0] = 40.0, 1.2

    ranges = codec.calibrated_ranges(values, np.ones(len(values)))
    heavy = codec.calibrated_ranges(values, np.where(np.arange(len(values)) == 0, 1e9, 1.0))

    # 20,000 values with steps forty times as coarse lose 22, against the 1,500 of the outlier; a weight turns that over.
    whole = codec.clipped_ranges(values, 0.0)

    def loss(ranges: codec.Ranges) -> np.ndarray:
        return np.square(ranges.decode(ranges.encode(values)[0]) - values).sum(axis=0)

    assert (loss(ranges) <= loss(whole) * 1.05).all()
    assert heavy.high[0] == pytest.approx(40, rel=1e-3)


def test_calibrated_ranges__of_log_scales_do_not_care_for_thin_axes(rng: np.random.Generator) -> None:
    logs = rng.uniform(-4, -2, (20_000, 2))
    logs[:, 1] = np.where(rng.random(len(logs)) < 0.05, -30.0, logs[:, 1])

    ranges = codec.calibrated_ranges(logs, np.ones(len(logs)), np.exp(logs.max(axis=1)))

    assert ranges.low[0] > -4.5
    assert -15 < ranges.low[1] < -3


def test_calibrated_ranges__of_nothing_finite_are_empty() -> None:
    ranges = codec.calibrated_ranges(np.full((5, 1), -np.inf), np.ones(5), np.ones(5))

    assert ranges.zeros.tolist() == [0.0]
    assert ranges.scales[0] > 0


@pytest.mark.parametrize("count", [0, 500])
def test_sort_axes__keeps_every_covariance_but_for_rounding(rng: np.random.Generator, count: int) -> None:
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    logs = rng.uniform(-5, 0, (count, 3)).astype(np.float32)

    codes, ordered = codec.sort_axes(quats, logs)

    assert (np.diff(ordered, axis=1) <= 0).all()
    assert np.array_equal(np.sort(ordered, axis=1), np.sort(logs, axis=1))
    decoded = quaternion_u8.decode((codes.astype(np.int16) + 128).astype(np.uint8))
    for q, s, r, t in zip(quats, logs, decoded, ordered, strict=True):
        first, second = _axes(q) * np.exp(s), _axes(r) * np.exp(t)
        difference = first @ first.T - second @ second.T
        assert np.linalg.norm(difference) <= 2 * np.sin(quaternion_u8.MAX_ANGLE) * np.linalg.norm(first @ first.T)


def _axes(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat.astype(np.float64) / np.linalg.norm(quat.astype(np.float64))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_block_ranges__are_those_of_256_splats(rng: np.random.Generator) -> None:
    means = rng.normal(size=(600, 3)).astype(np.float32)

    ranges = codec.block_ranges(means, 32767)

    assert ranges.scales.shape == (3, 3)
    for block in range(3):
        part = means[256 * block : 256 * block + 256]
        assert (ranges.low[block] <= part.min(axis=0)).all()
        assert (ranges.high[block] >= part.max(axis=0)).all()
        assert np.ptp(part, axis=0) / 65534 == pytest.approx(ranges.scales[block], rel=1e-4)
