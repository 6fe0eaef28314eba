import numpy as np
import pytest

from gsplat_tools.reference.cutouts import Cutout, apply_cutouts
from tests.reference.splats import splats

POINTS = [(0, 0, 0), (0.9, 0.9, 0.9), (1, 0, 0), (1.1, 0, 0), (-1, -1, -1)]


@pytest.mark.parametrize(
    ("kind", "invert", "left"),
    [
        ("ellipsoid", False, [0, 2]),
        ("ellipsoid", True, [1, 3, 4]),
        ("box", False, [0, 1, 2, 4]),
        ("box", True, [3]),
        ("none", False, [0, 1, 2, 3, 4]),
        ("none", True, [0, 1, 2, 3, 4]),
    ],
)
def test_apply_cutouts__hides_outside_or_inside(kind, invert, left) -> None:  # type: ignore[no-untyped-def]
    survivors, bounds = apply_cutouts(splats(POINTS), [Cutout(np.eye(4), kind, invert)])

    assert survivors.tolist() == left
    assert survivors.dtype == np.uint32
    kept = np.array(POINTS, np.float32)[left]
    assert np.array_equal(bounds, (kept.min(axis=0), kept.max(axis=0)))


def test_apply_cutouts__hides_what_any_of_them_hides() -> None:
    outer = Cutout(np.diag([0.5, 0.5, 0.5, 1]), "box")
    inner = Cutout(np.eye(4), "ellipsoid", invert=True)
    survivors, _ = apply_cutouts(splats(POINTS), [outer, inner])

    assert survivors.tolist() == [1, 3, 4]
    assert apply_cutouts(splats(POINTS), [inner, Cutout(np.eye(4), "ellipsoid")])[1] is None


def test_apply_cutouts__measures_from_the_origin_and_at_the_time() -> None:
    matrix = np.eye(4)
    matrix[0, 3] = -1e6
    cloud = splats(
        [(0, 0, 0), (-3, 0, 0)],
        origin=np.array([1e6, 0, 0]),
        velocities=np.array([[0, 0, 0], [4, 0, 0]]),
        times=np.zeros(2),
        durations=np.ones(2),
    )

    assert apply_cutouts(cloud, [Cutout(matrix)])[0].tolist() == [0]
    assert apply_cutouts(cloud, [Cutout(matrix)], t=0.75)[0].tolist() == [0, 1]


def test_cutout__refuses_what_is_none() -> None:
    with pytest.raises(ValueError, match=r"\(4, 4\)"):
        Cutout(np.eye(3))
    with pytest.raises(ValueError, match="kind"):
        Cutout(np.eye(4), "sphere")  # type: ignore[arg-type]
