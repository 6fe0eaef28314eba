"""Spark's accumulator: every rounding within its step, and what is rounded stays."""

import numpy as np
import pytest

from gsplat_tools.kernels import accumulator
from gsplat_tools.kernels import rules as R

pytestmark = pytest.mark.uncompiled

COUNT = 2000
EYE = np.array([0.3, -1.0, 2.0])


def random_splats(rng, dtype=np.float64):  # type: ignore[no-untyped-def]
    table = np.empty((COUNT, R.SPLAT_SIZE), dtype)
    table[:, :3] = rng.normal(0, 3, (COUNT, 3))
    table[:, R.SCALE : R.SCALE + 3] = np.exp(rng.uniform(-11, 5, (COUNT, 3)))
    quats = rng.normal(size=(COUNT, 4))
    table[:, R.QUAT : R.QUAT + 4] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    table[:, R.OPACITY] = rng.random(COUNT)
    table[:, R.COLOR :] = rng.uniform(-0.2, 1.2, (COUNT, 3))
    return table


def angles(a, b):  # type: ignore[no-untyped-def]
    """Angles between rotations, degrees."""
    dots = np.abs(np.sum(a[:, R.QUAT : R.QUAT + 4] * b[:, R.QUAT : R.QUAT + 4], axis=1))
    return np.rad2deg(2 * np.arccos(np.minimum(dots, 1)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_packed__rounds_within_half_a_step(rng, dtype) -> None:  # type: ignore[no-untyped-def]
    before = random_splats(rng, dtype)
    after = before.copy()

    accumulator.requantize(after, EYE.astype(dtype), accumulator.PACKED)

    relative = before[:, :3] - EYE.astype(dtype)
    assert np.array_equal(after[:, :3], relative.astype(np.float32).astype(np.float16).astype(dtype))
    assert np.abs(after[:, R.OPACITY] - before[:, R.OPACITY]).max() <= 1 / 255 + 1e-6
    assert np.abs(after[:, R.COLOR :] - np.clip(before[:, R.COLOR :], 0, 1)).max() <= 0.5 / 255 + 1e-6
    logs = np.log(after[:, 3:6] / before[:, 3:6])
    assert np.abs(logs).max() <= 21 / 254 / 2 + 1e-5
    # docs: the octahedral axis and the angle of 8 bits together err by 0.614 degrees on average and 1.90 at most.
    turned = angles(before.astype(np.float64), after.astype(np.float64))
    assert turned.max() < 1.95
    assert turned.mean() == pytest.approx(0.614, abs=0.03)


def test_extended__rounds_within_half_a_step(rng) -> None:  # type: ignore[no-untyped-def]
    before = random_splats(rng)
    after = before.copy()

    accumulator.requantize(after, EYE, accumulator.EXTENDED)

    assert np.array_equal(after[:, :3], before[:, :3] - EYE)
    for columns in (slice(R.OPACITY, R.OPACITY + 1), slice(R.COLOR, R.COLOR + 3)):
        assert np.array_equal(after[:, columns], before[:, columns].astype(np.float32).astype(np.float16).astype(np.float64))
    assert np.abs(np.log(after[:, 3:6] / before[:, 3:6])).max() <= 2.0**-8 + 1e-9  # logs up to 11: steps of 2^-7
    # A quarter of the axis' step and a sixteenth of the angle's.
    assert angles(before, after).max() < 0.5


@pytest.mark.parametrize("form", [accumulator.PACKED, accumulator.EXTENDED])
def test_requantize__changes_nothing_the_second_time(rng, form) -> None:  # type: ignore[no-untyped-def]
    once = random_splats(rng)
    accumulator.requantize(once, EYE, form)
    twice = once.copy()

    accumulator.requantize(twice, np.zeros(3), form)

    others = [c for c in range(R.SPLAT_SIZE) if not R.QUAT <= c < R.QUAT + 4]
    assert np.allclose(twice[:, others], once[:, others], rtol=1e-12, atol=0)
    # On the rim of the octahedron a direction has two codes, which decode to the same rotation.
    assert angles(once, twice).max() < 1e-5


def test_requantize__keeps_flat_axes_and_saturates_scales() -> None:
    table = np.zeros((1, R.SPLAT_SIZE))
    table[0, 3:6] = 0.0, 1e-9, 1e6
    table[0, R.QUAT] = 1.0

    accumulator.requantize(table, np.zeros(3), accumulator.PACKED)

    assert table[0, 3] == 0
    assert np.allclose(table[0, 4:6], np.exp([-12.0, 9.0]))
    assert np.allclose(table[0, R.QUAT : R.QUAT + 4], [1, 0, 0, 0])
