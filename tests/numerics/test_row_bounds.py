"""Bounds that reports derive themselves: turns in degrees, lengths of flat axes, palettes; each notices what it is for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from gsplat_tools.attributes import quaternions
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.numerics import Row, measure_cloud
from gsplat_tools.numerics.conditions import ordinary
from gsplat_tools.numerics.palettes import nearest_distances
from gsplat_tools.numerics.report import measured_formats
from gsplat_tools.numerics.rotations import ATTRIBUTE as TURN
from gsplat_tools.numerics.rotations import eigenvector_turns, rotation_errors
from gsplat_tools.numerics.sizes import ATTRIBUTE as LENGTH
from gsplat_tools.numerics.sizes import covariance_reach, size_errors
from gsplat_tools.sequence import GaussianSequence

FORMAT_IDS = [record.id for record in measured_formats()]


def rows_of(cloud: GaussianCloud, format_id: str) -> dict[str, Row]:
    return {row.attribute: row for row in measure_cloud(cloud, FORMATS[format_id])}


def tampered(format_id: str, change: Any) -> Any:
    """The format, with a reader that changes what it has read."""
    record = FORMATS[format_id]
    assert record.read is not None
    honest = record.read

    def read(*arguments: Any) -> Any:
        scene = honest(*arguments)
        if not isinstance(scene, GaussianSequence):
            return change(scene)
        return GaussianSequence(
            lambda i: change(scene.frame(i)), num_splats=scene.num_splats, sh_degree=scene.sh_degree, num_frames=len(scene)
        )

    return dataclasses.replace(record, read=read)


# -- rotations


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 0.3, 44.0])
def test_rotation_errors__are_the_turn_whatever_the_axes_are_called(degrees: float, rng: np.random.Generator) -> None:
    cloud = ordinary()
    axes = rng.normal(size=(len(cloud), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half = np.radians(degrees) / 2
    turns = np.concatenate([np.full((len(cloud), 1), np.cos(half)), np.sin(half) * axes], axis=1)
    quarter = np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    quats = cloud.quats.astype(np.float64)
    for renamed in (np.array([1.0, 0, 0, 0]), quarter, np.array([0.5, 0.5, -0.5, 0.5])):
        found = quaternions.multiply(quaternions.multiply(turns, quats), renamed)

        errors = rotation_errors(cloud, cloud.replace(quats=found))

        assert errors == pytest.approx(np.full(len(cloud), degrees), abs=2e-5)
    assert (rotation_errors(cloud, cloud.replace(quats=cloud.quats)) == 0).all()


@pytest.mark.parametrize("format_id", FORMAT_IDS)
def test_turns__of_every_format_have_a_bound_that_notices_more(format_id: str) -> None:
    cloud = ordinary(log_scales=np.log([1.0, 0.3, 0.1]) - 3 + np.zeros((96, 3)))
    half = np.radians(12.0 if format_id == "visionary-f16" else 2.5) / 2
    turn = np.array([np.cos(half), np.sin(half), 0, 0])

    def turned(scene: GaussianCloud) -> GaussianCloud:
        return scene.replace(quats=quaternions.multiply(turn, scene.quats.astype(np.float64)))

    assert rows_of(cloud, format_id)[TURN].within is True
    rows = {row.attribute: row for row in measure_cloud(cloud, tampered(format_id, turned), watched=["covariances"])}

    assert rows[TURN].within is False


def test_turns__of_lengths_chosen_for_the_covariance_may_exceed_those_of_the_longest_code() -> None:
    rows = rows_of(ordinary(count=20_000), "splat")

    # 0.902 degrees is what a code of the longest length allows, and what its covariance allows is not exceeded.
    assert rows[TURN].measured_max is not None
    assert rows[TURN].measured_max > 0.92
    assert rows[TURN].within is True
    assert rows["covariances"].within is True


def test_eigenvector_turns__leave_round_splats_free() -> None:
    logs = np.array([[0.0, -1.0, -2.0], [0.0, 0.0, -2.0], [0.0, -1.0, -1.0], [-np.inf] * 3], np.float32)

    turns = eigenvector_turns(logs, np.full(4, 1e-4))

    assert turns[0] < 0.05
    assert np.isinf(turns[1:]).all()


# -- lengths


def test_scales__that_become_flat_have_a_bound_as_lengths() -> None:
    cloud = ordinary(log_scales=np.full((96, 3), -40.0))

    for format_id in ("spark", "gscc", "visionary-f16"):
        rows = rows_of(cloud, format_id)

        assert rows["scales"].within is None
        assert "-inf" in rows["scales"].note
        assert rows[LENGTH].within is True
        assert rows[LENGTH].bound is not None
        assert rows[LENGTH].measured_max == pytest.approx(np.exp(-40.0))


@pytest.mark.parametrize("format_id", ["visionary-f16", "visionary-f32"])
@pytest.mark.parametrize("log_scale", [8.0, 60.0, 1000.0, 3e38])
def test_scales__of_shrunk_covariances_are_bounded(format_id: str, log_scale: float) -> None:
    largest = float(np.finfo(np.float32).max)
    logs = np.clip(log_scale + np.random.default_rng(3).uniform(-0.3, 0.3, (96, 3)), -largest, largest)

    row = rows_of(ordinary(log_scales=logs), format_id)["scales"]

    assert row.within is True
    shrinks = format_id == "visionary-f16" or log_scale > 45
    assert not shrinks or row.measured_max > 1


def test_covariance_reach__is_told_of_formats_that_hold_covariances_alone() -> None:
    logs = np.zeros((1, 3), np.float32)

    assert covariance_reach(logs, FORMATS["splat"]) is None
    low, high = covariance_reach(logs, FORMATS["visionary-f32"]) or (None, None)
    assert low == pytest.approx(np.zeros((1, 3)), abs=1e-6)
    assert high == pytest.approx(np.zeros((1, 3)), abs=1e-6)


def test_size_errors__are_shares_of_the_longest_axis_beyond_a_unit() -> None:
    small, large = (ordinary(log_scales=np.tile([v, v - 1, v - 2], (96, 1))) for v in (-2.0, 100.0))

    for cloud, expected in ((small, np.exp(-2.0) * np.expm1(0.5)), (large, np.expm1(0.5))):
        longer = cloud.replace(log_scales=cloud.log_scales + np.float32([0.5, 0, 0]))

        assert size_errors(cloud, longer)[:, 2] == pytest.approx(np.full(96, expected), rel=1e-5)
        assert (size_errors(cloud, longer)[:, :2] == 0).all()


# -- palettes


@pytest.mark.parametrize("format_id", ["sog", "sog4d", "splat4d"])
def test_palettes__bound_sh_by_the_nearest_entry_in_the_file(format_id: str) -> None:
    cloud = ordinary(3, count=600)

    def next_entries(scene: GaussianCloud) -> GaussianCloud:
        return scene.replace(shN=np.roll(scene.shN, 1, axis=0))

    honest = rows_of(cloud, format_id)["shN"]
    rows = {row.attribute: row for row in measure_cloud(cloud, tampered(format_id, next_entries))}

    assert honest.within is True
    assert honest.note in ("", "clamped-sh0")
    assert rows["shN"].within is False


def test_nearest_distances__are_those_of_all_entries(rng: np.random.Generator) -> None:
    points, entries = (rng.normal(size=(count, 9)).astype(np.float32) for count in (50, 30))
    exact = np.linalg.norm(points[:, None].astype(np.float64) - entries, axis=2)

    limits = nearest_distances(points, entries[exact.argmin(axis=1)], entries)

    assert (limits >= exact.min(axis=1)).all()
    assert limits == pytest.approx(exact.min(axis=1), rel=1e-4)
