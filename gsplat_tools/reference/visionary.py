"""preprocess: the records, keys and counters that Visionary's first compute pass leaves behind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from gsplat_tools import parallel
from gsplat_tools.attributes.activations import sigmoid
from gsplat_tools.attributes.covariance import covariance_triangles
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import visionary_buffers
from gsplat_tools.codecs.visionary_buffers import Precision, ShLayout
from gsplat_tools.constants import SH_C0
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.sorting import LAST_KEY, sort_pairs, view_rows

RenderMode = Literal["color", "normal", "depth"]

RECORD = np.dtype(
    [("v_0", "<f2", 2), ("v_1", "<f2", 2), ("pos", "<f2", 2), ("posz", "<f4"), ("color_0", "<f2", 2), ("color_1", "<f2", 2)]
)
"""A splat record, 24 bytes: axes over the viewport, ndc x y (y up), ndc z, red green, blue opacity."""
assert RECORD.itemsize == 24

KEYS_PER_BLOCK = 3840
"""Keys that a workgroup of the sorter takes: 256 threads of 15."""

INITIAL_TOTAL = 1_000_000
"""Splats that the buffers are made for at first; their capacity is 5/4 of the total."""

_MIN_CUTOFF_SCALE = 0.1


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
    from gsplat_tools.kernels import visionary as kernel

    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype must be 'float32' or 'float64', got {dtype!r}")
    for name, value, choices in (
        ("sh_layout", sh_layout, get_args(ShLayout)),
        ("precision", precision, get_args(Precision)),
        ("render_mode", render_mode, get_args(RenderMode)),
    ):
        if value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    if sh_degree is not None and not 0 <= sh_degree <= visionary_buffers.MAX_SH_DEGREE:
        raise ValueError(f"sh_degree must lie in 0..{visionary_buffers.MAX_SH_DEGREE}, got {sh_degree}")
    for name, number, least in (
        ("kernel_size", kernel_size, 0.0),
        ("gaussian_scaling", gaussian_scaling, 0.0),
        ("opacity_scale", opacity_scale, 0.0),
        ("cutoff_scale", cutoff_scale, _MIN_CUTOFF_SCALE),
    ):
        if not (np.isfinite(number) and number >= least):
            raise ValueError(f"{name} must be finite and at least {least:g}, got {number}")
    if max_world_trace is not None and np.isnan(max_world_trace):
        raise ValueError("max_world_trace must be a number or None, got nan")
    matrix = np.eye(4) if model_matrix is None else np.array(model_matrix, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise ValueError("model_matrix must hold (4, 4) finite numbers with the last row 0 0 0 1")

    uniforms = _uniforms(cloud, camera, matrix, dtype)
    uniforms[[kernel.KERNEL_SIZE, kernel.GAUSSIAN_SCALING]] = kernel_size, gaussian_scaling
    uniforms[[kernel.OPACITY_SCALE, kernel.CUTOFF_SCALE]] = opacity_scale, cutoff_scale
    uniforms[kernel.MAX_WORLD_TRACE] = np.inf if max_world_trace is None else max_world_trace
    uniforms[kernel.MIP] = mip
    uniforms[kernel.RENDER_MODE] = {
        "color": kernel.MODE_COLOR,
        "normal": kernel.MODE_NORMAL,
        "depth": kernel.MODE_DEPTH,
    }[render_mode]
    degree = min(cloud.sh_degree, visionary_buffers.MAX_SH_DEGREE if sh_degree is None else sh_degree)
    eye = _eye(cloud, camera, matrix).astype(dtype)

    def preprocess_block(block: tuple[int, int]) -> tuple[NDArray[Any], NDArray[np.uint32], NDArray[np.uint8]]:
        part = cloud.take(slice(*block))
        splats = _decoded_splats(part, eye, degree, precision, sh_layout, raw_color=raw_color)
        values = np.empty((len(part), kernel.VALUES_SIZE), dtype)
        differences, states = np.empty(len(part), dtype), np.empty(len(part), np.uint8)
        kernel.preprocess(splats, uniforms, values, differences, states)
        is_drawn = _is_drawn(states)
        return _records(values[is_drawn]), differences[is_drawn].astype(np.float32).view(np.uint32), states

    blocks = parallel.map_ordered(preprocess_block, parallel.blocks(len(cloud)))
    return _join(list(blocks), len(cloud))


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


def _uniforms(cloud: GaussianCloud, camera: Camera, matrix: NDArray[np.float64], dtype: DTypeLike) -> NDArray[Any]:
    """Return what the kernel reads about camera and model matrix."""
    from gsplat_tools.kernels import visionary as kernel

    numbers = np.zeros(kernel.UNIFORMS_SIZE, np.float64)
    numbers[kernel.VIEW : kernel.VIEW + 12] = view_rows(camera, cloud.origin, matrix)
    numbers[kernel.ROTATION : kernel.ROTATION + 9] = camera.viewmat[:3, :3].ravel()
    numbers[kernel.LINEAR : kernel.LINEAR + 9] = matrix[:3, :3].ravel()
    numbers[[kernel.FX, kernel.FY]] = camera.K[0, 0], camera.K[1, 1]
    numbers[kernel.SHIFT_X] = 2 * camera.K[0, 2] / camera.width - 1
    numbers[kernel.SHIFT_Y] = 2 * camera.K[1, 2] / camera.height - 1
    numbers[[kernel.WIDTH, kernel.HEIGHT]] = camera.width, camera.height
    depth_range = camera.far - camera.near
    numbers[[kernel.CLIP_SLOPE, kernel.CLIP_SHIFT]] = camera.far / depth_range, -camera.far * camera.near / depth_range
    uniforms = numbers.astype(dtype)
    # As the shader finds it in the projection matrix, with the error that this has in float32.
    with np.errstate(divide="ignore", over="ignore"):
        uniforms[kernel.Z_FAR] = -uniforms[kernel.CLIP_SHIFT] / (uniforms[kernel.CLIP_SLOPE] - uniforms.dtype.type(1))
    return uniforms


def _eye(cloud: GaussianCloud, camera: Camera, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the camera in the space of the means; exact for rotations with a uniform scale."""
    linear = matrix[:3, :3]
    squared_scale = max(1e-12, float((linear**2).sum()) / 3)
    position = camera.position - linear @ cloud.origin - matrix[:3, 3]
    return np.asarray(linear.T @ position / squared_scale)


def _decoded_splats(
    part: GaussianCloud, eye: NDArray[Any], degree: int, precision: Precision, layout: ShLayout, *, raw_color: bool
) -> NDArray[Any]:
    """Return splats with covariances and colors as the shader reads them from buffers of this precision."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels import visionary as kernel
    from gsplat_tools.kernels.sh_eval import BAND_4_FIRST, evaluate_colors

    # Overflow becomes infinity, which is counted as invalid.
    with np.errstate(over="ignore", invalid="ignore"):
        covariances = covariance_triangles(part.quats, part.log_scales)
    words = visionary_buffers.encode_gaussians(part.means, sigmoid(part.opacity_logits), covariances, precision=precision)
    means, opacities, covariances = visionary_buffers.decode_gaussians(words, precision=precision)
    splats = np.empty((len(part), R.SPLAT_SIZE), eye.dtype)
    splats[:, R.MEAN : R.MEAN + 3] = means
    splats[:, kernel.COVARIANCE : kernel.COVARIANCE + 6] = covariances
    splats[:, R.OPACITY] = opacities
    if raw_color:
        colors = part.sh0 * np.float32(SH_C0) + np.float32(0.5)
        words = visionary_buffers.encode_raw_colors(colors, precision=precision)
        splats[:, R.COLOR : R.COLOR + 3] = visionary_buffers.decode_raw_colors(words, precision=precision)
        return splats
    shN = part.shN[:, : (degree + 1) ** 2 - 1]
    words = visionary_buffers.encode_sh(part.sh0, shN, precision=precision, layout=layout)
    sh0, shN = visionary_buffers.decode_sh(words, degree, precision=precision, layout=layout)
    evaluate_colors(sh0, shN, eye, degree, eye.dtype.type(BAND_4_FIRST), 0, splats)
    return splats


def _records(values: NDArray[Any]) -> NDArray[Any]:
    """Round the values of records, as columns in kernels/visionary.py, to RECORD."""
    from gsplat_tools.kernels import visionary as kernel

    records = np.empty(len(values), RECORD)
    for name, first in (
        ("v_0", kernel.VAL_V1),
        ("v_1", kernel.VAL_V2),
        ("pos", kernel.VAL_POS),
        ("color_0", kernel.VAL_COLOR),
        ("color_1", kernel.VAL_COLOR + 2),
    ):
        records[name] = visionary_buffers.to_halves(values[:, first : first + 2])
    records["posz"] = values[:, kernel.VAL_POSZ]
    return records


def _is_drawn(states: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which splats have a record."""
    from gsplat_tools.kernels import rules as R

    return np.asarray((states & ~np.uint8(R.EIGENVECTOR_UNDEFINED)) == R.DRAWN)


def _join(blocks: list[tuple[NDArray[Any], NDArray[np.uint32], NDArray[np.uint8]]], num_splats: int) -> Preprocessed:
    """Return the buffers of all blocks."""
    from gsplat_tools.kernels import rules as R

    records = np.concatenate([np.empty(0, RECORD), *(block[0] for block in blocks)])
    keys = np.concatenate([np.empty(0, np.uint32), *(block[1] for block in blocks)])
    states = np.concatenate([np.empty(0, np.uint8), *(block[2] for block in blocks)])
    return Preprocessed(
        records=records,
        keys=keys,
        payload=np.arange(len(records), dtype=np.uint32),
        counters=count_frame(num_splats, len(records)),
        splat_ids=np.flatnonzero(_is_drawn(states)).astype(np.uint32),
        culled=int(np.count_nonzero(states == R.CULLED)),
        invalid=int(np.count_nonzero(states == R.INVALID)),
        undefined_eigenvectors=int(np.count_nonzero(states == R.DRAWN + R.EIGENVECTOR_UNDEFINED)),
    )
