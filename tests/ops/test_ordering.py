"""Orders are permutations that keep neighbors together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.kernels.morton import hilbert_path, morton_codes
from gsplat_tools.ops.ordering import (
    cell_codes,
    hilbert2d_order,
    image_layout,
    morton_order,
    order_of_codes,
    order_splats,
    splat_order,
)
from gsplat_tools.parallel import use_jobs
from tests.clouds import random_cloud
from tests.oracles.clustering import morton_code


def test_morton_codes__interleave_cells(rng: np.random.Generator) -> None:
    means = rng.integers(0, 1 << 21, (200, 3)).astype(np.float32)
    codes = np.empty(200, np.uint64)

    morton_codes(means, np.zeros(3), np.ones(3), 0, 200, codes)

    assert codes.tolist() == [morton_code(row) for row in means]


def test_morton_order__sorts_by_code_and_keeps_ties_in_order() -> None:
    corners = np.float32([[1, 1, 1], [0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]])

    assert morton_order(corners).tolist() == [4, 3, 5, 2, 1, 0]


@pytest.mark.parametrize(
    "means", [np.zeros((0, 3)), np.ones((1, 3)), np.full((5, 3), 7.0), np.eye(3) * 1e-38, np.eye(3) * 3e38]
)
def test_orders__of_odd_scenes_are_permutations(means: np.ndarray) -> None:
    for order in (morton_order(means.astype(np.float32)), hilbert2d_order(means.astype(np.float32))):
        assert np.sort(order).tolist() == list(range(len(means)))
        assert order.dtype == np.uint32


def test_morton_order__keeps_neighbors_together(rng: np.random.Generator) -> None:
    means = rng.random((2000, 3)).astype(np.float32)

    steps = np.linalg.norm(np.diff(means[morton_order(means)], axis=0), axis=1)

    assert steps.mean() < 0.25 * np.linalg.norm(np.diff(means, axis=0), axis=1).mean()


def test_morton_order__is_the_same_at_any_number_of_threads(rng: np.random.Generator) -> None:
    means = rng.random((150_000, 3)).astype(np.float32)
    with use_jobs(1):
        one = morton_order(means)
    with use_jobs(4):
        four = morton_order(means)

    assert np.array_equal(one, four)


@given(width=st.integers(1, 40), height=st.integers(1, 40))
def test_hilbert_path__visits_every_pixel_once_in_short_steps(width: int, height: int) -> None:
    xs, ys = np.full(width * height, -1, np.int32), np.full(width * height, -1, np.int32)

    hilbert_path(width, height, xs, ys)

    assert sorted(zip(ys.tolist(), xs.tolist(), strict=True)) == [(y, x) for y in range(height) for x in range(width)]
    steps = np.abs(np.diff(xs)) + np.abs(np.diff(ys))
    assert (steps <= 2).all()
    assert (steps == 2).sum() <= 1  # one diagonal step where both sides are odd or the longer one is


def test_hilbert2d__puts_the_path_through_space_on_the_path_through_the_image(rng: np.random.Generator) -> None:
    means = rng.random((1000, 3)).astype(np.float32)
    width, height = image_layout(1000)

    order = hilbert2d_order(means, (width, height))

    place = np.empty(1000, np.int64)
    place[morton_order(means)] = np.arange(1000)
    ranks = place[order].astype(float)  # rank in space of the splat at each pixel
    image = np.append(ranks, [np.nan] * (width * height - 1000)).reshape(height, width)
    # Row-major, vertical neighbors would be `width` ranks apart at least.
    assert np.nanmedian(np.abs(np.diff(image, axis=0))) < width


def test_splat_order__knows_three_methods() -> None:
    cloud = random_cloud(30)

    assert splat_order(cloud, "none").tolist() == list(range(30))
    assert np.array_equal(order_splats(cloud, "morton").means, cloud.means[morton_order(cloud.means)])
    assert order_splats(cloud, "none") is cloud
    with pytest.raises(ValueError, match="hilbert2d"):
        splat_order(cloud, "random")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fewer pixels"):
        splat_order(cloud, "hilbert2d", (5, 5))


@pytest.mark.parametrize(("count", "layout"), [(0, (1, 1)), (1, (1, 1)), (2, (2, 1)), (4721, (69, 69)), (58649, (243, 242))])
def test_image_layout__is_nearly_square(count: int, layout: tuple[int, int]) -> None:
    assert image_layout(count) == layout


@pytest.mark.parametrize("method", ["morton", "hilbert2d", "none"])
def test_orders__follow_from_the_cells_of_pieces(method: str, rng: np.random.Generator) -> None:
    means = rng.normal(0, 1, (5000, 3)).astype(np.float32)
    low, high = means.min(axis=0), means.max(axis=0)
    codes = np.concatenate([cell_codes(part, low, high) for part in np.array_split(means, 7)])
    cloud = random_cloud(5000, sh_degree=0).replace(means=means)
    assert np.array_equal(order_of_codes(codes, method), splat_order(cloud, method))  # type: ignore[arg-type]
