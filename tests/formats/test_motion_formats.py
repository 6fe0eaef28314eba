"""What every format that holds motion promises about it."""

import io
import warnings
from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud, TimeModel
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.loading import inspect_file
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.ops.motion import at_time, motion_bounds
from tests.builders import PlyElement, ply_file, splat_columns
from tests.clouds import random_cloud

MOVING = [record for record in FORMATS.values() if record.holds_motion and record.read is not None and record.write is not None]
every_format = pytest.mark.parametrize("record", MOVING, ids=lambda record: record.id)


def moving(model: TimeModel = "window") -> GaussianCloud:
    cloud = random_cloud(60, sh_degree=1, motion=True)
    return cloud.replace(time_model=model, temporal_cutoff=0.125 if model == "gaussian" else 0.01)


def round_trip(cloud: GaussianCloud, record: Format, folder: Path) -> GaussianCloud:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        save(cloud, folder / f"scene{record.extensions[0]}", to=record.id, order="none", recenter="off")
        decoded = load(folder / f"scene{record.extensions[0]}")
    assert isinstance(decoded, GaussianCloud)
    return decoded


def test_formats__that_hold_motion() -> None:
    assert {"ply", "spark", "uncompressed", "splat4d"} <= {record.id for record in MOVING}


@every_format
@pytest.mark.parametrize("model", ["window", "gaussian"])
def test_round_trip__keeps_motion_model_and_cutoff(record: Format, model: TimeModel, tmp_path: Path) -> None:
    cloud = moving(model)

    decoded = round_trip(cloud, record, tmp_path)

    assert (decoded.time_model, decoded.temporal_cutoff) == (model, cloud.temporal_cutoff)
    for name in ("velocities", "times", "durations"):
        assert np.array_equal(getattr(decoded, name), getattr(cloud, name)), name


@every_format
@pytest.mark.parametrize("model", ["window", "gaussian"])
def test_inspect__gives_bounds_that_hold_what_the_static_ones_lose(record: Format, model: TimeModel, tmp_path: Path) -> None:
    cloud = moving(model)
    decoded = round_trip(cloud, record, tmp_path)

    info = inspect_file(tmp_path / f"scene{record.extensions[0]}")[1]

    assert info.bounds is not None
    assert info.motion_bounds is not None
    expected = motion_bounds(decoded)
    assert expected is not None
    assert np.allclose(info.motion_bounds, expected, atol=1e-5)
    places = np.concatenate([at_time(cloud, t).means[at_time(cloud, t).opacity_logits > -9] for t in np.linspace(0, 1, 21)])
    slack = 2e-3  # positions of the Spark layout are halves
    assert (places >= np.array(info.motion_bounds[0]) - slack).all()
    assert (places <= np.array(info.motion_bounds[1]) + slack).all()
    outside = (places < np.array(info.bounds[0]) - slack) | (places > np.array(info.bounds[1]) + slack)
    assert outside.any()


def ply_info(**columns: list[float]) -> object:
    everything = splat_columns(2) | {name: ("float", values) for name, values in columns.items()}
    everything |= {"x": ("float", [0.0, 1.0]), "y": ("float", [0.0, 1.0]), "z": ("float", [0.0, 1.0])}
    data = ply_file(PlyElement("vertex", everything), comments=["origin 10 20 30"])  # type: ignore[arg-type]
    return FORMATS["ply"].inspect(io.BytesIO(data)).motion_bounds


def test_inspect__of_a_ply_takes_defaults_for_what_is_missing_and_clamps_durations() -> None:
    assert ply_info() is None
    assert ply_info(vx=[2.0, 0.0]) == ([8, 18, 28], [13, 23, 33])  # duration 1
    assert ply_info(velocity_x=[2.0, 0.0], dt=[0.25, 0.5]) == ([9, 19, 29], [12, 22, 32])
    assert ply_info(vx=[2.0, 0.0], duration=[50.0, -7.0]) == ([8, 18, 28], [13, 23, 33])
    assert ply_info(vx=[float("inf"), 1.0]) == ([10, 20, 30], [12, 22, 32])  # the first splat is not kept either


def test_read__of_a_ply_leaves_comments_alone_that_are_no_cutoff() -> None:
    for comment, expected in (("temporal_cutoff 0.5", 0.5), ("temporal_cutoff 2", 0.01), ("temporal_cutoff none", 0.01)):
        data = ply_file(PlyElement("vertex", splat_columns(2) | {"t": ("float", [0.0, 0.0])}), comments=[comment])
        cloud = FORMATS["ply"].read(io.BytesIO(data), FORMATS["ply"].read_options())  # type: ignore[misc]
        assert cloud.temporal_cutoff == expected  # type: ignore[union-attr]
