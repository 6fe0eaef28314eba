"""Codes moved to cheap neighbors: the best choice, and never further than allowed."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.codecs import relaxation
from gsplat_tools.kernels import relaxation as kernels
from gsplat_tools.parallel import use_jobs
from tests.oracles import relaxation as oracle

MOST = 16.0


def random_bits(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.uniform(1, 12, shape).astype(np.float32)


@pytest.mark.uncompiled
@pytest.mark.parametrize(("low", "high"), [(0, 255), (0, 65535)])
def test_relax_numbers__finds_the_best_of_all_codes(low: int, high: int) -> None:
    rng = np.random.default_rng(0)
    targets = np.concatenate([rng.uniform(low, high, 60), [low, high, low + 0.4, high - 0.4]])
    costs = np.exp(rng.uniform(-12, 4, len(targets)))
    bits = random_bits(rng, 256)
    codes = np.zeros(len(targets), np.int64)

    kernels.relax_numbers(targets, costs, bits, 3.0, MOST, low, high, 0, len(targets), codes)

    expected = [
        oracle.best_number(t, c, bits.astype(np.float64), 3.0, MOST, low, high) for t, c in zip(targets, costs, strict=True)
    ]
    assert codes.tolist() == expected


@pytest.mark.uncompiled
def test_relax_colors__finds_the_best_of_all_triples() -> None:
    rng = np.random.default_rng(1)
    codebook = np.sort(rng.normal(0, 1, 24)).astype(np.float32)
    targets = rng.normal(0, 1, (40, 3)).astype(np.float32)
    costs = np.exp(rng.uniform(-3, 8, 40))
    bits = random_bits(rng, 3, 256)
    nearest = np.abs(targets[:, :, None].astype(np.float64) - codebook).argmin(axis=2).astype(np.uint8)
    codes = nearest.copy()

    kernels.relax_colors(targets, costs, codebook, bits, 24, MOST, 0, 40, codes)

    for i in range(40):
        r, g, b = codes[i].astype(int)
        distances = costs[i] * (codebook[codes[i]].astype(np.float64) - targets[i]) ** 2
        total = distances.sum() + bits[0, (r - g) & 255] + bits[1, g] + bits[2, (b - g) & 255]
        assert total == pytest.approx(oracle.best_color(targets[i], costs[i], codebook, bits, nearest[i], MOST), rel=1e-6)
        assert ((distances <= MOST) | (codes[i] == nearest[i])).all()


@pytest.mark.uncompiled
def test_relax_rotations__costs_what_the_matrices_say_and_never_more_than_allowed() -> None:
    rng = np.random.default_rng(2)
    quats = rng.normal(size=(60, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    quats[quats[:, 0] < 0] *= -1
    start = (np.rint(quats * 100) + 128).astype(np.uint8)
    costs = np.exp(rng.uniform(-4, 10, (60, 3)))
    bits = random_bits(rng, 4, 256)
    codes = start.copy()

    kernels.relax_rotations(quats, costs, bits, MOST, 0.342, 0, 60, codes)

    def total(row: np.ndarray, i: int) -> tuple[float, float, float]:
        cost, angle = oracle.turn_cost(quats[i], row.astype(np.float64) - 128, costs[i])
        return cost + sum(float(bits[k, row[k]]) for k in range(4)), cost, angle

    for i in range(60):
        before, after = total(start[i], i), total(codes[i], i)
        assert after[0] <= before[0] + 1e-5
        if not np.array_equal(start[i], codes[i]):
            assert after[1] <= MOST * (1 + 1e-6)
            assert np.sin(after[2] / 2) <= 0.342 * (1 + 1e-6)
    assert (start != codes).any(axis=1).mean() > 0.5


def test_relax_labels__takes_the_best_of_all_entries() -> None:
    rng = np.random.default_rng(3)
    centroids = rng.normal(size=(40, 5)).astype(np.float32)
    points = rng.normal(size=(200, 5)).astype(np.float32)
    costs = np.exp(rng.uniform(-4, 4, 200))
    bits = random_bits(rng, 40)
    squares = ((points[:, None, :].astype(np.float64) - centroids) ** 2).sum(axis=2)
    labels = squares.argmin(axis=1)
    chosen = labels.copy()

    kernels.relax_labels(points, costs, centroids, bits, np.argsort(bits, kind="stable"), MOST, 0, 200, chosen)

    added = costs[:, None] * (squares - squares.min(axis=1, keepdims=True))
    totals = np.where(added < MOST, costs[:, None] * squares + bits, np.inf)
    rows = np.arange(200)
    assert np.allclose(totals[rows, chosen], totals.min(axis=1), rtol=1e-9)


def test_numbers__cost_fewer_bits_the_less_they_show() -> None:
    rng = np.random.default_rng(4)
    targets = rng.uniform(0, 65535, 5000)
    lengths = []
    for cost in (10.0, 1e-1, 1e-2, 1e-3):
        codes = relaxation.relax_numbers(targets, np.full(5000, cost), low=0, high=65535, most=MOST)
        counts = np.bincount(codes & 255, minlength=256)
        shares = counts[counts > 0] / 5000
        lengths.append(float(-(shares * np.log2(shares)).sum()))
        assert np.abs(codes - targets).max() <= max(0.5, np.sqrt(MOST / cost))

    # An error of s^2 / 12 in steps of s balances at 2^-bits: a tenth of the cost is log2(10) / 2 bits, once steps are whole.
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[1] - lengths[3] == pytest.approx(np.log2(100) / 2, abs=0.8)


def test_numbers_that_show__are_rounded() -> None:
    targets = np.random.default_rng(5).uniform(0, 65535, 1000)

    codes = relaxation.relax_numbers(targets, np.full(1000, 1e9), low=0, high=65535, most=MOST)

    assert np.array_equal(codes, np.rint(targets))


def test_choices__do_not_depend_on_threads() -> None:
    rng = np.random.default_rng(6)
    targets, costs = rng.uniform(0, 65535, 20_000), np.exp(rng.uniform(-9, 2, 20_000))

    results = []
    for jobs in (1, 3):
        with use_jobs(jobs):
            results.append(relaxation.relax_numbers(targets, costs, low=0, high=65535, most=MOST))

    assert np.array_equal(*results)
