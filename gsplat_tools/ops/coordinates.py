"""Change of coordinate system: means, origin, quaternions, SH, velocities and normals together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import quaternions, spherical_harmonics
from gsplat_tools.attributes.coordinate_systems import (
    UNKNOWN,
    axis_map,
    changes_handedness,
    changes_signs_only,
    is_known,
    quaternion_signs,
)
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.sequence import GaussianSequence

_NORMALS = ("nx", "ny", "nz")


def name_axes(scene: GaussianCloud | GaussianSequence, axes: str | None) -> GaussianCloud | GaussianSequence:
    """Return a scene that says what its axes are; no number changes.

    Parameters
    ----------
    scene
        A cloud, or frames.
    axes
        Axis letters, in place of what the scene says; None leaves it.
    """
    if axes is None:
        return scene
    name = axes.upper()
    if isinstance(scene, GaussianSequence):
        return scene.map(lambda cloud: cloud.replace(coordinate_system=name))
    return scene.replace(coordinate_system=name)


def convert_coordinates(cloud: GaussianCloud, target: str, source: str | None = None) -> GaussianCloud:
    """Return the cloud in another coordinate system.

    Parameters
    ----------
    cloud
        N Gaussians of any SH degree, with or without motion.
    target
        Axis letters of the result, such as "RUF".
    source
        Axis letters that the cloud is in; by default what the cloud says. Given, it overrides the cloud.

    Returns
    -------
    GaussianCloud
        Means, origin, velocities and normals (extra properties nx, ny, nz) are mapped, quaternions and SH follow;
        scales, colors and opacities stay. Where the systems differ by signs only, nothing is rounded and the way back
        restores every bit; else quaternions and SH are rounded once to float32.

    Raises
    ------
    CloudError
        The source is unknown, or a name is not three axis letters.
    """
    found = cloud.coordinate_system if source is None else source
    if found == UNKNOWN:
        raise CloudError(
            f"the coordinate system of the cloud is unknown, so it cannot be converted to {target}: "
            "say what it is with --source-coordinates (source=), such as RUB or RDF",
            field="coordinate_system",
        )
    target, found = target.upper(), found.upper()
    for name in (found, target):
        if not is_known(name):
            raise CloudError(
                f"expected three axis letters, one each of R/L, U/D and F/B, such as RUB or RDF, found {name!r}",
                field="coordinate_system",
            )
    if found == target:
        return cloud.replace(coordinate_system=target)
    matrix = axis_map(found, target)
    changes: dict[str, Any] = {
        "coordinate_system": target,
        "means": _map_vectors(cloud.means, matrix),
        "origin": matrix @ cloud.origin + 0.0,
        "extra": _map_normals(cloud, matrix),
    }
    if cloud.velocities is not None:
        changes["velocities"] = _map_vectors(cloud.velocities, matrix)
    if changes_signs_only(matrix):
        signs = np.diagonal(matrix)
        changes["quats"] = _flip(cloud.quats, quaternion_signs(signs))
        changes["shN"] = _flip(cloud.shN, spherical_harmonics.flip_signs(signs, cloud.sh_degree)[1:])
    else:
        # A Gaussian is symmetric about its center, so that a reflection P maps it as the rotation -P does.
        turn = quaternions.from_matrix(-matrix if changes_handedness(matrix) else matrix)
        changes["quats"] = quaternions.multiply(turn, cloud.quats)
        changes["shN"] = spherical_harmonics.rotate(cloud.shN, matrix)
    return cloud.replace(**changes)


def _map_vectors(vectors: NDArray[Any], matrix: NDArray[np.float64]) -> NDArray[Any]:
    """Apply a signed permutation to (N, 3) vectors by copying and negating columns, which rounds nothing."""
    axes = np.argmax(np.abs(matrix), axis=1)
    return _flip(vectors[:, axes], matrix[np.arange(3), axes])


def _flip(values: NDArray[Any], signs: NDArray[np.float64]) -> NDArray[Any]:
    """Return a copy, negated where the sign of the index along the second axis is negative."""
    result = values.copy()
    flipped = np.flatnonzero(signs < 0)
    result[:, flipped] = -result[:, flipped]
    return result


def _map_normals(cloud: GaussianCloud, matrix: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Return the extra properties with nx, ny, nz mapped as vectors where all three are there."""
    extra = dict(cloud.extra)
    if all(name in extra and extra[name].ndim == 1 for name in _NORMALS):
        normals = _map_vectors(np.stack([extra[name] for name in _NORMALS], axis=1), matrix)
        extra.update({name: normals[:, i].copy() for i, name in enumerate(_NORMALS)})
    return extra
