import numpy as np
import pytest

from gsplat_tools.chunks import as_chunks
from gsplat_tools.cloud import GaussianCloud, concatenate
from gsplat_tools.errors import CloudError
from tests.clouds import random_cloud


def test_cloud__makes_arrays_contiguous_float32() -> None:
    cloud = random_cloud(5)

    changed = cloud.replace(means=np.asfortranarray(cloud.means.astype(np.float64)))

    assert changed.means.dtype == np.float32
    assert changed.means.flags.c_contiguous
    assert np.array_equal(changed.means, cloud.means)


@pytest.mark.parametrize(
    ("field", "shape"),
    [
        ("means", (5, 2)),
        ("log_scales", (4, 3)),
        ("quats", (5, 3)),
        ("opacity_logits", (5, 1)),
        ("sh0", (5,)),
        ("shN", (5, 7, 3)),
    ],
)
def test_cloud__names_the_array_of_the_wrong_shape(field: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(CloudError) as caught:
        random_cloud(5).replace(**{field: np.zeros(shape, np.float32)})

    assert caught.value.field == field
    assert str(shape) in str(caught.value)


@pytest.mark.parametrize(("coefficients", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3), (24, 4)])
def test_cloud__knows_its_degree(coefficients: int, degree: int) -> None:
    assert random_cloud(2).replace(shN=np.zeros((2, coefficients, 3))).sh_degree == degree


def test_cloud__wants_all_of_motion_or_none() -> None:
    with pytest.raises(CloudError, match="durations, times missing"):
        random_cloud(3).replace(velocities=np.zeros((3, 3)))


def test_cloud__selects_extras_along() -> None:
    cloud = random_cloud(6).replace(extra={"label": np.arange(6, dtype=np.int16)})

    taken = cloud.take(np.array([4, 1]))

    assert taken.extra["label"].tolist() == [4, 1]
    assert taken.extra["label"].dtype == np.int16
    assert np.array_equal(taken.means, cloud.means[[4, 1]])


def test_concatenate__restores_what_chunks_cut() -> None:
    cloud = random_cloud(100, motion=True)

    whole = concatenate(list(as_chunks(cloud, 7)))

    for name, values in cloud.arrays().items():
        assert np.array_equal(getattr(whole, name), values), name


def test_concatenate__refuses_clouds_of_different_degree() -> None:
    with pytest.raises(CloudError, match="cloud 1 has 1, the first 3"):
        concatenate([random_cloud(2, sh_degree=3), random_cloud(2, sh_degree=1)])


def test_chunks__apply_a_function_on_every_pass() -> None:
    cloud = random_cloud(50)
    chunks = as_chunks(cloud, 8).map(lambda chunk: chunk.take(chunk.means[:, 0] > 0))

    first, second = chunks.read(), chunks.read()

    assert np.array_equal(first.means, cloud.means[cloud.means[:, 0] > 0])
    assert np.array_equal(first.means, second.means)


def test_bounds__are_in_the_world() -> None:
    cloud = random_cloud(2).replace(means=np.array([[0, 1, 2], [3, -4, 5]]), origin=np.array([1e6, 0, 0]))

    box = np.array(cloud.bounds())

    assert box.tolist() == [[1e6, -4, 2], [1e6 + 3, 1, 5]]


def test_bounds__of_nothing_is_none() -> None:
    assert random_cloud(0).bounds() is None
    assert isinstance(random_cloud(0), GaussianCloud)
