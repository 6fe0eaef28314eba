"""draw_records: the picture that Visionary's render pass makes of preprocessed records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools import parallel
from gsplat_tools.reference import models
from gsplat_tools.reference._stages import Projection, compose_image, draw_splats
from gsplat_tools.reference._visionary_stages import RECORD, Settings, preprocess_scene, unpack_records
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.models import Model
from gsplat_tools.reference.motion import SceneState
from gsplat_tools.reference.sorting import sort_pairs
from gsplat_tools.reference.visionary import Preprocessed, sort_records


def draw_records(
    preprocessed: Preprocessed,
    camera: Camera,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    framebuffer: Literal["float", "unorm8"] = "float",
    dtype: Literal["float32", "float64"] = "float32",
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Sort records and draw them: quads with exp(-q) up to q = 2 sqrt(ln 255), alpha at most 0.99, "over".

    Parameters
    ----------
    preprocessed
        Records and keys; nothing else is looked at.
    camera
        For the size of the picture.
    background
        RGB behind everything.
    framebuffer
        "float", or "unorm8" for rounding to 8 bits after every blend, as Visionary's canvas does.
    dtype
        What is computed in, "float32" or "float64".

    Returns
    -------
    tuple
        Image (H, W, 3) and alphas (H, W). The same bits for any number of threads. Records whose axes are parallel or 0
        after rounding to halves show nothing.

    Raises
    ------
    ValueError
        An argument is not one of those above.

    Source
    ------
    gaussian.wgsl of Visionary-Laboratory/visionary @ c5d7070.
    """
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype must be 'float32' or 'float64', got {dtype!r}")
    if framebuffer not in ("float", "unorm8"):
        raise ValueError(f"framebuffer must be 'float' or 'unorm8', got {framebuffer!r}")
    backdrop = np.asarray(background, np.float64)
    if backdrop.shape != (3,) or not np.isfinite(backdrop).all():
        raise ValueError(f"background must be three finite numbers, got {background!r}")
    if preprocessed.records.dtype != RECORD:
        raise ValueError(f"records must have dtype {RECORD}, got {preprocessed.records.dtype}")
    quantizes = framebuffer == "unorm8"
    if quantizes:
        backdrop = np.rint(np.clip(backdrop, 0, 1) * 255) / 255
    model = models.find_model("visionary")
    numbers = models.rule_array(model, camera, dtype, scale_factor=1.0, brightness=1.0)
    choices = models.choice_array(model, scale_factor=1.0, gamma_to_linear=False, quantizes=quantizes)
    projection = _place(unpack_records(preprocessed.records, dtype), camera, model)
    order = sort_records(preprocessed)[1]
    planes = draw_splats(projection, order[_shows(projection)[order]], camera, numbers, choices, backdrop)
    return compose_image(planes, camera, model, backdrop, quantizes=quantizes)


def project_state(
    state: SceneState, camera: Camera, model: Model, sh_degree: int | None, named: NDArray[np.uint32] | None, dtype: str
) -> tuple[Projection, NDArray[np.uint32], NDArray[np.uint8]]:
    """Preprocess a scene to records, sort them, and return them as blending reads them.

    Parameters
    ----------
    state
        N splats at a time.
    camera
        In world coordinates.
    model
        "visionary", whose variant says whether records are rounded to halves.
    sh_degree
        Highest SH band used; by default what scene and model both have.
    named
        Splats in drawing order, far first; None sorts by the keys of the records.
    dtype
        What is computed in.

    Returns
    -------
    tuple
        Projection of the K records · which of them to draw, in drawing order · (N,) states of the splats.
    """
    from gsplat_tools.kernels.visionary import round_values

    settings = Settings(
        kernel_size=model.low_pass,
        sh_degree=None if sh_degree is None else min(sh_degree, model.max_sh_degree),
        precision="exact",
        mip=model.compensation != "none",
    )
    found = preprocess_scene(state, camera, settings, dtype)
    values = found.values
    if model.half_records:
        # The numbers of `pack_records`, without their bytes.
        parallel.run_blocks(lambda start, stop: round_values(values[start:stop]), len(values))
    projection = _place(values, camera, model)
    ids, shows = found.splat_ids, _shows(projection)
    states = found.states.copy()
    states[ids[~shows]] = projection.states[~shows]
    if state.is_visible is not None:
        shows &= state.is_visible[ids]
    if named is None:
        order = sort_pairs(found.keys, np.arange(len(ids), dtype=np.uint32))[1]
    else:
        rows = np.full(len(states), len(ids), np.uint32)
        rows[ids] = np.arange(len(ids))
        order = rows[named]
        order = order[order < len(ids)]
    drawing = order[shows[order]]
    return projection, np.ascontiguousarray(drawing), states


def _place(values: NDArray[Any], camera: Camera, model: Model) -> Projection:
    """Return the values of records as blending reads them."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels.visionary import place

    f = values.dtype.type
    records = np.zeros((len(values), R.RECORD_SIZE), values.dtype)
    bounds, states = np.zeros((len(values), 4), np.int32), np.zeros(len(values), np.uint8)
    cutoff, width, height = f(model.cutoff), f(camera.width), f(camera.height)

    def place_block(start: int, stop: int) -> None:
        part = slice(start, stop)
        place(values[part], cutoff, width, height, records[part], bounds[part], states[part])

    parallel.run_blocks(place_block, len(values))
    return Projection(records, bounds, states)


def _shows(projection: Projection) -> NDArray[np.bool_]:
    """Return which records touch a pixel."""
    from gsplat_tools.kernels import rules as R

    return np.asarray(projection.states == R.DRAWN)
