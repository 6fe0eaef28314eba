"""Visionary's preprocess pass in stages: what buffers give back, projection, and records in half precision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from gsplat_tools import parallel
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import visionary_buffers
from gsplat_tools.codecs.visionary_buffers import Precision, ShLayout
from gsplat_tools.constants import SH_C0
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.motion import SceneState
from gsplat_tools.reference.sorting import view_rows

RenderMode = Literal["color", "normal", "depth"]

RECORD = np.dtype(
    [("v_0", "<f2", 2), ("v_1", "<f2", 2), ("pos", "<f2", 2), ("posz", "<f4"), ("color_0", "<f2", 2), ("color_1", "<f2", 2)]
)
"""A splat record, 24 bytes: axes over the viewport, ndc x y (y up), ndc z, red green, blue opacity."""
assert RECORD.itemsize == 24

_MIN_CUTOFF_SCALE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Arguments of `preprocess`; a precision of "exact" stands for no buffer at all: values in the type computed in."""

    kernel_size: float = 0.1
    sh_degree: int | None = None
    raw_color: bool = False
    sh_layout: ShLayout = "interleaved"
    precision: Precision | Literal["exact"] = "f32"
    max_world_trace: float | None = None
    gaussian_scaling: float = 1.0
    opacity_scale: float = 1.0
    cutoff_scale: float = 1.0
    render_mode: RenderMode = "color"
    mip: bool = True
    model_matrix: ArrayLike | None = None

    def __post_init__(self) -> None:
        for name, choices in (("sh_layout", get_args(ShLayout)), ("render_mode", get_args(RenderMode))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= visionary_buffers.MAX_SH_DEGREE:
            raise ValueError(f"sh_degree must lie in 0..{visionary_buffers.MAX_SH_DEGREE}, got {self.sh_degree}")
        for name, least in (
            ("kernel_size", 0.0),
            ("gaussian_scaling", 0.0),
            ("opacity_scale", 0.0),
            ("cutoff_scale", _MIN_CUTOFF_SCALE),
        ):
            number = getattr(self, name)
            if not (np.isfinite(number) and number >= least):
                raise ValueError(f"{name} must be finite and at least {least:g}, got {number}")
        if self.max_world_trace is not None and np.isnan(self.max_world_trace):
            raise ValueError("max_world_trace must be a number or None, got nan")
        matrix = self.matrix
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
            raise ValueError("model_matrix must hold (4, 4) finite numbers with the last row 0 0 0 1")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The model matrix, the identity where there is none."""
        return np.eye(4) if self.model_matrix is None else np.array(self.model_matrix, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Projected:
    """What preprocessing gives before anything is rounded to halves.

    Parameters
    ----------
    values
        (K, VALUES_SIZE) float32 or float64, columns as in kernels/visionary.py.
    keys
        (K,) uint32, as in `Preprocessed`.
    states
        (N,) uint8 of all splats, as in kernels/rules.py.
    """

    values: NDArray[Any]
    keys: NDArray[np.uint32]
    states: NDArray[np.uint8]

    @property
    def splat_ids(self) -> NDArray[np.uint32]:
        """Splat that each record comes from, (K,)."""
        return np.flatnonzero(_is_drawn(self.states)).astype(np.uint32)

    @property
    def culled(self) -> int:
        """Splats that the rules left out."""
        from gsplat_tools.kernels import rules as R

        return int(np.count_nonzero(self.states == R.CULLED))

    @property
    def invalid(self) -> int:
        """Splats that hold a value that is not finite, or gave one."""
        from gsplat_tools.kernels import rules as R

        return int(np.count_nonzero(self.states == R.INVALID))

    @property
    def undefined_eigenvectors(self) -> int:
        """Records whose axis a device leaves undefined."""
        from gsplat_tools.kernels import rules as R

        return int(np.count_nonzero(self.states == R.DRAWN + R.EIGENVECTOR_UNDEFINED))


def preprocess_scene(state: SceneState, camera: Camera, settings: Settings, dtype: DTypeLike) -> Projected:
    """Preprocess a scene at one time.

    Parameters
    ----------
    state
        N splats with their means and the factors of their opacities.
    camera
        In world coordinates.
    settings
        Everything else.
    dtype
        What is computed in.
    """
    from gsplat_tools.kernels import visionary as kernel

    cloud, matrix = state.cloud, settings.matrix
    center = _center(cloud, camera, matrix)
    uniforms = _uniforms(cloud, camera, settings, center, dtype)
    degree = min(cloud.sh_degree, visionary_buffers.MAX_SH_DEGREE if settings.sh_degree is None else settings.sh_degree)
    eye = (_eye(cloud, camera, matrix) - center).astype(dtype)

    def preprocess_block(block: tuple[int, int]) -> tuple[NDArray[Any], NDArray[np.uint32], NDArray[np.uint8]]:
        part = slice(*block)
        weights = None if state.weights is None else state.weights[part]
        splats = _decoded_splats(cloud.take(part), state.means[part], weights, center, eye, degree, settings)
        values = np.empty((len(splats), kernel.VALUES_SIZE), dtype)
        differences, states = np.empty(len(splats), dtype), np.empty(len(splats), np.uint8)
        kernel.preprocess(splats, uniforms, values, differences, states)
        is_drawn = _is_drawn(states)
        return values[is_drawn], differences[is_drawn].astype(np.float32).view(np.uint32), states

    blocks = list(parallel.map_ordered(preprocess_block, parallel.blocks(len(cloud))))
    return Projected(
        values=np.concatenate([np.empty((0, kernel.VALUES_SIZE), dtype), *(block[0] for block in blocks)]),
        keys=np.concatenate([np.empty(0, np.uint32), *(block[1] for block in blocks)]),
        states=np.concatenate([np.empty(0, np.uint8), *(block[2] for block in blocks)]),
    )


def _center(cloud: GaussianCloud, camera: Camera, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the camera lies among the means: float32 keeps more of a scene far from zero once it is about there."""
    position = camera.position - matrix[:3, :3] @ cloud.origin - matrix[:3, 3]
    try:
        center: NDArray[np.float64] = np.linalg.solve(matrix[:3, :3], position).astype(np.float64)
    except np.linalg.LinAlgError:
        return np.zeros(3)
    return center if bool(np.isfinite(center).all()) else np.zeros(3)


def _uniforms(
    cloud: GaussianCloud, camera: Camera, settings: Settings, center: NDArray[np.float64], dtype: DTypeLike
) -> NDArray[Any]:
    """Return what the kernel reads about camera, model matrix and settings."""
    from gsplat_tools.kernels import visionary as kernel

    matrix = settings.matrix
    numbers = np.zeros(kernel.UNIFORMS_SIZE, np.float64)
    numbers[kernel.VIEW : kernel.VIEW + 12] = view_rows(camera, cloud.origin + center, matrix)
    numbers[kernel.ROTATION : kernel.ROTATION + 9] = camera.viewmat[:3, :3].ravel()
    numbers[kernel.LINEAR : kernel.LINEAR + 9] = matrix[:3, :3].ravel()
    numbers[[kernel.FX, kernel.FY]] = camera.K[0, 0], camera.K[1, 1]
    numbers[kernel.SHIFT_X] = 2 * camera.K[0, 2] / camera.width - 1
    numbers[kernel.SHIFT_Y] = 2 * camera.K[1, 2] / camera.height - 1
    numbers[[kernel.WIDTH, kernel.HEIGHT]] = camera.width, camera.height
    depth_range = camera.far - camera.near
    numbers[[kernel.CLIP_SLOPE, kernel.CLIP_SHIFT]] = camera.far / depth_range, -camera.far * camera.near / depth_range
    numbers[[kernel.KERNEL_SIZE, kernel.GAUSSIAN_SCALING]] = settings.kernel_size, settings.gaussian_scaling
    numbers[[kernel.OPACITY_SCALE, kernel.CUTOFF_SCALE]] = settings.opacity_scale, settings.cutoff_scale
    numbers[kernel.MAX_WORLD_TRACE] = np.inf if settings.max_world_trace is None else settings.max_world_trace
    numbers[kernel.MIP] = settings.mip
    numbers[kernel.RENDER_MODE] = get_args(RenderMode).index(settings.render_mode)
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
    part: GaussianCloud,
    means: NDArray[Any],
    weights: NDArray[Any] | None,
    center: NDArray[np.float64],
    eye: NDArray[Any],
    degree: int,
    settings: Settings,
) -> NDArray[Any]:
    """Return splats about a center with covariances and colors as the shader reads them from buffers of the precision."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels import visionary as kernel
    from gsplat_tools.kernels.sh_eval import BAND_4_FIRST, evaluate_colors

    dtype = eye.dtype
    precision: Precision | None = None if settings.precision == "exact" else settings.precision
    splats = np.empty((len(part), R.SPLAT_SIZE), dtype)
    factors = np.empty(0, dtype) if weights is None else weights
    is_half = precision == "f16"
    kernel.activate(
        means,
        np.zeros(3) if is_half else center,
        part.log_scales,
        part.quats,
        part.opacity_logits,
        factors,
        precision is not None,
        0,
        len(part),
        splats,
    )
    if is_half:
        covariances = slice(kernel.COVARIANCE, kernel.COVARIANCE + 6)
        words = visionary_buffers.encode_gaussians(splats[:, R.MEAN : R.MEAN + 3], splats[:, R.OPACITY], splats[:, covariances])
        stored_means, splats[:, R.OPACITY], splats[:, covariances] = visionary_buffers.decode_gaussians(words)
        splats[:, R.MEAN : R.MEAN + 3] = stored_means - center
    sh0, shN = part.sh0, part.shN[:, : (degree + 1) ** 2 - 1]
    if settings.raw_color:
        colors: NDArray[Any] = part.sh0 * np.float32(SH_C0) + np.float32(0.5)
        if precision is not None:
            words = visionary_buffers.encode_raw_colors(colors, precision=precision)
            colors = visionary_buffers.decode_raw_colors(words, precision=precision)
        splats[:, R.COLOR : R.COLOR + 3] = colors
        return splats
    # A float32 buffer gives back what is in it, but where a layout moves it.
    if precision == "f16" or settings.sh_layout != "interleaved":
        stored: Precision = precision or "f32"
        words = visionary_buffers.encode_sh(sh0, shN, precision=stored, layout=settings.sh_layout)
        sh0, shN = visionary_buffers.decode_sh(words, degree, precision=stored, layout=settings.sh_layout)
    evaluate_colors(sh0, np.ascontiguousarray(shN), eye, degree, dtype.type(BAND_4_FIRST), 0, splats)
    return splats


def pack_records(values: NDArray[Any]) -> NDArray[Any]:
    """Round the values of records, (K, VALUES_SIZE) with the columns of kernels/visionary.py, to (K,) of RECORD."""
    records = np.empty(len(values), RECORD)

    def pack(start: int, stop: int) -> None:
        part = slice(start, stop)
        for name, first in _columns().items():
            records[name][part] = visionary_buffers.to_halves(values[part, first : first + 2])
        records["posz"][part] = values[part, _posz_column()]

    parallel.run_blocks(pack, len(values))
    return records


def unpack_records(records: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """Return the values of (K,) records, the inverse of `pack_records`."""
    from gsplat_tools.kernels import visionary as kernel

    values = np.empty((len(records), kernel.VALUES_SIZE), dtype)

    def unpack(start: int, stop: int) -> None:
        part = slice(start, stop)
        for name, first in _columns().items():
            values[part, first : first + 2] = records[name][part]
        values[part, _posz_column()] = records["posz"][part]

    parallel.run_blocks(unpack, len(records))
    return values


def _columns() -> dict[str, int]:
    """Return the first of the two columns of values that each pair of halves holds."""
    from gsplat_tools.kernels import visionary as kernel

    return {
        "v_0": kernel.VAL_V1,
        "v_1": kernel.VAL_V2,
        "pos": kernel.VAL_POS,
        "color_0": kernel.VAL_COLOR,
        "color_1": kernel.VAL_COLOR + 2,
    }


def _posz_column() -> int:
    """Return the column of the depth."""
    from gsplat_tools.kernels import visionary as kernel

    return kernel.VAL_POSZ


def _is_drawn(states: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which splats have a record."""
    from gsplat_tools.kernels import rules as R

    return np.asarray((states & ~np.uint8(R.EIGENVECTOR_UNDEFINED)) == R.DRAWN)
