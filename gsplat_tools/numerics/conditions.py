"""Synthetic clouds that each push one attribute to an extreme, everything else kept ordinary."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import quaternions
from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud

SPLATS = 96
"""Splats of a synthetic cloud: enough for stable maxima, few enough that every sweep ends within a minute."""

_SEED = 20260601
_LARGEST_PLOTTED = 110.0
_LARGEST_FLOAT = float(np.finfo(np.float32).max)


@dataclass(frozen=True, slots=True)
class Condition:
    """One point of a sweep.

    Parameters
    ----------
    sweep, label
        What is pushed, and how far, in words.
    x
        How far as a number, for plots; None where it is a case and not a magnitude.
    watched
        Attributes that the sweep is about, as `Bounds` names them.
    cloud
        The splats.
    """

    sweep: str
    label: str
    x: float | None
    watched: tuple[str, ...]
    cloud: GaussianCloud


def conditions() -> Iterator[Condition]:
    """Yield every point of every sweep; the same clouds in every run."""
    yield Condition("ordinary", "", None, ("means", "scales", "covariances", "opacities", "sh0", "shN"), ordinary(3))
    yield from _positions()
    yield from _scales()
    yield from _rotations()
    yield from _opacities()
    yield from _colors()
    yield from _subnormals()
    yield from _motions()


def ordinary(sh_degree: int = 0, count: int = SPLATS, **changes: Any) -> GaussianCloud:
    """Return a blob of splats a unit wide, with some attributes replaced."""
    rng = np.random.default_rng(_SEED)
    arrays: dict[str, Any] = {
        "means": rng.uniform(-1, 1, (count, 3)),
        "log_scales": rng.uniform(-6, -2, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "opacity_logits": rng.normal(0, 3, count),
        "sh0": rng.normal(0, 0.9, (count, 3)),
        "shN": rng.normal(0, 0.15, (count, REST_COEFFICIENTS[sh_degree], 3)),
    }
    arrays.update(changes)
    return GaussianCloud(**arrays)


def _spread(count: int = SPLATS) -> NDArray[np.float64]:
    """Return (count, 3) numbers in [-1, 1] that reach both ends."""
    values = np.random.default_rng(_SEED + 1).uniform(-1, 1, (count, 3))
    values[0], values[1] = -1, 1
    return values


def _positions() -> Iterator[Condition]:
    """Scenes of every size about zero; scenes 10 units wide far from zero, with and without a stored origin."""
    for exponent in range(-8, 8):
        size = 10.0**exponent
        sizes = np.log(size) + np.random.default_rng(_SEED + 2).uniform(-6, -3, (SPLATS, 3))
        yield Condition("position", f"{size:.0e}", size, ("means",), ordinary(means=_spread() * size, log_scales=sizes))
    for exponent in range(1, 8):
        distance = 10.0**exponent
        means = np.array([1.0, -0.5, 0.25]) * distance + 5 * _spread()
        yield Condition("position far from zero", f"{distance:.0e}", distance, ("means",), ordinary(means=means))
    for exponent in range(1, 9):
        distance = 10.0**exponent
        origin = np.array([1.0, -0.5, 0.25]) * distance + np.pi
        yield Condition(
            "position with origin", f"{distance:.0e}", distance, ("means",), ordinary(means=5 * _spread(), origin=origin)
        )


def _plotted(exponent: float) -> float | None:
    """Return a natural logarithm as a place in plots; what float32 cannot hold after exp is a case, not a magnitude."""
    return exponent if abs(exponent) <= _LARGEST_PLOTTED else None


def _scales() -> Iterator[Condition]:
    """Log scales over all that float32 holds, flat axes, and needles."""
    logs: tuple[float, ...] = (
        -3e38,
        -1e4,
        -150,
        -104,
        -100,
        -95,
        -88,
        -80,
        -60,
        -40,
        -20,
        -15,
        -12.5,
        -11,
        -10,
        -9,
        -7,
        -5,
        -3,
        -1,
        0,
    )
    logs += (1, 3, 5, 6, 8, 9.5, 12, 20, 30, 44, 60, 80, 88, 88.7, 89, 100, 1000, 3e38)
    wiggle = np.random.default_rng(_SEED + 3).uniform(-0.3, 0.3, (SPLATS, 3))
    for value in logs:
        values = np.clip(value + wiggle, -_LARGEST_FLOAT, _LARGEST_FLOAT)
        yield Condition("log scale", f"{value:g}", _plotted(value), ("scales", "covariances"), ordinary(log_scales=values))
    flat = ordinary().log_scales.copy()
    flat[:, 2] = -np.inf
    flat[::4, 1] = -np.inf
    flat[::8] = -np.inf
    yield Condition("log scale", "-inf", None, ("scales", "covariances"), ordinary(log_scales=flat))
    for half_decade in range(11):
        aspect = 10.0 ** (half_decade / 2)
        needles = np.tile([0.0, -np.log(aspect), -np.log(aspect)], (SPLATS, 1)) - 3 + wiggle / 10
        yield Condition("needle", f"{aspect:.4g}", aspect, ("covariances", "scales"), ordinary(log_scales=needles))


def _rotations() -> Iterator[Condition]:
    """Places where codes of rotations fold, tie or end."""
    rng = np.random.default_rng(_SEED + 4)
    axes = rng.normal(size=(SPLATS, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    tiny = 10.0 ** rng.uniform(-9, -3, (SPLATS, 1))
    poles = np.where(rng.random((SPLATS, 1)) < 0.5, 1.0, -1.0) * np.array([0.0, 0.0, 1.0]) + tiny * axes
    folds = axes * [1, 1, 0] + tiny * [0, 0, 1] * np.sign(axes[:, 2:])
    on_axes = np.eye(3)[rng.integers(0, 3, SPLATS)] * rng.choice([-1.0, 1.0], (SPLATS, 1)) + tiny * axes

    def about(directions: NDArray[np.float64], angles: Any) -> NDArray[np.float64]:
        half = np.broadcast_to(np.asarray(angles, np.float64) / 2, (SPLATS, 1))
        units = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return np.concatenate([np.cos(half), np.sin(half) * units], axis=1)

    turns = rng.uniform(0, np.pi, (SPLATS, 1))
    ties = rng.choice([-0.5, 0.5], (SPLATS, 4))
    cases: dict[str, NDArray[np.float64]] = {
        "identity": np.tile([1.0, 0, 0, 0], (SPLATS, 1)),
        "nearly identity": about(axes, tiny),
        "angle pi": about(axes, np.pi),
        "nearly angle pi": about(axes, np.pi - tiny),
        "angle pi about x, y, z": about(np.round(on_axes), np.pi),
        "axis at a pole": about(poles, turns),
        "axis at a fold": about(folds, turns),
        "two folds": about(on_axes, turns),
        "four equal components": ties,
        "two equal components": np.where(rng.permuted(np.tile([True, True, False, False], (SPLATS, 1)), axis=1), ties, 0.0),
        "random": rng.normal(size=(SPLATS, 4)),
        "length 1e-30": 1e-30 * quaternions.normalize(rng.normal(size=(SPLATS, 4))),
        "length 1e30": 1e30 * quaternions.normalize(rng.normal(size=(SPLATS, 4))),
    }
    logs = np.log([1.0, 0.3, 0.1]) - 3 + rng.uniform(-0.05, 0.05, (SPLATS, 3))
    rows = rng.normal(size=(SPLATS, 4))
    rows /= np.abs(rows).max(axis=1, keepdims=True)
    cases |= {f"largest component {size:g}": size * rows for size in (1e-41, 3e38)}
    for label, quats in cases.items():
        yield Condition("rotation", label, None, ("covariances",), ordinary(quats=quats, log_scales=logs))


def _opacities() -> Iterator[Condition]:
    """Logits to both infinities."""
    wiggle = np.random.default_rng(_SEED + 5).uniform(-0.5, 0.5, SPLATS)
    for value in (-3e38, -1e4, -200, -104, -88, -40, -20, -16.64, -10, -6.23, -5.54, -3, -1, 0):
        for sign in (1, -1) if value else (1,):
            x = sign * value
            logits = np.clip(x + wiggle, -_LARGEST_FLOAT, _LARGEST_FLOAT)
            yield Condition("opacity logit", f"{x:g}", _plotted(x), ("opacities",), ordinary(opacity_logits=logits))
    for label, value in (("-inf", -np.inf), ("+inf", np.inf)):
        yield Condition("opacity logit", label, None, ("opacities",), ordinary(opacity_logits=np.full(SPLATS, value)))
    ends = np.where(np.arange(SPLATS) % 2 == 0, -np.inf, np.inf)
    yield Condition("opacity logit", "-inf and +inf", None, ("opacities",), ordinary(opacity_logits=ends))


def _colors() -> Iterator[Condition]:
    """Colors and higher SH from tiny to 1000, and one outlier among ordinary values."""
    for exponent in range(-6, 4):
        size = 10.0**exponent
        yield Condition("sh0", f"{size:.0e}", size, ("sh0",), ordinary(sh0=size * _spread()))
    for degree in (1, 3, 4):
        unit = np.random.default_rng(_SEED + 6).uniform(-1, 1, (SPLATS, REST_COEFFICIENTS[degree], 3))
        for exponent in range(-3, 4) if degree == 3 else (-1, 3):
            size = 10.0**exponent
            name = f"SH degree {degree}"
            yield Condition(name, f"{size:.0e}", size, ("shN",), ordinary(degree, shN=size * unit))
    outlier = ordinary(3)
    shN, sh0 = outlier.shN.copy(), outlier.sh0.copy()
    shN[5, 7, 1], sh0[5, 1] = 1e3, -1e3
    yield Condition("SH degree 3", "one outlier of 1e3", None, ("sh0", "shN"), outlier.replace(shN=shN, sh0=sh0))


def _subnormals() -> Iterator[Condition]:
    """Numbers below the smallest normal float32, and -0."""
    rng = np.random.default_rng(_SEED + 7)
    watched = ("means", "scales", "covariances", "opacities", "sh0", "shN")
    signs = rng.choice([-1.0, 1.0], (SPLATS, 3))
    tiny = signs * 2.0 ** rng.uniform(-149, -127, (SPLATS, 3))
    changes: dict[str, Any] = {"means": tiny, "sh0": tiny, "shN": np.repeat(tiny[:, None, :], 3, axis=1), "log_scales": tiny}
    yield Condition("subnormal", "all", None, watched, ordinary(1, opacity_logits=tiny[:, 0], **changes))
    half = signs * 2.0 ** rng.uniform(-25, -14, (SPLATS, 3))
    changes = {"means": half, "sh0": half, "shN": np.repeat(half[:, None, :], 3, axis=1)}
    yield Condition("subnormal", "of half precision", None, watched, ordinary(1, **changes))
    zeros = np.zeros((SPLATS, 3)) * signs
    changes = {"means": zeros, "sh0": zeros, "shN": np.repeat(zeros[:, None, :], 3, axis=1), "log_scales": zeros}
    yield Condition("subnormal", "0 and -0", None, watched, ordinary(1, opacity_logits=zeros[:, 0], **changes))


def _motions() -> Iterator[Condition]:
    """Speeds from slow to absurd, and times and durations in and out of range."""
    rng = np.random.default_rng(_SEED + 8)
    watched = ("means", "velocities", "times", "durations", "path")

    def moving(speed: float, times: Any, durations: Any, **changes: Any) -> GaussianCloud:
        return ordinary(velocities=speed * _spread(), times=times, durations=durations, **changes)

    times, durations = rng.uniform(0, 0.6, SPLATS), rng.uniform(0.05, 0.4, SPLATS)
    for exponent in (-8, -4, -2, 0, 2, 4, 6, 8, 12, 20, 30):
        speed = 10.0**exponent
        yield Condition("motion", f"speed {speed:.0e}", speed, watched, moving(speed, times, durations))
    cases: dict[str, tuple[Any, Any]] = {
        "times repeated": (np.full(SPLATS, 0.5), durations),
        "times clustered": (0.5 + 2.0**-24 * rng.integers(-8, 8, SPLATS), durations),
        "times out of range": (rng.uniform(-100, 100, SPLATS), durations),
        "durations 0": (times, np.zeros(SPLATS)),
        "durations tiny": (times, 10.0 ** rng.uniform(-12, -6, SPLATS)),
        "durations huge": (times, 10.0 ** rng.uniform(1, 6, SPLATS)),
        "durations negative": (times, -durations),
    }
    for model in ("window", "gaussian"):
        for label, (starts, lengths) in cases.items():
            cloud = moving(1.0, starts, lengths, time_model=model)
            yield Condition("motion", f"{label}, {model}", None, watched, cloud)
