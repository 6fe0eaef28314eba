"""The depth sort: the exact bit map, the radix sort, and drawing orders."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsplat_tools import parallel
from gsplat_tools.reference import sorting
from gsplat_tools.reference.sorting import float_to_sortable, sort_by_depth, sort_pairs
from tests.clouds import random_cloud
from tests.reference.splats import camera, splats

SPECIALS = np.array(
    [0.0, -0.0, np.inf, -np.inf, np.nan, -np.nan, 1e-45, -1e-45, 1.1754942e-38, -1.1754942e-38, 3.4e38, -3.4e38, 1.0, -1.0],
    np.float32,
)


def stable(keys, payload):  # type: ignore[no-untyped-def]
    order = np.argsort(keys, kind="stable")
    return keys[order], payload[order]


@given(hnp.arrays(np.uint32, st.integers(0, 300), elements=st.integers(0, 2**32 - 1)))
def test_float_to_sortable__orders_bits_as_floats(bits: np.ndarray) -> None:
    values = np.concatenate([bits.view(np.float32), SPECIALS])
    numbers = values[~np.isnan(values)]

    keys = float_to_sortable(numbers).astype(np.int64)

    # Equal floats are -0 and +0, or the same bits.
    i, j = np.triu_indices(min(len(numbers), 60))
    less = numbers[i] < numbers[j]
    assert np.array_equal((keys[i] < keys[j])[less], less[less])
    more = numbers[i] > numbers[j]
    assert np.array_equal((keys[i] > keys[j])[more], more[more])


def test_float_to_sortable__maps_known_values() -> None:
    values = np.array([-np.inf, -1.0, -0.0, 0.0, 1.0, np.inf], np.float32)

    assert float_to_sortable(values).tolist() == [0x007FFFFF, 0x407FFFFF, 0x7FFFFFFF, 0x80000000, 0xBF800000, 0xFF800000]
    assert len(np.unique(float_to_sortable(SPECIALS))) == len(SPECIALS)  # one to one, NaNs too
    assert float_to_sortable(values.reshape(2, 3)).shape == (2, 3)


@pytest.mark.parametrize("count", [0, 1, 2, 255, 256, 257, 4095, 4096, 4097])
@pytest.mark.parametrize("bits", [32, 12, 3])
def test_sort_pairs__is_the_stable_sort(count: int, bits: int, rng) -> None:  # type: ignore[no-untyped-def]
    keys = rng.integers(0, 1 << bits, count, dtype=np.uint32)
    payload = rng.integers(0, 1 << 32, count, dtype=np.uint32)
    untouched = keys.copy(), payload.copy()

    got = sort_pairs(keys, payload)

    assert np.array_equal(got, stable(keys, payload))
    assert np.array_equal((keys, payload), untouched)


@pytest.mark.parametrize("count", [2**20 - 1, 2**20, 2**20 + 1])
def test_sort_pairs__is_the_stable_sort_across_blocks(count: int, rng) -> None:  # type: ignore[no-untyped-def]
    keys = float_to_sortable(rng.random(count, dtype=np.float32) * 100)

    assert np.array_equal(sort_pairs(keys, np.arange(count, dtype=np.uint32)), stable(keys, np.arange(count)))


@given(hnp.arrays(np.uint32, st.integers(0, 2000), elements=st.sampled_from([0, 1, 255, 256, 65536, 1 << 24, 0xFFFFFFFF])))
def test_sort_pairs__keeps_ties_in_order_across_small_blocks(keys: np.ndarray) -> None:
    payload = np.arange(len(keys), dtype=np.uint32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sorting, "_BLOCK_SIZE", 64)
        got = sort_pairs(keys, payload)

    assert np.array_equal(got, stable(keys, payload))


def test_sort_pairs__of_equal_keys_changes_nothing() -> None:
    keys = np.full(1000, 0xDEADBEEF, np.uint32)
    payload = np.arange(1000, dtype=np.uint32)[::-1].copy()

    assert np.array_equal(sort_pairs(keys, payload), (keys, payload))


def test_sort_pairs__gives_the_same_bits_for_any_number_of_threads(rng, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(sorting, "_BLOCK_SIZE", 1000)
    keys = rng.integers(0, 50, 20_000, dtype=np.uint32)
    results = []
    for jobs in (1, 2, 4, 8):
        with parallel.use_jobs(jobs):
            results.append(np.stack(sort_pairs(keys, np.arange(20_000, dtype=np.uint32))).tobytes())

    assert len(set(results)) == 1


@pytest.mark.parametrize(
    ("keys", "payload", "message"),
    [
        (np.zeros(3, np.int32), np.zeros(3, np.uint32), "keys must be"),
        (np.zeros(3, np.uint32), np.zeros(3, np.float32), "payload must be"),
        (np.zeros((3, 1), np.uint32), np.zeros(3, np.uint32), "keys must be"),
        (np.zeros(3, np.uint32), np.zeros(4, np.uint32), "equal in length"),
    ],
)
def test_sort_pairs__refuses_other_arrays(keys, payload, message) -> None:
    with pytest.raises(ValueError, match=message):
        sort_pairs(keys, payload)


@pytest.mark.parametrize("metric", ["depth", "radial"])
def test_sort_by_depth__puts_far_splats_first(metric) -> None:  # type: ignore[no-untyped-def]
    cloud = random_cloud(500)
    distances = cloud.means[:, 2] if metric == "depth" else np.linalg.norm(cloud.means.astype(np.float64), axis=1)

    order = sort_by_depth(cloud, camera(), metric=metric)

    assert order.dtype == np.uint32
    assert np.array_equal(np.sort(order), np.arange(500))
    assert np.diff(distances[order]).max() <= 1e-6


def test_sort_by_depth__keeps_ties_in_the_order_of_the_splats() -> None:
    cloud = splats([(x, 0, z) for x, z in ((0, 1), (1, 2), (2, 1), (3, 2), (4, 2))])

    assert sort_by_depth(cloud, camera()).tolist() == [1, 3, 4, 0, 2]


def test_sort_by_depth__puts_hidden_splats_and_nan_last_in_order() -> None:
    means = np.array([(0, 0, 1), (0, 0, np.nan), (0, 0, 9), (0, 0, 3), (0, 0, -np.inf), (0, 0, 5)], np.float32)
    cloud = splats(means, velocities=np.zeros((6, 3)), times=np.array([0, 0, 0.9, 0, 0, 0.2]), durations=np.full(6, 0.5))

    with np.errstate(invalid="ignore"):
        order = sort_by_depth(cloud, camera(), t=0.3)

    assert order.tolist() == [5, 3, 0, 4, 1, 2]


def test_sort_by_depth__starts_from_a_given_payload() -> None:
    cloud = random_cloud(100)
    payload = np.array([7, 99, 3, 50], np.uint32)

    order = sort_by_depth(cloud, camera(), order=payload)

    assert np.array_equal(order, payload[np.argsort(-cloud.means[payload, 2], kind="stable")])


def test_sort_by_depth__of_visionary_ties_what_its_key_cannot_part() -> None:
    """With far / near = 1e7 float32 keys near 1e5 are 2^-7 apart: splats nearer than that keep their order."""
    cloud = splats([(0, 0, 1.0), (0, 0, 1.001), (0, 0, 3.0)])
    view = camera(near=0.01, far=1e5)

    assert sort_by_depth(cloud, view).tolist() == [2, 1, 0]
    assert sort_by_depth(cloud, view, metric="clip").tolist() == [2, 0, 1]


def test_sort_by_depth__of_visionary_agrees_with_the_depth_where_it_can() -> None:
    cloud = random_cloud(300)
    cloud = cloud.replace(means=cloud.means + np.array([0, 0, 10], np.float32))
    order = sort_by_depth(cloud, camera(near=0.1, far=100.0), metric="clip")

    assert np.diff(cloud.means[order, 2]).max() <= 2e-5


def test_sort_by_depth__refuses_what_is_not_there() -> None:
    with pytest.raises(ValueError, match="metric must be one of"):
        sort_by_depth(random_cloud(3), camera(), metric="manhattan")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"name splats 0\.\.2"):
        sort_by_depth(random_cloud(3), camera(), order=np.array([3], np.uint32))
