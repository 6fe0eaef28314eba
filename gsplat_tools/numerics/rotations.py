"""How far rotations turn, in degrees, and how far the codes of each format let them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import permutations, product
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import quaternions
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.base import Format

Float64 = NDArray[np.float64]

ATTRIBUTE = "rotations (degrees)"

_FLOAT32_TURN = 2.0**-20
"""Turn that float32 arithmetic on unit quaternions adds at most, radians: 2 asin of a few of their half steps."""

_ARITHMETIC = 1e-12
"""What measuring adds in float64, degrees."""


def rotation_errors(source: GaussianCloud, decoded: GaussianCloud) -> Float64:
    """Return the angle between the axes of two clouds, (N,) degrees.

    Notes
    -----
    Encoders name the axes of a splat anew, which turns its quaternion and not its Gaussian: of the 24 names of right-handed
    axes the nearest counts. Angles are therefore at most 62.8 degrees.
    """
    between = _conjugate_product(source.quats.astype(np.float64), decoded.quats.astype(np.float64))
    names = np.stack(list(_frame_quaternions()))
    # (N, 24): w of the product with every name; the rest has what is left of the length.
    turned = np.abs(between @ (names * [1, -1, -1, -1]).T)
    best = names[np.argmax(turned, axis=1)]
    rest = quaternions.multiply(between, best)
    angles = 2 * np.arctan2(np.linalg.norm(rest[:, 1:], axis=1), np.abs(rest[:, 0]))
    # Equal bits are no turn, whatever arithmetic makes of them.
    return np.where((source.quats == decoded.quats).all(axis=1), 0.0, np.degrees(angles))


def _conjugate_product(left: Float64, right: Float64) -> Float64:
    """Return the unit quaternions that lead from one rotation to another."""
    return quaternions.multiply(quaternions.normalize(left) * [1, -1, -1, -1], quaternions.normalize(right))


def _frame_quaternions() -> Iterator[Float64]:
    """Yield the 24 rotations that map axes to axes."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.eye(3)[:, list(order)] * signs
        if np.linalg.det(matrix) > 0:
            yield quaternions.from_matrix(matrix[None])[0]


def rotation_limits(
    source: GaussianCloud, record: Format, stream: BinaryIO, frame: int, covariances: NDArray[np.floating] | None
) -> Float64 | None:
    """Return the largest turns that a format's codes allow, broadcastable to (N,), degrees; None where none is known.

    Parameters
    ----------
    source
        The splats as they were written.
    record, stream, frame
        The format, the file, and which of its frames.
    covariances
        The bound of `covariances`, (N,) or broadcastable to it.
    """
    if record.id in _FROM_COVARIANCES:
        if covariances is None:
            return None
        turns = eigenvector_turns(source.log_scales, np.broadcast_to(covariances, len(source)))
    elif record.id in _TURNS:
        stream.seek(0)
        turns = np.asarray(_TURNS[record.id](stream, frame), np.float64)
        if record.id not in _EXACT:
            turns = turns + _FLOAT32_TURN
    else:
        return None
    return np.degrees(turns) + (0.0 if record.id in _EXACT else _ARITHMETIC)


def eigenvector_turns(log_scales: NDArray[np.float32], relative: NDArray[np.floating]) -> Float64:
    """Return how far the axes of covariances turn that are off by a share of their norm, (N,) radians; inf where any may.

    Notes
    -----
    Davis and Kahan as Yu, Wang and Samworth 2015 put it: the sine of an axis's turn is at most 2 ||E|| / gap, the gap that of
    its eigenvalue to the next. Three axes that turn by a each, at most, are a rotation with trace 1 + 2 cos(turn) >= 3 cos(a).
    Where a reaches 30 degrees, axes may as well have changed their names.
    """
    logs = np.sort(log_scales.astype(np.float64), axis=1)
    longest = np.where(np.isfinite(logs[:, 2:]), logs[:, 2:], 0.0)
    values = np.exp(2 * (logs - longest))
    gaps = np.diff(values, axis=1).min(axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sines = 2 * relative * np.linalg.norm(values, axis=1) / gaps
    angles = np.arcsin(np.clip(np.nan_to_num(sines, nan=1.0), 0.0, 1.0))
    turns = np.arccos(np.clip((3 * np.cos(angles) - 1) / 2, -1, 1)) + _FLOAT32_TURN
    return np.where(angles < np.pi / 6, turns, np.inf)


def _sog(stream: BinaryIO, _frame: int) -> Float64:
    """Return the turns of codes whose components lie within a step of their source.

    Notes
    -----
    The encoder takes the code whose covariance errs least, each component rounded up or down. Three components that move by
    a step each move by e = sqrt(3) / steps together; the one left out is at least l = sqrt(1 - (v + e)^2) on the way, v the
    length of those stored, and the point on the sphere moves by at most e / l. A rotation turns by twice that.
    """
    from gsplat_tools.codecs.quaternion_sog import GRID, decode
    from gsplat_tools.formats.sog.bundle import open_bundle

    bundle, _ = open_bundle(stream)
    assert bundle is not None
    quats = decode(bundle.codes("quats")).astype(np.float64)
    stored = np.sqrt(np.maximum(1 - np.square(quats).max(axis=1), 0.0))
    moved = np.sqrt(3.0) / GRID.steps
    return np.asarray(2 * moved / np.sqrt(1 - np.square(stored + moved)))


def _sog4d(stream: BinaryIO, frame: int) -> float:
    from gsplat_tools.formats.sog4d.bounds import rotation_bound
    from gsplat_tools.formats.sog4d.bundle import Bundle
    from gsplat_tools.formats.sog4d.meta import frame_path
    from gsplat_tools.formats.sog4d.textures import pixels_of

    bundle = Bundle(stream)
    path = frame_path(bundle.meta.rotation_path, frame)
    return rotation_bound(pixels_of(bundle.image(path, frame), bundle.meta.splat_count))


def _spz(stream: BinaryIO, _frame: int) -> float:
    from gsplat_tools.formats.spz import inspect
    from gsplat_tools.formats.spz.attributes import rotation_grid

    return rotation_grid(int(inspect(stream).version)).max_angle


def _spark(_stream: BinaryIO, _frame: int) -> float:
    from gsplat_tools.formats.pack.limits import SPARK_ANGLE

    return SPARK_ANGLE


def _four_bytes(_stream: BinaryIO, _frame: int) -> float:
    from gsplat_tools.codecs.quaternion_u8 import MAX_ANGLE

    return MAX_ANGLE


def _shortened_bytes(_stream: BinaryIO, _frame: int) -> float:
    """Return the turn of bytes whose length was chosen for the covariance, down to half of the longest that fits.

    A residual of at most one step, half in each of four components, lies across a ray of at least half of 127.49 steps. A
    turn beyond `quaternion_u8.MAX_ANGLE` is one that the covariance hardly shows.
    """
    return float(2 * np.arcsin(2 / 127.49))


def _compressed_ply(_stream: BinaryIO, _frame: int) -> float:
    from gsplat_tools.codecs.smallest_three import PACKED_PLY

    return PACKED_PLY.max_angle


_EXACT = ("ply",)
"""Formats that keep quaternions as they are."""

_FROM_COVARIANCES = ("visionary-f16", "visionary-f32")
"""Formats that hold covariances, whose eigenvectors readers take for the axes."""

_TURNS: dict[str, Callable[[BinaryIO, int], Float64 | float]] = {
    "ply": lambda _stream, _frame: 0.0,
    "uncompressed": lambda _stream, _frame: 0.0,
    "spark": _spark,
    "gscc": _spark,
    "compressed-ply": _compressed_ply,
    "splat": _shortened_bytes,
    "splat4d": _shortened_bytes,
    "visionary-i8": _four_bytes,
    "spz": _spz,
    "sog": _sog,
    "sog4d": _sog4d,
}
"""Largest turn of each format's code, radians, one for all splats or one a splat."""
