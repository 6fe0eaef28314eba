from __future__ import annotations

import itertools

import numpy as np
import pytest

from gsplat_tools.attributes import coordinate_systems as systems

ALL = ["".join(letters) for pairs in itertools.permutations(["RL", "UD", "FB"]) for letters in itertools.product(*pairs)]


def test_is_known__accepts_exactly_48_names() -> None:
    names = {"".join(letters) for letters in itertools.product("RLUDFB", repeat=3)}

    assert {name for name in names if systems.is_known(name)} == set(ALL)
    assert len(ALL) == 48
    assert not any(systems.is_known(name) for name in ["unknown", "", "RU", "RUBX", "rub", "XYZ"])


def test_axis_map__from_rub_to_rdf_negates_y_and_z() -> None:
    np.testing.assert_array_equal(systems.axis_map("RUB", "RDF"), np.diag([1, -1, -1]))


def test_axis_map__from_three_js_to_blender_turns_90_degrees_about_x() -> None:
    # Up is +y in RUB and +z in RFU; back is +z in RUB and -y in RFU.
    matrix = systems.axis_map("RUB", "RFU")

    np.testing.assert_array_equal(matrix @ [1, 2, 3], [1, -3, 2])
    assert not systems.changes_signs_only(matrix)
    assert not systems.changes_handedness(matrix)


@pytest.mark.parametrize("source", systems.Y_UP_OR_DOWN)
def test_changes_signs_only__holds_within_the_families_of_eight(source: str) -> None:
    assert all(systems.changes_signs_only(systems.axis_map(source, target)) for target in systems.Y_UP_OR_DOWN)
    assert not any(systems.changes_signs_only(systems.axis_map(source, target)) for target in systems.Z_UP_OR_DOWN)


def test_axis_map__is_a_group_of_signed_permutations() -> None:
    for source, target in itertools.product(ALL, ALL):
        matrix = systems.axis_map(source, target)

        np.testing.assert_array_equal(matrix @ matrix.T, np.eye(3))
        np.testing.assert_array_equal(systems.axis_map("LFD", target) @ systems.axis_map(source, "LFD"), matrix)


def test_changes_handedness__separates_unity_from_three_js() -> None:
    assert systems.changes_handedness(systems.axis_map("RUB", "RUF"))
    assert not systems.changes_handedness(systems.axis_map("RUB", "LUF"))


def test_axis_directions__refuses_letters_that_name_no_system() -> None:
    with pytest.raises(ValueError, match="'RRU'"):
        systems.axis_directions("RRU")
