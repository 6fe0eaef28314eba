"""preprocess: the records, keys and counters that Visionary's first compute pass leaves behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.visionary_buffers import Precision, ShLayout
from gsplat_tools.reference._visionary_stages import RECORD, RenderMode, Settings, pack_records, preprocess_scene
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.motion import SceneState
from gsplat_tools.reference.sorting import LAST_KEY, sort_pairs

__all__ = [
    "INITIAL_TOTAL",
    "KEYS_PER_BLOCK",
    "RECORD",
    "Counters",
    "Preprocessed",
    "RenderMode",
    "count_frame",
    "merge_models",
    "preprocess",
    "sort_records",
]

KEYS_PER_BLOCK = 3840
"""Keys that a workgroup of the sorter takes: 256 threads of 15."""

INITIAL_TOTAL = 1_000_000
"""Splats that the buffers are made for at first; their capacity is 5/4 of the total."""


@dataclass(frozen=True, slots=True)
class Counters:
    """What the three small buffers hold after a frame was preprocessed and sorted, by the names of their fields.

    Parameters
    ----------
    keys_size
        SortInfos: records written.
    padded_size
        SortInfos: capacity rounded up to whole blocks of 3840 keys; keys behind the records are 0xFFFFFFFF.
    passes
        SortInfos: digits of a key, 4.
    even_pass, odd_pass
        SortInfos: toggles of the scatter passes, 0 and 1 after all four.
    vertex_count, instance_count, base_vertex, base_instance
        DrawIndirect: 4 corners, and an instance a record.
    dispatch_x, dispatch_y, dispatch_z
        DispatchIndirect: workgroups of the sorter, one more than whole blocks need; dispatch_x is 0 where there were no
        splats at all.
    """

    keys_size: int
    padded_size: int
    passes: int
    even_pass: int
    odd_pass: int
    vertex_count: int
    instance_count: int
    base_vertex: int
    base_instance: int
    dispatch_x: int
    dispatch_y: int
    dispatch_z: int

    @property
    def sort_infos(self) -> NDArray[np.uint32]:
        """SortInfos as it lies in its buffer, (5,) uint32."""
        return np.array([self.keys_size, self.padded_size, self.passes, self.even_pass, self.odd_pass], np.uint32)

    @property
    def draw_indirect(self) -> NDArray[np.uint32]:
        """DrawIndirect as it lies in its buffer, (4,) uint32."""
        return np.array([self.vertex_count, self.instance_count, self.base_vertex, self.base_instance], np.uint32)

    @property
    def dispatch_indirect(self) -> NDArray[np.uint32]:
        """DispatchIndirect as it lies in its buffer, (3,) uint32."""
        return np.array([self.dispatch_x, self.dispatch_y, self.dispatch_z], np.uint32)


@dataclass(frozen=True, slots=True, eq=False)
class Preprocessed:
    """The buffers that the preprocess pass leaves behind.

    Parameters
    ----------
    records
        (K,) of dtype RECORD, in the order of the splats (the order is not defined on a device).
    keys
        (K,) uint32 bits of far plane - clip z: ascending is back to front.
    payload
        (K,) uint32, each record's own index.
    counters
        SortInfos, DrawIndirect and DispatchIndirect.
    splat_ids
        (K,) uint32 splat that each record came from.
    num_splats
        Splats that were preprocessed.
    culled
        Splats that the rules left out.
    invalid
        Splats that were left out because a value is not finite, before or after projection, which a device does not
        define.
    undefined_eigenvectors
        Records whose axis a device leaves undefined (0/0); ours is (1, 0).
    """

    records: NDArray[Any]
    keys: NDArray[np.uint32]
    payload: NDArray[np.uint32]
    counters: Counters
    splat_ids: NDArray[np.uint32]
    num_splats: int
    culled: int
    invalid: int
    undefined_eigenvectors: int


def preprocess(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    kernel_size: float = 0.1,
    sh_degree: int | None = None,
    raw_color: bool = False,
    sh_layout: ShLayout = "interleaved",
    precision: Precision = "f32",
    max_world_trace: float | None = None,
    gaussian_scaling: float = 1.0,
    opacity_scale: float = 1.0,
    cutoff_scale: float = 1.0,
    render_mode: RenderMode = "color",
    mip: bool = True,
    model_matrix: ArrayLike | None = None,
    dtype: Literal["float32", "float64"] = "float32",
) -> Preprocessed:
    """Turn splats into the records, keys and counters of Visionary's preprocess pass.

    Parameters
    ----------
    cloud
        N splats, as they are stored; motion is not evaluated.
    camera
        In world coordinates: world = origin of the cloud + means. Its planes are those of the projection.
    kernel_size
        Low-pass filter, px^2, added to both diagonals of the projected covariance.
    sh_degree
        Highest SH band, 0 to 3; by default that of the cloud, at most 3.
    raw_color
        Whether colors are 0.5 + SH_C0 sh0, stored without SH, as for models that output RGB.
    sh_layout
        Layout that the SH buffer is written and read with: "interleaved", as Visionary does, or "channel-major", as its
        shader documents. Both give the same records.
    precision
        Of the buffers: "f32", or "f16" as Visionary's file loaders store everything.
    max_world_trace
        Splats whose covariance in the world has a larger trace are dropped, world units squared. Documented, but
        commented out in the shader: None drops nothing.
    gaussian_scaling
        Factor of the scales.
    opacity_scale
        Factor of the opacities, before the cull.
    cutoff_scale
        Factor of both axes, at least 0.1; it enlarges the Gaussian itself, not its cut-off.
    render_mode
        "color", "normal" (smallest axis as a color) or "depth" (1 - ndc z).
    mip
        Whether opacities are compensated for the low-pass filter. Visionary always does, whatever its option says.
    model_matrix
        (4, 4) scene to world, rotation and uniform scale, the last row 0 0 0 1; by default none.
    dtype
        What is computed in: "float32" as the device, or "float64", the same code as an oracle.

    Returns
    -------
    Preprocessed
        Records, keys, payload and counters; the same bits for any number of threads.

    Raises
    ------
    ValueError
        An argument is not one of those above.

    Notes
    -----
    Memory: about 60 bytes a record beside the cloud.

    Source
    ------
    preprocess.wgsl of Visionary-Laboratory/visionary @ c5d7070; docs/visionary.md says where documentation and shader
    part.
    """
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype must be 'float32' or 'float64', got {dtype!r}")
    if precision not in get_args(Precision):
        raise ValueError(f"precision must be one of {', '.join(get_args(Precision))}, got {precision!r}")
    settings = Settings(
        kernel_size=kernel_size,
        sh_degree=sh_degree,
        raw_color=raw_color,
        sh_layout=sh_layout,
        precision=precision,
        max_world_trace=max_world_trace,
        gaussian_scaling=gaussian_scaling,
        opacity_scale=opacity_scale,
        cutoff_scale=cutoff_scale,
        render_mode=render_mode,
        mip=mip,
        model_matrix=model_matrix,
    )
    found = preprocess_scene(SceneState(cloud, cloud.means, None, None), camera, settings, dtype)
    return Preprocessed(
        records=pack_records(found.values),
        keys=found.keys,
        payload=np.arange(len(found.keys), dtype=np.uint32),
        counters=count_frame(len(cloud), len(found.keys)),
        splat_ids=found.splat_ids,
        num_splats=len(cloud),
        culled=found.culled,
        invalid=found.invalid,
        undefined_eigenvectors=found.undefined_eigenvectors,
    )


def sort_records(preprocessed: Preprocessed) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the key and payload buffers after the sorter: back to front, padding last.

    Parameters
    ----------
    preprocessed
        K records.

    Returns
    -------
    tuple
        Keys (padded_size,) uint32, 0xFFFFFFFF behind the first K, and the payload (K,) uint32, the drawing order. Equal
        keys keep the order of the records; on a device it changes from frame to frame.
    """
    keys = np.full(preprocessed.counters.padded_size, LAST_KEY, np.uint32)
    keys[: len(preprocessed.keys)], payload = sort_pairs(preprocessed.keys, preprocessed.payload)
    return keys, payload


def count_frame(num_splats: int, num_records: int) -> Counters:
    """Return the counters of a frame.

    Parameters
    ----------
    num_splats
        Splats that were preprocessed.
    num_records
        Records that they gave.

    Raises
    ------
    ValueError
        There are more records than splats, or fewer than none.
    """
    if not 0 <= num_records <= num_splats:
        raise ValueError(f"expected 0 <= num_records <= num_splats, got {num_records} and {num_splats}")
    capacity = -(-5 * max(num_splats, INITIAL_TOTAL) // 4)
    # The first splat asks for one more workgroup, so that the last block is never full.
    workgroups = -(-num_records // KEYS_PER_BLOCK) + (1 if num_splats else 0)
    return Counters(
        keys_size=num_records,
        padded_size=-(-capacity // KEYS_PER_BLOCK) * KEYS_PER_BLOCK,
        passes=4,
        even_pass=0,
        odd_pass=1,
        vertex_count=4,
        instance_count=num_records,
        base_vertex=0,
        base_instance=0,
        dispatch_x=workgroups,
        dispatch_y=1,
        dispatch_z=1,
    )


def merge_models(frames: Sequence[Preprocessed]) -> Preprocessed:
    """Join the frames of several models, preprocessed one after the other, into the buffers that they share.

    Parameters
    ----------
    frames
        One frame a model, in drawing order of the scene graph, of one camera.

    Returns
    -------
    Preprocessed
        Records of all models behind one another, as on a device that ran the passes in turn; the payload counts through.
        `splat_ids` counts through the splats of all models, the sum of those before a model being its baseOffset.

    Notes
    -----
    The sorter's extra workgroup is asked for once, by the first splat of the model with baseOffset 0.
    """
    records = np.concatenate([np.empty(0, RECORD), *(frame.records for frame in frames)])
    splats = sum(frame.num_splats for frame in frames)
    offsets = np.cumsum([0, *(frame.num_splats for frame in frames)])
    ids = [frame.splat_ids.astype(np.int64) + offset for frame, offset in zip(frames, offsets[:-1], strict=True)]
    return Preprocessed(
        records=records,
        keys=np.concatenate([np.empty(0, np.uint32), *(frame.keys for frame in frames)]),
        payload=np.arange(len(records), dtype=np.uint32),
        counters=count_frame(splats, len(records)),
        splat_ids=np.concatenate([np.empty(0, np.uint32), *ids]).astype(np.uint32),
        num_splats=splats,
        culled=sum(frame.culled for frame in frames),
        invalid=sum(frame.invalid for frame in frames),
        undefined_eigenvectors=sum(frame.undefined_eigenvectors for frame in frames),
    )
