"""Cutouts of gsplat-unity: volumes that hide the splats outside, or inside, them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.reference.motion import Scene, SceneState, evaluate_scene

CutoutKind = Literal["ellipsoid", "box", "none"]


@dataclass(frozen=True, slots=True, eq=False)
class Cutout:
    """A volume that hides splats.

    Parameters
    ----------
    matrix
        (4, 4) from the scene's space (origin + means) to the cutout's, where the volume is the unit sphere or the cube
        from -1 to 1.
    kind
        "ellipsoid", "box", or "none", which hides nothing.
    invert
        Without it what lies outside is hidden, with it what lies inside.

    Raises
    ------
    ValueError
        The matrix is not (4, 4) and finite, or the kind is unknown.

    Source
    ------
    GsplatCutout.hlsl of wuyize25/gsplat-unity.
    """

    matrix: NDArray[np.float64]
    kind: CutoutKind = "ellipsoid"
    invert: bool = False

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"matrix must hold (4, 4) finite numbers, got shape {matrix.shape}")
        if self.kind not in get_args(CutoutKind):
            raise ValueError(f"kind must be one of {get_args(CutoutKind)}, got {self.kind!r}")
        object.__setattr__(self, "matrix", matrix)


def apply_cutouts(
    scene: Scene, cutouts: Sequence[Cutout], *, t: float | None = None
) -> tuple[NDArray[np.uint32], tuple[NDArray[np.float64], NDArray[np.float64]] | None]:
    """Return what gsplat-unity's pre-pass finds: the splats that no cutout hides, and their bounds.

    Parameters
    ----------
    scene
        N splats, or a sequence.
    cutouts
        A splat is hidden when any of them says so.
    t
        Normalized time; None takes a cloud as it is stored.

    Returns
    -------
    tuple
        Indices of the survivors, ascending uint32, to give to `sort_by_depth` or `render` as `order`; and (min, max) of
        their means in world units, (3,) float64 each, or None where none is left.
    """
    state = evaluate_scene(scene, t)
    survivors = np.flatnonzero(find_survivors(state, cutouts)).astype(np.uint32)
    if len(survivors) == 0:
        return survivors, None
    means = state.means[survivors].astype(np.float64)
    return survivors, (state.cloud.origin + means.min(axis=0), state.cloud.origin + means.max(axis=0))


def find_survivors(state: SceneState, cutouts: Sequence[Cutout]) -> NDArray[np.bool_]:
    """Return (N,) whether no cutout hides each splat; NaN lies outside everything."""
    means = state.means
    survives = np.ones(len(means), np.bool_)
    for cutout in cutouts:
        if cutout.kind == "none":
            continue
        rotation = cutout.matrix[:3, :3].astype(means.dtype)
        shift = (cutout.matrix[:3, :3] @ state.cloud.origin + cutout.matrix[:3, 3]).astype(means.dtype)
        places = shift + sum(means[:, axis, None] * rotation[None, :, axis] for axis in range(3))
        is_ball = cutout.kind == "ellipsoid"
        is_inside = np.square(places).sum(axis=1) <= 1 if is_ball else (np.abs(places) <= 1).all(axis=1)
        survives &= is_inside != cutout.invert
    return survives
