"""Palettes: exact search, small errors, the same bits at any number of threads."""

import numpy as np
import pytest

from gsplat_tools.codecs.palette import fit_palette, nearest_labels, principal_axes
from gsplat_tools.codecs.vector_search import pilot_rows
from gsplat_tools.parallel import use_jobs
from tests.oracles.clustering import nearest


def clusters(count: int, dimensions: int, centers: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points around centers, and the centers."""
    rng = np.random.default_rng(seed)
    middles = rng.normal(0, 1, (centers, dimensions))
    points = middles[rng.integers(0, centers, count)] + rng.normal(0, 0.01, (count, dimensions))
    return points.astype(np.float32), middles.astype(np.float32)


@pytest.mark.parametrize("dimensions", [3, 9, 45])
@pytest.mark.parametrize("size", [1, 2, 9, 300])
def test_nearest_labels__are_the_nearest(dimensions: int, size: int, rng: np.random.Generator) -> None:
    points = rng.normal(0, 1, (500, dimensions)).astype(np.float32)
    centroids = rng.normal(0, 1, (size, dimensions)).astype(np.float32)

    labels, distances = nearest_labels(points, centroids)

    _, expected = nearest(points, centroids)
    assert np.allclose(distances, expected, rtol=1e-4, atol=1e-6)
    assert np.allclose(((points - centroids[labels]) ** 2).sum(axis=1), distances, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("spread", [0.01, 1.0])
def test_nearest_labels__of_pieces_are_those_of_all(spread: float, rng: np.random.Generator) -> None:
    _, centroids = clusters(1, 15, 1500)
    points = centroids[rng.integers(0, 1500, 20_000)] + rng.normal(0, spread, (20_000, 15)).astype(np.float32)
    points[:4096] = rng.normal(0, 3, (4096, 15))  # searched otherwise where they are alone
    labels, distances = nearest_labels(points, centroids)
    pilot = points[pilot_rows(len(points))]

    pieces = [nearest_labels(points[start : start + 4096], centroids, pilot=pilot) for start in range(0, len(points), 4096)]

    assert np.array_equal(np.concatenate([found for found, _ in pieces]), labels)
    assert np.array_equal(np.concatenate([found for _, found in pieces]), distances)


def test_nearest_labels__of_equal_centroids_name_one_of_them() -> None:
    centroids = np.repeat(np.float32([[0, 0, 0], [1, 1, 1]]), 20, axis=0)

    labels, distances = nearest_labels(np.float32([[1, 1, 1], [0, 0, 0]]), centroids)

    assert (labels // 20).tolist() == [1, 0]
    assert distances.tolist() == [0, 0]


@pytest.mark.parametrize("dimensions", [4, 8, 9, 24, 45, 72])
@pytest.mark.parametrize("size", [1024, 1500])
def test_nearest_labels__among_cells_that_are_left_out_are_the_nearest(dimensions: int, size: int) -> None:
    points, middles = clusters(1500, dimensions, 40)
    centroids = np.concatenate([clusters(size - 40, dimensions, 40)[0], middles]) + np.float32(0.5)

    labels, distances = nearest_labels(points, centroids)

    _, expected = nearest(points, centroids)
    assert np.allclose(distances, expected, rtol=1e-4, atol=1e-6)
    assert np.allclose(((points - centroids[labels]) ** 2).sum(axis=1), expected, rtol=1e-4, atol=1e-6)


def test_nearest_labels__are_the_nearest_where_nothing_can_be_left_out(rng: np.random.Generator) -> None:
    points, centroids = (rng.normal(0, 1, (count, 45)).astype(np.float32) for count in (1100, 2100))

    labels, distances = nearest_labels(points, centroids)

    _, expected = nearest(points, centroids)
    assert np.allclose(distances, expected, rtol=1e-4, atol=1e-5)
    assert np.allclose(((points - centroids[labels]) ** 2).sum(axis=1), expected, rtol=1e-4)


def test_probes__trade_error_for_time(rng: np.random.Generator) -> None:
    spread = np.float32(0.8) ** np.arange(24, dtype=np.float32)
    points, centroids = (rng.normal(0, 1, (count, 24)).astype(np.float32) * spread for count in (2000, 4096))

    errors = [nearest_labels(points, centroids, probes=probes)[1] for probes in (1, 4, 16, 64, None)]

    means = [float(error.mean()) for error in errors]
    assert means == sorted(means, reverse=True)
    assert means[2] < 1.1 * means[4]
    assert np.array_equal(errors[3], errors[4])  # 64 cells are all of them
    assert all((error >= errors[4]).all() for error in errors)


def test_nearest_labels__of_equal_vectors_in_many_cells() -> None:
    points = np.zeros((300, 9), np.float32)

    labels, distances = nearest_labels(points, np.zeros((1200, 9), np.float32))

    assert (distances == 0).all()
    assert ((labels >= 0) & (labels < 1200)).all()


@pytest.mark.parametrize("probes", [None, 2])
def test_nearest_labels__have_the_same_bits_at_any_number_of_threads(rng: np.random.Generator, probes: int | None) -> None:
    points, _ = clusters(9000, 24, 60)
    centroids = points[rng.permutation(9000)[:2000]]
    results = []
    for jobs in (1, 2, 4):
        with use_jobs(jobs):
            results.append([array.tobytes() for array in nearest_labels(points, centroids, probes=probes)])

    assert results[0] == results[1] == results[2]


def test_far_from_the_origin__distances_keep_their_digits() -> None:
    points, centers = clusters(400, 9, 12)

    labels, _ = nearest_labels(points + 1000, centers + 1000)

    assert (labels == nearest(points, centers)[0]).mean() > 0.99


@pytest.mark.parametrize("dimensions", [3, 15])
def test_fit__finds_separate_clusters(dimensions: int) -> None:
    points, middles = clusters(4000, dimensions, 25)

    palette = fit_palette(points, np.ones(4000, np.float32), size=40, max_rounds=8)

    _, distances = nearest_labels(points, palette)
    assert len(palette) == 40
    assert distances.mean() < 1.1 * dimensions * 0.01**2
    assert len(middles) == 25


def test_fit__is_at_most_a_few_percent_above_converged_k_means(rng: np.random.Generator) -> None:
    points = rng.normal(0, 1, (3000, 3)).astype(np.float32)
    weights = np.ones(3000, np.float32)

    ours = nearest_labels(points, fit_palette(points, weights, size=64, max_rounds=8))[1].mean()

    best = np.inf
    for _ in range(4):
        centroids = points[rng.permutation(3000)[:64]].astype(np.float64)
        for _ in range(40):
            labels = ((points[:, None] - centroids) ** 2).sum(axis=2).argmin(axis=1)
            centroids = np.array([points[labels == k].mean(axis=0) if (labels == k).any() else centroids[k] for k in range(64)])
        best = min(best, ((points - centroids[labels]) ** 2).sum(axis=1).mean())
    assert ours <= 1.03 * best


def test_weights__draw_entries_to_what_counts() -> None:
    points = np.concatenate([np.random.default_rng(0).normal(x, 1, (500, 3)) for x in (-10, 10)]).astype(np.float32)
    weights = np.float32([100] * 500 + [1] * 500)

    palette = fit_palette(points, weights, size=20)

    assert (palette[:, 0] < 0).sum() > 12


def test_few_distinct_points__are_the_palette() -> None:
    points = np.float32([[0, 0, 1], [0, 0, 1], [2, 3, 4], [5, 5, 5]])[np.arange(100) % 4]

    palette = fit_palette(points, np.ones(100, np.float32), size=10)

    assert palette.tolist() == [[0, 0, 1], [2, 3, 4], [5, 5, 5]]


def test_fit__has_the_same_bits_at_any_number_of_threads(rng: np.random.Generator) -> None:
    points = rng.normal(0, 1, (30_000, 9)).astype(np.float32)
    weights = rng.random(30_000).astype(np.float32) + 0.1
    results = []
    for jobs in (1, 2, 4):
        with use_jobs(jobs):
            results.append(fit_palette(points, weights, size=200, max_rounds=2).tobytes())

    assert len(set(results)) == 1


def test_principal_axes__are_orthonormal_and_sorted(rng: np.random.Generator) -> None:
    points = (rng.normal(0, 1, (5000, 6)) * [1, 5, 2, 0.1, 3, 1]).astype(np.float32)

    center, axes = principal_axes(points, np.ones(5000, np.float32))

    assert np.allclose(axes.T @ axes, np.eye(6), atol=1e-5)
    assert (np.diff(((points - center) @ axes).var(axis=0)) <= 1e-3).all()
    assert np.allclose(center, points.mean(axis=0), atol=1e-5)


def test_fit__refuses_nothing_to_fit() -> None:
    with pytest.raises(ValueError, match="at least one point"):
        fit_palette(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), size=4)
    with pytest.raises(ValueError, match="at least 1"):
        fit_palette(np.zeros((2, 3), np.float32), np.ones(2, np.float32), size=0)


def test_fit__of_points_in_few_places_keeps_entries_for_all(rng: np.random.Generator) -> None:
    points = np.repeat(rng.normal(0, 1, (50, 9)).astype(np.float32), 20, axis=0)
    points += rng.normal(0, 1e-4, points.shape).astype(np.float32)

    palette = fit_palette(points, rng.random(1000).astype(np.float32) + np.float32(0.1), size=60, max_rounds=6)

    assert np.isfinite(palette).all()
    assert nearest_labels(points, palette)[1].max() < 1e-5


def test_more_rounds__err_less(rng: np.random.Generator) -> None:
    points = rng.normal(0, 1, (4000, 9)).astype(np.float32)
    weights = rng.random(4000).astype(np.float32) + np.float32(0.1)

    errors = [
        np.average(nearest_labels(points, fit_palette(points, weights, size=100, max_rounds=rounds))[1], weights=weights)
        for rounds in (0, 1, 3, 6)
    ]

    assert errors == sorted(errors, reverse=True)
