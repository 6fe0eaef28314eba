"""Sequences: labels that stay, segments that stand alone, times, and evaluation against a plain oracle."""

from __future__ import annotations

import gc
import io
import weakref
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.formats.sog4d import Sog4dOptions, Sog4dReadOptions, read, write
from gsplat_tools.formats.sog4d.labels import MAGIC
from gsplat_tools.parallel import use_jobs
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.oracles.sequence_evaluation import evaluate


def moving(count: int, frames: int, *, seed: int = 0, sh_degree: int = 1) -> list[GaussianCloud]:
    """Splats on lines; a tenth of them changes its SH from frame to frame."""
    rng = np.random.default_rng(seed)
    cloud = random_cloud(count, sh_degree=sh_degree, seed=seed)
    clouds = [cloud]
    for _ in range(frames - 1):
        shN = cloud.shN.copy()
        rows = rng.random(count) < 0.1
        shN[rows] += rng.normal(0, 0.3, shN[rows].shape).astype(np.float32)
        cloud = cloud.replace(means=cloud.means + rng.normal(0, 0.02, (count, 3)).astype(np.float32), shN=shN)
        clouds.append(cloud)
    return clouds


def sequence_of(clouds: list[GaussianCloud], times: list[float] | None = None) -> GaussianSequence:
    return GaussianSequence(
        lambda i: clouds[i],
        num_splats=len(clouds[0]),
        sh_degree=clouds[0].sh_degree,
        frame_times=times,
        num_frames=len(clouds),
    )


def written(scene: Any, **options: Any) -> bytes:
    target = io.BytesIO()
    write(scene, target, Sog4dOptions(**options))
    return target.getvalue()


def opened(data: bytes) -> GaussianSequence:
    return read(io.BytesIO(data), Sog4dReadOptions())


@pytest.mark.parametrize("version", [1, 2])
def test_delta_and_full__give_the_same_frames(version: Any) -> None:
    scene = sequence_of(moving(300, 7, sh_degree=2))
    options = {"version": version, "delta_segment_length": 3, "sh_palette_size": 40}

    full, delta = (opened(written(scene, labels=labels, **options)) for labels in ("full", "delta-v1"))

    for frame in range(7):
        for name, values in full.frame(frame).arrays().items():
            assert np.array_equal(values, getattr(delta.frame(frame), name)), (frame, name)


def test_identical_frames__make_empty_blocks_and_equal_images() -> None:
    cloud = random_cloud(200, sh_degree=2)

    data = written(sequence_of([cloud] * 5), sh_palette_size=20)

    archive = zipfile.ZipFile(io.BytesIO(data))
    assert len(archive.read("sh/shN_delta_00000.bin")) == 28 + 4 * 4  # header, then five less one counts of zero
    for stream in ("position_hi", "position_lo", "scale_indices", "rotation", "sh0"):
        assert len({archive.read(f"frames/{frame:05d}/{stream}.webp") for frame in range(5)}) == 1
    assert not any(name.endswith("shN_labels.webp") for name in archive.namelist()[6:])


def test_small_changes__keep_labels_and_large_ones_do_not() -> None:
    rng = np.random.default_rng(2)
    first = random_cloud(400, sh_degree=1)
    jitter = first.replace(shN=first.shN + rng.normal(0, 1e-3, first.shN.shape).astype(np.float32))

    def changed(second: GaussianCloud, tolerance: float) -> int:
        archive = zipfile.ZipFile(
            io.BytesIO(written(sequence_of([first, second]), sh_palette_size=60, keep_tolerance=tolerance))
        )
        return int.from_bytes(archive.read("sh/shN_delta_00000.bin")[28:32], "little")

    assert changed(jitter, 0.05) < changed(jitter, 0.0)
    assert changed(first.replace(shN=first.shN[::-1]), 0.05) > 300


def test_kept_labels__cost_no_more_than_the_tolerance() -> None:
    clouds = moving(500, 6)

    kept, free = (opened(written(sequence_of(clouds), sh_palette_size=50, keep_tolerance=t)) for t in (0.05, 0.0))

    for frame in range(6):
        errors = [np.square(s.frame(frame).shN - clouds[frame].shN).sum(axis=(1, 2)) for s in (kept, free)]
        assert (errors[0] <= errors[1] + 0.06 * errors[1].mean()).all()


def test_segments__do_not_depend_on_what_came_before() -> None:
    clouds = moving(200, 6)
    options = {"labels": "delta-v1", "delta_segment_length": 3, "sh_palette_size": 30}

    whole = zipfile.ZipFile(io.BytesIO(written(sequence_of(clouds), **options)))
    # The same frames in another order before the second segment: the sample of the codebooks is the same set only for
    # identical segments, so swap equal ones.
    twice = zipfile.ZipFile(io.BytesIO(written(sequence_of(clouds[:3] + clouds[:3]), **options)))

    assert whole.read("sh/shN_delta_00003.bin")[:8] == MAGIC
    first, second = (twice.read(f"sh/shN_delta_{start:05d}.bin") for start in (0, 3))
    assert first[28:] == second[28:]
    for frame in range(3):
        assert twice.read(f"frames/{frame:05d}/scale_indices.webp") == twice.read(f"frames/{frame + 3:05d}/scale_indices.webp")


def test_times__are_kept_as_they_are() -> None:
    clouds = moving(20, 3)

    explicit = opened(written(sequence_of(clouds, [0.0, 0.1, 0.7])))
    uniform = opened(written(sequence_of(clouds)))
    given_times = opened(written(sequence_of(clouds), frame_times=[0.0, 0.0, 1.0]))
    forced = opened(written(sequence_of(clouds, [0.0, 0.1, 0.7]), time_mapping="uniform"))

    assert (explicit.frame_times.tolist(), explicit.is_uniform) == ([0.0, 0.1, 0.7], False)
    assert uniform.is_uniform
    assert given_times.frame_times.tolist() == [0.0, 0.0, 1.0]
    assert forced.is_uniform


def test_bytes__do_not_depend_on_threads() -> None:
    scene = sequence_of(moving(3000, 4))
    results = []
    for jobs in (1, 3):
        with use_jobs(jobs):
            results.append(written(scene, delta_segment_length=2))

    assert results[0] == results[1]


def test_frames__are_let_go_while_others_are_encoded() -> None:
    base = random_cloud(2000, sh_degree=1)
    alive: list[weakref.ref[Any]] = []
    most = 0

    def load(frame: int) -> GaussianCloud:
        nonlocal most
        gc.collect()
        most = max(most, sum(ref() is not None for ref in alive))
        means = base.means + np.float32(0.01 * frame)
        alive.append(weakref.ref(means))
        return base.replace(means=means)

    scene = GaussianSequence(load, num_splats=2000, sh_degree=1, num_frames=12)
    write(scene, io.BytesIO(), Sog4dOptions(sh_palette_size=16))

    assert len(alive) >= 24  # once for the sample, once to be encoded
    assert most <= 2


def test_frame_of_another_size__is_refused_with_its_index() -> None:
    clouds = [random_cloud(20), random_cloud(20), random_cloud(19)]

    with pytest.raises(CloudError, match="frame 2: every frame needs 20 splats") as caught:
        written(sequence_of(clouds))
    assert caught.value.frame == 2


@given(
    seed=st.integers(0, 1000),
    count=st.integers(1, 12),
    frames=st.integers(1, 4),
    version=st.sampled_from([1, 2]),
    t=st.floats(-0.2, 1.2),
    interpolation=st.sampled_from(["linear", "nearest"]),
    explicit=st.booleans(),
)
def test_evaluation__is_what_the_oracle_makes_of_the_stored_frames(
    seed: int, count: int, frames: int, version: Any, t: float, interpolation: Any, explicit: bool
) -> None:
    clouds = moving(count, frames, seed=seed)
    times = np.sort(np.random.default_rng(seed).random(frames)).tolist() if explicit else None
    sequence = opened(written(sequence_of(clouds, times), version=version))

    found = sequence.at(t, interpolation)

    stored = [sequence.frame(i).arrays() for i in range(frames)]
    expected = evaluate(stored, t, times, interpolation)
    assert np.allclose(found.means, expected["means"], atol=1e-5)
    assert np.allclose(found.log_scales, expected["log_scales"], atol=1e-4)
    assert np.allclose(found.sh0, expected["sh0"], atol=1e-5)
    assert np.allclose(found.shN, expected["shN"], atol=1e-5)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-found.opacity_logits.astype(np.float64)))
    assert np.allclose(opacities, expected["opacities"], atol=2e-6)
    cosines = np.abs((found.quats * expected["quats"]).sum(axis=1))
    assert np.allclose(cosines, 1, atol=1e-5)
