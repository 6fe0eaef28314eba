"""The passes of the radix sort, one by one, against numpy."""

import numpy as np
import pytest

from gsplat_tools.kernels import radix_sort

pytestmark = pytest.mark.uncompiled


def words_of(keys, payload):  # type: ignore[no-untyped-def]
    return (keys.astype(np.uint64) << np.uint64(32)) | payload


@pytest.mark.parametrize("shift", [0, 8, 16, 24])
def test_upsweep__counts_the_digits_of_the_key(shift: int, rng) -> None:  # type: ignore[no-untyped-def]
    keys = rng.integers(0, 1 << 32, 1000, dtype=np.uint32)
    counts = np.zeros(256, np.int64)

    radix_sort.upsweep(words_of(keys, np.full(1000, 0xFFFFFFFF, np.uint32)), shift, 100, 900, counts)

    assert np.array_equal(counts, np.bincount((keys[100:900] >> shift) & 255, minlength=256))


def test_scan__gives_each_block_its_place_in_each_digit(rng) -> None:  # type: ignore[no-untyped-def]
    counts = rng.integers(0, 5, (3, 256)).astype(np.int64)
    offsets = np.empty_like(counts)

    found = radix_sort.scan(counts, offsets)

    by_digit = counts.T.ravel()  # digits first, then blocks
    assert np.array_equal(offsets.T.ravel(), np.cumsum(by_digit) - by_digit)
    assert found == np.count_nonzero(counts.sum(axis=0))


def test_downsweep__keeps_the_order_of_equal_digits() -> None:
    keys = np.array([3, 1, 3, 1, 2], np.uint32)
    words = words_of(keys, np.arange(5, dtype=np.uint32))
    offsets = np.zeros(256, np.int64)
    offsets[[1, 2, 3]] = 0, 2, 3
    out = np.zeros(5, np.uint64)

    radix_sort.downsweep(words, 0, 0, 5, offsets, out)

    assert (out & np.uint64(0xFFFFFFFF)).tolist() == [1, 3, 4, 0, 2]


def test_words__join_and_split_without_loss(rng) -> None:  # type: ignore[no-untyped-def]
    keys, payload = (rng.integers(0, 1 << 32, 300, dtype=np.uint32) for _ in range(2))
    words = np.empty(300, np.uint64)
    out = np.empty((2, 300), np.uint32)
    counts = np.zeros(256, np.int64)

    radix_sort.join_words(keys, payload, 0, 300, words, counts)
    radix_sort.split_words(words, 0, 300, out[0], out[1])

    assert np.array_equal(out, [keys, payload])
    assert np.array_equal(counts, np.bincount(keys & 255, minlength=256))
    radix_sort.join_words(keys, np.empty(0, np.uint32), 0, 300, words, counts)
    assert np.array_equal(words & np.uint64(0xFFFFFFFF), np.arange(300))
