import json

import numpy as np
import pytest

from gsplat_tools.errors import CorruptDataError
from gsplat_tools.reference.camera import Camera, load_cameras, parse_cameras


def project(camera, point):  # type: ignore[no-untyped-def]
    x, y, z = (camera.viewmat @ [*point, 1])[:3]
    return camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2], z


def test_look_at__shows_right_and_up_where_they_are() -> None:
    # RDF: seen from (0, 0, -5) along +z with up = -y, x goes right and y goes down.
    camera = Camera.look_at((0, 0, -5), (0, 0, 0), fov_y=60, width=200, height=100)

    assert project(camera, (0, 0, 0)) == pytest.approx((100, 50, 5))
    assert project(camera, (1, 0, 0))[0] > 100
    assert project(camera, (0, 1, 0))[1] > 50
    assert np.linalg.det(camera.viewmat[:3, :3]) == pytest.approx(1)
    assert camera.position == pytest.approx([0, 0, -5])


def test_look_at__spans_the_vertical_field_of_view() -> None:
    camera = Camera.look_at((3, 1, 2), (3, 1, 7), fov_y=90, width=300, height=100)

    # At 45 degrees above the axis lies the upper edge.
    assert project(camera, (3, 1 - 5, 7))[1] == pytest.approx(0)
    assert camera.K[0, 0] == camera.K[1, 1] == pytest.approx(50)


def test_look_at__takes_another_up_than_the_line_of_sight() -> None:
    camera = Camera.look_at((0, 5, 0), (0, 0, 0), (0, 1, 0), fov_y=40, width=10, height=10)

    assert project(camera, (0, 0, 0)) == pytest.approx((5, 5, 5))
    assert np.linalg.det(camera.viewmat[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"eye": (1, 1, 1)}, "must differ"),
        ({"fov_y": 180}, "between 0 and 180"),
        ({"width": 0}, "at least one pixel"),
        ({"near": 2.0, "far": 1.0}, "near < far"),
    ],
)
def test_look_at__refuses_what_makes_no_camera(arguments, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        Camera.look_at(**({"eye": (0, 0, 0), "target": (1, 1, 1), "fov_y": 50, "width": 8, "height": 8} | arguments))


def test_camera__refuses_matrices_that_are_no_view() -> None:
    K = np.diag([10.0, 10, 1])
    with pytest.raises(ValueError, match="not orthonormal"):
        Camera(np.diag([2.0, 1, 1, 1]), K, 4, 4)
    with pytest.raises(ValueError, match="skew"):
        Camera(np.eye(4), K + np.eye(3, k=1), 4, 4)
    with pytest.raises(ValueError, match="finite"):
        Camera(np.full((4, 4), np.nan), K, 4, 4)
    with pytest.raises(ValueError, match="focal"):
        Camera(np.eye(4), np.diag([0.0, 10, 1]), 4, 4)
    assert np.linalg.det(Camera(np.diag([-1.0, 1, 1, 1]), K, 4, 4).viewmat) == -1  # a reflection is allowed


def test_camera__resizes_with_the_same_vertical_view() -> None:
    camera = Camera.look_at((0, 0, -5), (0, 0, 0), fov_y=60, width=200, height=100)
    small = camera.resize(50, 50)

    assert (small.width, small.height) == (50, 50)
    assert project(small, (0, 1, 0))[1] / 50 == pytest.approx(project(camera, (0, 1, 0))[1] / 100)


def test_parse_cameras__returns_what_to_json_gave() -> None:
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=33, width=64, height=48, near=0.5, far=9)

    (again,) = parse_cameras(json.loads(json.dumps([camera.to_json()])))

    assert np.array_equal(again.viewmat, camera.viewmat)
    assert np.array_equal(again.K, camera.K)
    assert (again.width, again.height, again.near, again.far) == (64, 48, 0.5, 9)


def test_parse_cameras__reads_the_list_of_3dgs_training() -> None:
    # Camera at (1, 2, 3) whose axes right, down, forward are world y, z, x: the columns of `rotation`.
    entry = {
        "id": 0,
        "img_name": "a",
        "width": 100,
        "height": 80,
        "position": [1, 2, 3],
        "rotation": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
        "fx": 50.0,
        "fy": 60.0,
    }

    (camera,) = parse_cameras([entry])

    assert camera.position == pytest.approx([1, 2, 3])
    assert project(camera, (2, 2.5, 3.25)) == pytest.approx((50 + 25, 40 + 15, 1))


def test_parse_cameras__reads_views_and_wrapped_lists() -> None:
    view = {"eye": [0, 0, -2], "target": [0, 0, 0], "fov_y": 45, "width": 10, "height": 10}

    assert len(parse_cameras({"cameras": [view, view]})) == 2
    assert parse_cameras(view)[0].position == pytest.approx([0, 0, -2])


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([{"width": 3, "height": 3}], r"cameras\[0\].*needs viewmat, eye or rotation"),
        ([{"width": 3, "viewmat": []}], r"cameras\[0\].*needs 'height'"),
        ([{"width": 3, "height": 3, "viewmat": [[1]], "K": [[1]]}], r"cameras\[0\].*viewmat must hold"),
        ([7], r"cameras\[0\].*expected an object"),
        ("hello", r"cameras\[0\].*expected an object"),
        ([{"width": "x", "height": 3}], r"cameras\[0\]"),
    ],
)
def test_parse_cameras__names_the_entry_at_fault(document, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(CorruptDataError, match=message):
        parse_cameras(document)


def test_load_cameras__names_the_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "cameras.json"
    for text in ("{", "[1]"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(CorruptDataError, match=r"cameras\.json"):
            load_cameras(path)
