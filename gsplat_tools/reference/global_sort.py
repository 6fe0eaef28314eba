"""One drawing order over several scenes, as gsplat-unity's global renderer makes it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools.errors import CapabilityError
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.motion import Scene, evaluate_scene
from gsplat_tools.reference.sorting import drawing_keys, sort_pairs

MAX_SCENES = 1 << 8
MAX_SPLATS = 1 << 24
_SPLAT_BITS = 24


def sort_scenes(
    scenes: Sequence[Scene], matrices: Sequence[ArrayLike], camera: Camera, *, t: float | None = None
) -> NDArray[np.uint32]:
    """Return one order over the splats of several scenes, far first.

    Parameters
    ----------
    scenes
        At most 256 scenes of at most 2^24 splats.
    matrices
        (4, 4) of each scene, from its space (origin + means) to the world.
    camera
        Where the depth along the view is measured.
    t
        Normalized time; None takes clouds as they are stored.

    Returns
    -------
    ndarray
        uint32, scene in the upper 8 bits and splat in the lower 24. Equal depths: the first scene first, then the order of
        its splats. Hidden splats and NaN come last.

    Raises
    ------
    CapabilityError
        There are more scenes or splats than an entry can name.
    ValueError
        Scenes and matrices differ in number, or a matrix is not (4, 4).

    Source
    ------
    GsplatMergeOrderBuffers.compute of wuyize25/gsplat-unity; merging sorted lists, the first list first on ties, is one
    stable sort of all.
    """
    if len(scenes) != len(matrices):
        raise ValueError(f"needs a matrix for each scene, got {len(scenes)} scenes and {len(matrices)} matrices")
    if len(scenes) > MAX_SCENES:
        raise CapabilityError(f"one order holds at most {MAX_SCENES} scenes, got {len(scenes)}")
    keys, entries = [], []
    for index, (scene, values) in enumerate(zip(scenes, matrices, strict=True)):
        matrix = np.asarray(values, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"matrix {index} must be (4, 4), got {matrix.shape}")
        state = evaluate_scene(scene, t)
        if len(state.means) > MAX_SPLATS:
            raise CapabilityError(
                f"one order holds at most {MAX_SPLATS} splats of a scene, scene {index} has {len(state.means)}"
            )
        keys.append(drawing_keys(state, camera, metric="depth", far_first=True, matrix=matrix))
        entries.append(np.arange(len(state.means), dtype=np.uint32) | np.uint32(index << _SPLAT_BITS))
    if not keys:
        return np.empty(0, np.uint32)
    return sort_pairs(np.concatenate(keys), np.concatenate(entries))[1]


def split_entries(order: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the scene and the splat of each entry of an order of `sort_scenes`."""
    return order >> np.uint32(_SPLAT_BITS), order & np.uint32(MAX_SPLATS - 1)
