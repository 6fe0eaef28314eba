"""The depth sort of the targets: sortable keys, the device's radix sort, and drawing orders of a scene."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools import parallel
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.motion import Scene, SceneState, evaluate_scene

Metric = Literal["depth", "radial", "clip"]

LAST_KEY = 0xFFFFFFFF
"""Key of what is hidden or NaN: sorts last."""

_BLOCK_SIZE = 1 << 18
"""Keys a block; larger than elsewhere, since every pass scans the digits of all blocks."""

_KEY_BITS = 32


def float_to_sortable(values: ArrayLike) -> NDArray[np.uint32]:
    """Map floats to unsigned integers that sort in the same order.

    Parameters
    ----------
    values
        Float32, any shape.

    Returns
    -------
    ndarray
        uint32: bits ^ 0xFFFFFFFF for a set sign, bits ^ 0x80000000 otherwise. The map is exact and one to one: -0 comes
        before +0, NaNs before -inf or after +inf by their sign.

    Source
    ------
    FloatToSortableUint in gsplat-unity's GsplatCutout.hlsl; Terdiman 2000, Radix Sort Revisited.
    """
    values = np.ascontiguousarray(values, np.float32)
    return _sortable(values.ravel(), nan_last=False).reshape(values.shape)


def sort_pairs(keys: NDArray[np.uint32], payload: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Sort pairs by key, ascending and stable, as a device does.

    Parameters
    ----------
    keys
        (N,) uint32.
    payload
        (N,) uint32, carried along.

    Returns
    -------
    tuple
        Sorted keys and their payload, (N,) uint32 each.

    Raises
    ------
    ValueError
        The arrays are not one-dimensional uint32 of one length.

    Notes
    -----
    Four passes over digits of 8 bits, least significant first: upsweep (histogram of each block), exclusive scan,
    downsweep (stable scatter). A pass whose digit is the same everywhere moves nothing and is left out. The same bits
    for any number of threads. Two buffers of 8 bytes a pair, of which one is returned: 320 MB for 20 million.
    """
    for name, values in (("keys", keys), ("payload", payload)):
        if not isinstance(values, np.ndarray) or values.dtype != np.uint32 or values.ndim != 1:
            raise ValueError(f"{name} must be a one-dimensional uint32 array, got {getattr(values, 'dtype', type(values))}")
    if keys.shape != payload.shape:
        raise ValueError(f"keys and payload must be equal in length, got {len(keys)} and {len(payload)}")
    if len(keys) == 0:
        return keys.copy(), payload.copy()
    return _sort(np.ascontiguousarray(keys), np.ascontiguousarray(payload))


def sort_by_depth(
    scene: Scene,
    camera: Camera,
    *,
    t: float | None = None,
    metric: Metric = "depth",
    order: NDArray[np.uint32] | None = None,
) -> NDArray[np.uint32]:
    """Return the order in which a target draws from back to front.

    Parameters
    ----------
    scene
        N splats, or a sequence, of which the frame at `t` is taken.
    camera
        Where the depth is measured.
    t
        Normalized time; None takes a cloud as it is stored.
    metric
        "depth" along the view (gsplat-unity, 3DGS), "radial" distance (Spark), or "clip", Visionary's far plane less
        clip z, which is along the view too but makes neighbours equal where far / near is large.
    order
        (M,) uint32 initial payload, such as the splats that a cutout left; 0..N-1 by default.

    Returns
    -------
    ndarray
        (N,) or (M,) uint32 indices of splats, far first. Splats outside their time window and splats whose depth is NaN
        come last. Equal depths keep the order of the payload.

    Raises
    ------
    ValueError
        The metric is unknown, or `order` names a splat that is not there.

    Notes
    -----
    Memory: keys and depths 8 bytes a splat beside the buffers of `sort_pairs`, 480 MB in all for 20 million splats.
    """
    if metric not in get_args(Metric):
        raise ValueError(f"metric must be one of {get_args(Metric)}, got {metric!r}")
    state = evaluate_scene(scene, t)
    keys = drawing_keys(state, camera, metric=metric, far_first=True)
    if order is None:
        return sort_keys(keys)
    order = checked_order(order, len(keys))
    return sort_pairs(keys[order], order)[1]


def checked_order(order: ArrayLike, count: int) -> NDArray[np.uint32]:
    """Return a drawing order as uint32.

    Raises
    ------
    ValueError
        It is not a one-dimensional array of indices below `count`.
    """
    indices = np.asarray(order)
    if indices.ndim != 1 or not np.issubdtype(indices.dtype, np.integer):
        raise ValueError(f"order must be a one-dimensional array of indices, got {indices.dtype} of shape {indices.shape}")
    if len(indices) and (indices.min() < 0 or indices.max() >= count):
        raise ValueError(f"order must name splats 0..{count - 1}, found {indices.min()}..{indices.max()}")
    return np.ascontiguousarray(indices, np.uint32)


def drawing_keys(
    state: SceneState, camera: Camera, *, metric: Metric, far_first: bool, matrix: NDArray[np.float64] | None = None
) -> NDArray[np.uint32]:
    """Return keys (N,) that sort ascending into a drawing order; NaN and what is hidden go last.

    A matrix (4, 4) places the scene in the world.
    """
    from gsplat_tools.kernels.depth_keys import METRIC_DEPTH, METRIC_RADIAL, fill_depths

    means = state.means
    view = view_rows(camera, state.cloud.origin, matrix)
    depths = np.empty(len(means), np.float32)
    kind = METRIC_RADIAL if metric == "radial" else METRIC_DEPTH
    sign = -1.0 if far_first and metric != "clip" else 1.0
    parallel.run_blocks(lambda start, stop: fill_depths(means, view, kind, sign, start, stop, depths), len(means), _BLOCK_SIZE)
    keys = _clip_keys(depths, camera) if metric == "clip" else _sortable(depths, nan_last=True)
    if state.is_visible is not None:
        keys[~state.is_visible] = LAST_KEY
    return keys


def _clip_keys(depths: NDArray[np.float32], camera: Camera) -> NDArray[np.uint32]:
    """Return the bits of far plane - clip z, both as float32 arithmetic finds them in the projection matrix.

    Negative differences keep their sign bit and come last, as nearest.
    """
    near, far = np.float64(camera.near), np.float64(camera.far)
    slope, shift = np.float32(far / (far - near)), np.float32(-far * near / (far - near))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        recovered = -shift / (slope - np.float32(1))
        differences = recovered - (slope * depths + shift)
    keys = differences.view(np.uint32).copy()
    keys[np.isnan(depths)] = LAST_KEY
    return keys


def view_rows(camera: Camera, origin: NDArray[np.float64], matrix: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the view as (12,) float64 for means relative to `origin`: rows of the rotation with their translation."""
    # In float64, before anything is narrowed: a distant origin must cost no precision.
    view = camera.viewmat if matrix is None else camera.viewmat @ matrix
    translation = view[:3, :3] @ origin + view[:3, 3]
    return np.concatenate([view[:3, :3], translation[:, None]], axis=1).ravel()


def sort_keys(keys: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the indices (N,) that sort the keys, stable."""
    if len(keys) == 0:
        return np.empty(0, np.uint32)
    return _sort(keys, np.empty(0, np.uint32))[1]


def _sortable(values: NDArray[np.float32], *, nan_last: bool) -> NDArray[np.uint32]:
    """Map a flat array to sortable keys."""
    from gsplat_tools.kernels.radix_sort import sortable_bits

    bits, keys = values.view(np.uint32), np.empty(len(values), np.uint32)
    parallel.run_blocks(lambda start, stop: sortable_bits(bits, nan_last, start, stop, keys), len(values), _BLOCK_SIZE)
    return keys


def _sort(keys: NDArray[np.uint32], payload: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Sort at least one pair; an empty payload stands for the indices."""
    from gsplat_tools.kernels.radix_sort import DIGIT_BITS, join_words, split_words

    count = len(keys)
    source, target = np.empty(count, np.uint64), np.empty(count, np.uint64)
    joined, counts = source, _new_counts(count)
    parallel.run_blocks(
        lambda start, stop: join_words(keys, payload, start, stop, joined, counts[start // _BLOCK_SIZE]), count, _BLOCK_SIZE
    )
    if _sort_digit(source, target, 0, counts):
        source, target = target, source
    for shift in range(DIGIT_BITS, _KEY_BITS, DIGIT_BITS):
        if _sort_digit(source, target, shift, _count_digits(source, shift)):
            source, target = target, source
    # The spare buffer becomes the result: two halves of it, as long as the keys.
    halves = target.view(np.uint32)
    sorted_keys, sorted_payload = halves[:count], halves[count:]
    parallel.run_blocks(lambda start, stop: split_words(source, start, stop, sorted_keys, sorted_payload), count, _BLOCK_SIZE)
    return sorted_keys, sorted_payload


def _new_counts(count: int) -> NDArray[np.int64]:
    """Return a histogram of zeros for each block."""
    from gsplat_tools.kernels.radix_sort import NUM_DIGITS

    return np.zeros((len(parallel.blocks(count, _BLOCK_SIZE)), NUM_DIGITS), np.int64)


def _count_digits(words: NDArray[np.uint64], shift: int) -> NDArray[np.int64]:
    """Return the histogram of a digit in each block."""
    from gsplat_tools.kernels.radix_sort import upsweep

    counts = _new_counts(len(words))
    parallel.run_blocks(
        lambda start, stop: upsweep(words, shift, start, stop, counts[start // _BLOCK_SIZE]), len(words), _BLOCK_SIZE
    )
    return counts


def _sort_digit(source: NDArray[np.uint64], target: NDArray[np.uint64], shift: int, counts: NDArray[np.int64]) -> bool:
    """Sort by one digit into `target`; return False, and leave it alone, where the digit is the same everywhere."""
    from gsplat_tools.kernels.radix_sort import downsweep, scan

    offsets = np.empty_like(counts)
    if scan(counts, offsets) <= 1:
        return False
    parallel.run_blocks(
        lambda start, stop: downsweep(source, shift, start, stop, offsets[start // _BLOCK_SIZE], target),
        len(source),
        _BLOCK_SIZE,
    )
    return True
