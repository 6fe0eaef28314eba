import numpy as np
import pytest

from gsplat_tools.errors import CapabilityError
from gsplat_tools.reference import global_sort
from gsplat_tools.reference.global_sort import sort_scenes, split_entries
from gsplat_tools.reference.sorting import sort_by_depth
from tests.clouds import random_cloud
from tests.reference.splats import camera, splats


def moved(x, y, z):  # type: ignore[no-untyped-def]
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def test_sort_scenes__merges_by_depth_in_the_world() -> None:
    scenes = [random_cloud(100, seed=1), random_cloud(70, seed=2)]
    turned = moved(0, 0, 6)
    turned[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) * 2.0
    matrices = [moved(0, 0, 5), turned]

    order = sort_scenes(scenes, matrices, camera())
    scene_ids, splat_ids = split_entries(order)

    depths = np.array([(matrices[a] @ [*scenes[a].means[i], 1])[2] for a, i in zip(scene_ids, splat_ids, strict=True)])
    assert len(order) == 170
    assert np.diff(depths).max() < 1e-5
    assert sorted(zip(scene_ids.tolist(), splat_ids.tolist(), strict=True)) == [(0, i) for i in range(100)] + [
        (1, i) for i in range(70)
    ]


def test_sort_scenes__of_one_scene_is_its_own_order() -> None:
    cloud = random_cloud(50)

    assert np.array_equal(sort_scenes([cloud], [np.eye(4)], camera()), sort_by_depth(cloud, camera()))
    assert len(sort_scenes([], [], camera())) == 0


def test_sort_scenes__puts_the_first_scene_first_on_ties() -> None:
    scene = splats([(0, 0, 2), (0, 0, 1)])

    order = sort_scenes([scene, scene, scene], [np.eye(4), np.eye(4), moved(0, 0, 1)], camera())

    assert [tuple(entry) for entry in np.stack(split_entries(order), axis=1).tolist()] == [
        (2, 0), (0, 0), (1, 0), (2, 1), (0, 1), (1, 1)
    ]  # fmt: skip


def test_sort_scenes__refuses_what_an_entry_cannot_name(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    scene = splats((0, 0, 1))
    with pytest.raises(CapabilityError, match="256 scenes, got 257"):
        sort_scenes([scene] * 257, [np.eye(4)] * 257, camera())
    monkeypatch.setattr(global_sort, "MAX_SPLATS", 2)
    with pytest.raises(CapabilityError, match="at most 2 splats"):
        sort_scenes([splats([(0, 0, 1)] * 3)], [np.eye(4)], camera())
    with pytest.raises(ValueError, match="a matrix for each"):
        sort_scenes([scene], [], camera())
    with pytest.raises(ValueError, match=r"matrix 0 must be \(4, 4\)"):
        sort_scenes([scene], [np.eye(3)], camera())
