"""Writing with a visual tolerance: off by default, smaller as it grows, within the bounds that the file states."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import AttributeTally
from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats import sog, sog4d
from gsplat_tools.ops.ordering import order_splats
from gsplat_tools.parallel import use_jobs
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud

OPTIONS: dict[str, Any] = {"sog": sog.SogOptions, "sog4d": sog4d.Sog4dOptions}
MODULES: dict[str, Any] = {"sog": sog, "sog4d": sog4d}
TOLERANCES = (0.02, 0.1, 0.5)


def scene(count: int = 1500, sh_degree: int = 1) -> GaussianCloud:
    cloud = random_cloud(count, sh_degree=sh_degree)
    return order_splats(cloud.replace(log_scales=np.maximum(cloud.log_scales, -9.0)), "morton")


def written(name: str, cloud: Any, **options: Any) -> bytes:
    target = io.BytesIO()
    MODULES[name].write(cloud, target, OPTIONS[name](**options))
    return target.getvalue()


def decoded(name: str, data: bytes, frame: int = 0) -> GaussianCloud:
    back = MODULES[name].read(io.BytesIO(data), MODULES[name].FORMAT.read_options())
    return back.frame(frame) if isinstance(back, GaussianSequence) else back


def exceeded(name: str, source: GaussianCloud, data: bytes, frame: int = 0) -> dict[str, int]:
    """Return how many values of each attribute are further off than the file's bounds."""
    tally = AttributeTally()
    tally.add(source, decoded(name, data, frame), MODULES[name].FORMAT.bounds(source, io.BytesIO(data), frame))
    return {key: int(value["exceeded"] or 0) for key, value in tally.to_json().items()}


@pytest.mark.parametrize("name", OPTIONS)
def test_no_tolerance__changes_no_byte(name: str) -> None:
    cloud = scene()

    plain = written(name, cloud)

    assert written(name, cloud, visual_tolerance=0.0) == plain
    assert OPTIONS[name]().visual_tolerance == 0


@pytest.mark.parametrize("name", OPTIONS)
def test_bytes__fall_as_the_tolerance_grows(name: str) -> None:
    cloud = scene()
    fixed = {"scale_codebook_size": 256} if name == "sog4d" else {}

    sizes = [len(written(name, cloud, visual_tolerance=pixels, **fixed)) for pixels in (0.0, *TOLERANCES)]

    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.85 * sizes[0]


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("pixels", TOLERANCES)
def test_values__stay_within_the_bounds_of_the_file(name: str, pixels: float) -> None:
    cloud = scene()

    data = written(name, cloud, visual_tolerance=pixels)

    assert not any(exceeded(name, cloud, data).values())


@pytest.mark.parametrize("rotation", ["best", "small", "reference"])
def test_rotation_modes__stay_within_the_bounds(rotation: str) -> None:
    cloud = scene(600, 0)

    data = written("sog4d", cloud, visual_tolerance=0.3, rotation=rotation)

    assert not any(exceeded("sog4d", cloud, data).values())


def test_splats_that_show_more__move_less() -> None:
    cloud = scene()

    errors = np.abs(decoded("sog4d", written("sog4d", cloud, visual_tolerance=0.2)).means.astype(np.float64) - cloud.means)

    is_opaque, is_faint = cloud.opacity_logits > 2, cloud.opacity_logits < -2
    assert errors[is_faint].mean() > 3 * errors[is_opaque].mean()


def test_sequences__stay_within_the_bounds_in_every_frame() -> None:
    first = scene(500)
    rng = np.random.default_rng(1)
    steps = [rng.normal(0, 0.01, first.log_scales.shape).astype(np.float32) for _ in range(3)]
    frames = [first.replace(log_scales=first.log_scales + step, means=first.means + step) for step in steps]
    sequence = GaussianSequence(lambda i: frames[i], num_splats=500, sh_degree=1, num_frames=3)

    data = written("sog4d", sequence, visual_tolerance=0.1)

    for i, frame in enumerate(frames):
        assert not any(exceeded("sog4d", frame, data, i).values())


@pytest.mark.parametrize("name", OPTIONS)
def test_bytes__do_not_depend_on_threads(name: str) -> None:
    cloud = scene(9000, 0)

    files = []
    for jobs in (1, 3):
        with use_jobs(jobs):
            files.append(written(name, cloud, visual_tolerance=0.1))

    assert files[0] == files[1]


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("count", [1, 2, 7])
def test_tiny_scenes__can_be_written(name: str, count: int) -> None:
    cloud = random_cloud(count, sh_degree=1)
    flat = cloud.replace(log_scales=np.where(np.arange(3) == 2, -30, cloud.log_scales).astype(np.float32))

    for each in (cloud, flat, cloud.replace(means=np.zeros_like(cloud.means))):
        assert not any(exceeded(name, each, written(name, each, visual_tolerance=0.5)).values())


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("pixels", [-0.1, 11.0, float("nan")])
def test_tolerances_out_of_range__are_refused(name: str, pixels: float) -> None:
    with pytest.raises(CapabilityError, match="visual_tolerance"):
        OPTIONS[name](visual_tolerance=pixels)
