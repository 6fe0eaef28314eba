"""draw_records: the picture that Visionary's render pass makes of preprocessed records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.reference import models
from gsplat_tools.reference._stages import Projection, compose_image, draw_splats
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.visionary import RECORD, Preprocessed, sort_records

# Pixels that are looked at beyond the cut-off, so that rounding loses none.
_SLACK = 1e-4


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
    projection, shows = _project(preprocessed.records, camera, model.cutoff, dtype)
    order = sort_records(preprocessed)[1]
    planes = draw_splats(projection, order[shows[order]], camera, numbers, choices, backdrop)
    return compose_image(planes, camera, model, backdrop, quantizes=quantizes)


def _project(records: NDArray[Any], camera: Camera, cutoff: float, dtype: str) -> tuple[Projection, NDArray[np.bool_]]:
    """Return records as blending reads them, and which of them touch a pixel."""
    from gsplat_tools.kernels import rules as R

    size = np.array([camera.width, camera.height], np.float64)
    # Rows of pixels go down, ndc goes up.
    flip = np.array([1.0, -1.0])
    center = (records["pos"].astype(np.float64) * flip + 1) / 2 * size
    v1, v2 = (records[name].astype(np.float64) * size * flip for name in ("v_0", "v_1"))
    reach = np.sqrt(cutoff) * np.hypot(v1, v2) * (1 + _SLACK) + _SLACK
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        area = v1[:, 0] * v2[:, 1] - v2[:, 0] * v1[:, 1]
        ux, uy, vx, vy = v2[:, 1] / area, -v2[:, 0] / area, -v1[:, 1] / area, v1[:, 0] / area
        s = np.hypot(ux, vx)
        k, h = (ux * uy + vx * vy) / s, 1 / (np.abs(area) * s)
    opacity = records["color_1"][:, 1].astype(np.float64)
    is_defined = np.isfinite(s + k + h + center.sum(axis=1) + reach.sum(axis=1) + opacity) & (s > 0) & (h > 0)

    rows = np.zeros((len(records), R.RECORD_SIZE), np.float64)
    rows[:, [R.REC_X, R.REC_Y]] = center
    for column, values in (
        (R.REC_S, s),
        (R.REC_K, k),
        (R.REC_H, h),
        (R.REC_UX, ux),
        (R.REC_UY, uy),
        (R.REC_VX, vx),
        (R.REC_VY, vy),
        (R.REC_OPACITY, opacity),
        (R.REC_R, records["color_0"][:, 0]),
        (R.REC_G, records["color_0"][:, 1]),
        (R.REC_B, records["color_1"][:, 0]),
    ):
        rows[:, column] = values
    rows[:, R.REC_Q] = cutoff * (1 + _SLACK) + _SLACK
    rows[:, R.REC_BOX] = 2.0
    low, high = (np.where(is_defined[:, None], bound, 0.0) for bound in (center - reach, center + reach))
    starts = np.clip(np.floor(low), 0, size).astype(np.int32)
    stops = np.clip(np.ceil(high), 0, size).astype(np.int32)
    shows = is_defined & (opacity > 0) & (starts < stops).all(axis=1)
    bounds = np.ascontiguousarray(np.stack([starts[:, 0], stops[:, 0], starts[:, 1], stops[:, 1]], axis=1))
    return Projection(rows.astype(dtype), bounds, np.zeros(len(records), np.uint8)), shows
