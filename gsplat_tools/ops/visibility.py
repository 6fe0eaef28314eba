"""What a change of a splat shows: the energy of its trace in a picture, so that unlike changes have one measure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.constants import SH_C0

Float64 = NDArray[np.float64]

PICTURE_SIZE = 1000.0
"""Pixels that the bulk of the scene spans in the picture that tolerances are about."""

LOW_PASS = 0.3
"""px^2 added to the variance of every splat in a picture (the original 3DGS renderer): nothing is smaller."""

MOST = 16.0
"""No change is allowed that shows more than what the tolerance trades for so many bits."""

MAX_TURN = 0.342
"""Sine of half the largest angle, 40 degrees, that a rotation is turned by: the axes stay those that are nearest."""

MAX_PIXELS = 10.0
"""Largest tolerance that is taken."""

# How much a change shows beyond the energy of its own trace, against a shift. Splats lie over each other, and neighbors are
# changed alike where codes move to common ones: such errors add up instead of averaging out (docs/visual-tolerance.md).
_COLOR_FACTOR = 16.0
_SCALE_FACTOR = 8.0
_TURN_FACTOR = 3.0

# Leaving out a splat saves about ten bytes in .sog4d and .sog. Neighbors go together and all darken the picture, so that
# what they show adds up. Counted 3 times; 2 and 4 suit some scenes better and others worse (docs/visual-tolerance.md).
_SPLAT_BITS = 80.0
_FAINT_FACTOR = 3.0

# Of float32 and of float64 differences of large numbers.
_ROUNDING = 1e-5

_MAX_SAMPLES = 100_000
_EDGE_SHARE = 0.04
_RADIUS_SHARE = 0.95
_MIN_COST = 1e-12
_MAX_LOG = 40.0


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """From where a scene is looked at: as far away as makes its bulk span `PICTURE_SIZE` pixels.

    Parameters
    ----------
    center
        (3,) middle of the bulk, world units without the origin.
    radius
        Of the bulk, world units.
    """

    center: tuple[float, float, float]
    radius: float

    def pixels_per_unit(self, means: NDArray[np.float32]) -> Float64:
        """Return how many pixels a world unit spans at each position, (N,): less in proportion outside the bulk."""
        distances = np.linalg.norm(means.astype(np.float64) - np.asarray(self.center), axis=1)
        scale: Float64 = PICTURE_SIZE / 2 / np.maximum(distances, self.radius)
        return scale


@dataclass(frozen=True, slots=True)
class VisibleCosts:
    """What changes of each splat show, in units of what the tolerance trades for one bit.

    A change d costs cost x d^2; changes that cost more than `MOST` are not made.

    Parameters
    ----------
    position
        (N,) for a shift along any axis, per world unit squared.
    rotation
        (N, 3) for a turn about each local axis, per radian squared.
    scale
        (N,) for a change of any scale coordinate, per squared natural logarithm.
    opacity
        (N,) per squared opacity, 0..1.
    color
        (N,) for a change of any channel of sh0, per square.
    harmonics
        (N,) for a change of any coefficient of the higher bands, per square.
    """

    position: Float64
    rotation: Float64
    scale: Float64
    opacity: Float64
    color: Float64
    harmonics: Float64


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What may show, and from where: a bit is traded for a shift of an opaque round splat by so many pixels."""

    pixels: float
    view: Viewpoint

    def costs(self, cloud: GaussianCloud, log_scales: NDArray[np.float32]) -> VisibleCosts:
        """Return what changes of each splat show; see `visible_costs`."""
        return visible_costs(cloud, log_scales, self.pixels, self.view)

    def to_json(self) -> dict[str, Any]:
        """Return what a file says about the tolerance that it was written with."""
        center = dict(zip("xyz", self.view.center, strict=True))
        return {"pixels": self.pixels, "center": center, "radius": self.view.radius}


def tolerance_from_json(value: Any) -> Tolerance | None:
    """Return what `Tolerance.to_json` gave; anything that no writer of ours gives counts as no tolerance."""
    try:
        x, y, z = (float(value["center"][axis]) for axis in "xyz")
        pixels, radius = float(value["pixels"]), float(value["radius"])
    except (TypeError, KeyError, ValueError, OverflowError):
        return None
    if not (0 < pixels <= MAX_PIXELS and 0 < radius < math.inf and all(map(math.isfinite, (x, y, z)))):
        return None
    return Tolerance(pixels, Viewpoint((x, y, z), radius))


_given: ContextVar[Viewpoint | None] = ContextVar("gsplat_tools_viewpoint", default=None)


@contextmanager
def use_viewpoint(view: Viewpoint | None) -> Iterator[None]:
    """Look at every scene from here inside the block: a part of a scene is to be seen as the whole is. None changes nothing."""
    token = _given.set(_given.get() if view is None else view)
    try:
        yield
    finally:
        _given.reset(token)


def viewpoint(cloud: GaussianCloud) -> Viewpoint:
    """Return from where a scene is looked at; see `viewpoint_of`."""
    return viewpoint_of([cloud], len(cloud))


def viewpoint_of(pieces: Iterable[GaussianCloud], count: int) -> Viewpoint:
    """Return from where a scene in pieces is looked at.

    Parameters
    ----------
    pieces
        Splats with finite means, gone through once.
    count
        About how many they are together; of large scenes, every so many-th is looked at.

    Returns
    -------
    Viewpoint
        Center: the middle of the box that holds all but 4 % of the opacity on each side. Radius: the distance from it
        within which 95 % of the opacity lies, so that a few far splats change nothing.
    """
    from gsplat_tools.attributes.activations import sigmoid

    given = _given.get()
    if given is not None:
        return given
    step = max(1, -(-count // _MAX_SAMPLES))
    samples, passed = list[tuple[NDArray[np.float32], ...]](), 0
    for piece in pieces:
        rows = slice(-passed % step, None, step)
        samples.append((piece.means[rows].copy(), piece.log_scales[rows].copy(), piece.opacity_logits[rows].copy()))
        passed += len(piece)
    if passed == 0:
        return Viewpoint((0.0, 0.0, 0.0), 1.0)
    positions, log_scales, logits = (np.concatenate(arrays) for arrays in zip(*samples, strict=True))
    means, weights = positions.astype(np.float64), sigmoid(logits.astype(np.float64))
    if not weights.sum() > 0:
        weights = np.ones(len(means))
    low, high = (
        np.array([_weighted_quantile(means[:, axis], weights, share) for axis in range(3)])
        for share in (_EDGE_SHARE, 1 - _EDGE_SHARE)
    )
    center = (low + high) / 2
    radius = _weighted_quantile(np.linalg.norm(means - center, axis=1), weights, _RADIUS_SHARE)
    if radius <= 0:  # one splat, or all in one place: its size is what there is to see
        radius = float(3 * np.exp(np.clip(np.median(log_scales), -20, 20)))
    return Viewpoint((float(center[0]), float(center[1]), float(center[2])), radius)


def visible_costs(cloud: GaussianCloud, log_scales: NDArray[np.float32], pixels: float, view: Viewpoint) -> VisibleCosts:
    """Return what changes of each splat show.

    Parameters
    ----------
    cloud
        N splats.
    log_scales
        (N, 3) theirs, in the frames in which rotations are stored.
    pixels
        The tolerance: a bit is traded for a shift of an opaque round splat by so many pixels.
    view
        From where the scene is looked at.

    Notes
    -----
    A splat of opacity o whose trace has the half axes a >= b (px, low-pass included) draws o exp(-r^2 / 2). The energy
    of its change, integrated over the picture, is (pi / 2) o^2 (a / b) d^2 for a shift by d px, pi a b c^2 for a change
    of opacity by c, (3 / 4) pi a b o^2 e^2 for one half axis longer by the share e, of which two of three show, and
    (pi / 4) o^2 (a^2 - b^2)^2 / (a b) t^2 for a turn by t in the plane of the picture, of three planes one. Each follows
    from the moments of exp(-r^2): 1, 1/2 and 3/4. Bands above 0 have 1 / 4 pi as their mean square over directions.
    """
    from gsplat_tools.attributes.activations import sigmoid

    scale = view.pixels_per_unit(cloud.means)
    opacities = sigmoid(cloud.opacity_logits.astype(np.float64))
    variances = _variances(log_scales, scale)
    ordered = np.sort(variances, axis=1)
    area = np.pi * np.sqrt(ordered[:, 2] * ordered[:, 1])
    bit = np.pi / 2 * pixels**2
    power = np.square(opacities) / bit
    shift = np.pi / 2 * np.sqrt(ordered[:, 2] / ordered[:, 1]) * np.square(scale)
    pairs = ((1, 2), (0, 2), (0, 1))
    turns = [
        np.square(variances[:, i] - variances[:, j]) / np.sqrt(variances[:, i] * variances[:, j]) * (np.pi / 12)
        for i, j in pairs
    ]
    color = _COLOR_FACTOR * power * area
    costs = {
        "position": power * shift,
        "rotation": _TURN_FACTOR * power[:, None] * np.stack(turns, axis=1),
        "scale": _SCALE_FACTOR * power * area * (3 / 8),
        "opacity": area / bit,
        "color": color * SH_C0**2,
        "harmonics": color / (4 * np.pi),
    }
    return VisibleCosts(**{name: np.maximum(values, _MIN_COST) for name, values in costs.items()})


def lit_pixels(cloud: GaussianCloud, view: Viewpoint) -> Float64:
    """Return what each splat can show in one channel, (N,): the energy of its trace, in pixels turned from black to white.

    Parameters
    ----------
    cloud
        N splats. Those that move are taken to come as near as the bulk of the scene is.
    view
        From where the scene is looked at.

    Notes
    -----
    pi a b o^2, the integral of (o exp(-r^2 / 2))^2 over the largest trace of a splat of opacity o, half axes a and b.
    Whatever lies behind it, taking it away changes a channel by no more.
    """
    from gsplat_tools.attributes.activations import sigmoid

    scale = view.pixels_per_unit(cloud.means)
    if cloud.has_motion:
        scale = np.full(len(cloud), PICTURE_SIZE / 2 / view.radius)
    ordered = np.sort(_variances(cloud.log_scales, scale), axis=1)
    energy = np.pi * np.sqrt(ordered[:, 2] * ordered[:, 1]) * np.square(sigmoid(cloud.opacity_logits.astype(np.float64)))
    return np.asarray(energy, np.float64)


def faint_pixels(pixels: float) -> float:
    """Return the lit pixels below which a splat is not worth its bits at a tolerance; 0 without one.

    Over three channels, and counted `_FAINT_FACTOR` times, it then shows less than what `_SPLAT_BITS` are traded for.
    """
    return _SPLAT_BITS * np.pi / 2 * pixels**2 / (3 * _FAINT_FACTOR)


def _variances(log_scales: NDArray[np.float32], scale: Float64) -> Float64:
    """Return the variances of traces along the three axes, (N, 3) px^2."""
    with np.errstate(divide="ignore"):
        logs = np.clip(log_scales + np.log(scale)[:, None], -_MAX_LOG, _MAX_LOG)
    variances: Float64 = np.exp(2 * logs.astype(np.float64)) + LOW_PASS
    return variances


def allowed_error(costs: Float64) -> Float64:
    """Return the largest change that is made for the sake of a bit, from its cost per square, with room for rounding."""
    return np.asarray(np.sqrt(MOST / costs) * (1 + _ROUNDING), np.float64)


def _weighted_quantile(values: Float64, weights: Float64, share: float) -> float:
    """Return the smallest value below or at which `share` of the weight lies."""
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(cumulative, share * cumulative[-1])]])
