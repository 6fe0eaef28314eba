"""Rendering models: what each target does, as tables of constants and rules over the same kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gsplat_tools.constants import MAX_SH_DEGREE
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.sorting import Metric, view_rows

ModelName = Literal["inria", "unity", "spark", "visionary"]
Compensation = Literal["none", "ratio", "visionary"]
Accumulator = Literal["none", "packed", "ext"]

_BAND_4_FIRST = 2.5033429417967046
_ENDS_E4 = math.exp(-4.0)


@dataclass(frozen=True, slots=True)
class Model:
    """What a target does between splats in the world and pixels.

    Lengths are in true pixels; q = d^2 / 2, with d the distance from the center in standard deviations.

    Parameters
    ----------
    name, variant
        As `render` takes them.
    low_pass
        Added to both diagonals of the projected covariance, px^2.
    compensation
        How the opacity makes up for the low-pass: "none", "ratio" (root of the ratio of determinants), "visionary"
        (its preprocess pass does).
    compensation_floor
        Least ratio under the root.
    z_min, z_max
        Depths drawn lie strictly between these; None stands for the planes of the camera.
    slope_limit
        x/z and y/z are clamped to this many tan(fov / 2) in the Jacobian.
    center_limit
        Culled where the center lies beyond this many half images.
    culls_extent
        Culled where the quad of the longest axis lies outside the image.
    axis_cap
        Longest half axis of the quad, px, which squeezes the whole Gaussian; None: no cap. "viewport" caps at
        min(1024, width, height).
    smallest
        Culled where the largest eigenvalue is below, px^2.
    alpha_cap, alpha_floor
        Alpha is at most the cap; fragments below the floor are skipped.
    cutoff
        Fragments beyond this q are skipped.
    gain, offset
        falloff = gain exp(-q) - offset.
    edge
        (start, slope) of the term exp((m - start s) slope s) taken off the falloff, m the larger of the two distances
        along the axes where 1 is the quad's side and s the scale factor; None: no such term.
    tile_footprint
        Whether drawing is cut to the 16 px tiles that a square of 3 standard deviations touches.
    undefined_axes, aligns_axes
        Whether a covariance that is aligned with the pixels has an undefined eigenvector, or counts as aligned below
        0.001 px^2.
    square_pixels
        Whether the horizontal focal length serves both rows of the Jacobian.
    half_records
        Whether projected splats are stored in half precision; "visionary" only.
    color_floor
        Colors are clamped from below; None: not at all.
    band_4_first
        First constant of SH band 4.
    max_sh_degree
        Highest band that is evaluated.
    front_to_back
        Order of blending.
    stop
        A pixel is finished before its transmittance falls below; 0: never.
    metric
        Depth that is sorted by.
    accumulator
        Form that every splat is packed into before it is drawn.
    """

    name: ModelName
    variant: str | None
    low_pass: float
    compensation: Compensation = "none"
    compensation_floor: float = 0.0
    z_min: float | None = 0.0
    z_max: float | None = None
    slope_limit: float = math.inf
    center_limit: float = math.inf
    culls_extent: bool = False
    axis_cap: float | Literal["viewport"] | None = None
    smallest: float = 0.0
    alpha_cap: float = math.inf
    alpha_floor: float = 1.0 / 255.0
    cutoff: float = math.inf
    gain: float = 1.0
    offset: float = 0.0
    edge: tuple[float, float] | None = None
    tile_footprint: bool = False
    undefined_axes: bool = False
    aligns_axes: bool = False
    square_pixels: bool = False
    half_records: bool = False
    color_floor: float | None = None
    band_4_first: float = _BAND_4_FIRST
    max_sh_degree: int = MAX_SH_DEGREE
    front_to_back: bool = False
    stop: float = 0.0
    metric: Metric = "depth"
    accumulator: Accumulator = "none"


_INRIA = Model(
    name="inria",
    variant=None,
    low_pass=0.3,
    z_min=0.2,
    z_max=math.inf,
    slope_limit=1.3,
    alpha_cap=0.99,
    tile_footprint=True,
    color_floor=0.0,
    front_to_back=True,
    stop=1e-4,
)

# The shader works at twice the focal length: its 0.3, 0.1 and 2 px are a quarter or half of that in true pixels.
_UNITY = Model(
    name="unity",
    variant="1.2.1",
    low_pass=0.075,
    culls_extent=True,
    axis_cap="viewport",
    smallest=0.125,
    cutoff=4.0,
    edge=(1.16, 25.0),
    undefined_axes=True,
    square_pixels=True,
    # A quarter of the right constant: a bug of gsplat-unity's SH.hlsl.
    band_4_first=0.6258357354491761,
)

_SPARK = Model(
    name="spark",
    variant="packed",
    low_pass=0.3,
    compensation="ratio",
    z_min=None,
    center_limit=1.4,
    axis_cap=512.0,
    alpha_floor=0.5 / 255.0,
    cutoff=4.0,
    aligns_axes=True,
    # The vertex shader clamps what the accumulator holds.
    color_floor=0.0,
    max_sh_degree=3,
    metric="radial",
    accumulator="packed",
)

# Planes, culls and compensation are those of the preprocess pass, kernels/visionary.py.
_VISIONARY = Model(
    name="visionary",
    variant="half",
    low_pass=0.1,
    compensation="visionary",
    alpha_cap=0.99,
    alpha_floor=0.0,
    # Twice sqrt(ln 255): the shader compares a square with twice the root.
    cutoff=2.0 * math.sqrt(math.log(255.0)),
    half_records=True,
    max_sh_degree=3,
    metric="clip",
)

MODELS: dict[str, dict[str | None, Model]] = {
    "inria": {None: _INRIA},
    "unity": {
        "1.2.1": _UNITY,
        "1.0": replace(_UNITY, variant="1.0", edge=None),
        "fork-4d": replace(
            _UNITY, variant="fork-4d", edge=None, gain=1.0 / (1.0 - _ENDS_E4), offset=_ENDS_E4 / (1.0 - _ENDS_E4)
        ),
    },
    "spark": {
        "packed": _SPARK,
        "ext": replace(_SPARK, variant="ext", accumulator="ext"),
        "none": replace(_SPARK, variant="none", accumulator="none"),
    },
    "visionary": {"half": _VISIONARY, "float": replace(_VISIONARY, variant="float", half_records=False)},
}
"""Every model by name and variant; the first variant is the default.

Sources: the shaders of wuyize25/gsplat-unity, sparkjsdev/spark 2 and Visionary-Laboratory/visionary, and the rasterizer
of graphdeco-inria/gaussian-splatting; docs/rendering.md has the table with its derivations.
"""


def find_model(name: str, variant: str | None = None) -> Model:
    """Return a model; without a variant, its default one.

    Raises
    ------
    ValueError
        There is no such model or variant.
    """
    if name not in MODELS:
        raise ValueError(f"model must be one of {', '.join(MODELS)}, got {name!r}")
    variants = MODELS[name]
    if variant is None:
        return next(iter(variants.values()))
    if variant not in variants:
        names = ", ".join(str(known) for known in variants if known is not None) or "none"
        raise ValueError(f"variants of model {name!r}: {names}; got {variant!r}")
    return variants[variant]


def lens_array(model: Model, camera: Camera, origin: NDArray[np.float64], dtype: DTypeLike) -> NDArray[Any]:
    """Return what kernels read about a camera, for means relative to `origin`."""
    from gsplat_tools.kernels import rules as R

    lens = np.empty(R.LENS_SIZE, np.float64)
    lens[R.VIEW : R.VIEW + 12] = view_rows(camera, origin)
    lens[[R.FX, R.FY, R.CX, R.CY]] = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    lens[[R.WIDTH, R.HEIGHT]] = camera.width, camera.height
    lens[[R.SLOPE_X, R.SLOPE_Y]] = camera.width / (2 * camera.K[0, 0]), camera.height / (2 * camera.K[1, 1])
    lens[R.Z_MIN] = camera.near if model.z_min is None else model.z_min
    lens[R.Z_MAX] = camera.far if model.z_max is None else model.z_max
    return lens.astype(dtype)


def rule_array(model: Model, camera: Camera, dtype: DTypeLike, *, scale_factor: float, brightness: float) -> NDArray[Any]:
    """Return the numbers of a model that kernels read."""
    from gsplat_tools.kernels import rules as R

    caps = {"viewport": min(1024.0, camera.width, camera.height), None: math.inf}
    cap = model.axis_cap if isinstance(model.axis_cap, float) else caps[model.axis_cap]
    edge_gain, edge_start, edge_slope = (0.0, 0.0, 0.0) if model.edge is None else (1.0, *model.edge)
    rules = np.empty(R.RULES_SIZE, np.float64)
    rules[R.LOW_PASS] = model.low_pass
    rules[R.SLOPE_LIMIT] = model.slope_limit
    rules[R.CENTER_LIMIT] = model.center_limit
    # Quads reach to q = 4, which is twice sqrt(2 lambda).
    rules[R.AXIS_CAP] = cap / 2
    rules[R.SMALLEST] = model.smallest
    rules[[R.ALPHA_CAP, R.ALPHA_FLOOR]] = model.alpha_cap, model.alpha_floor
    rules[R.CUTOFF] = model.cutoff
    rules[[R.GAIN, R.OFFSET]] = model.gain, model.offset
    rules[[R.EDGE_GAIN, R.EDGE_START, R.EDGE_SLOPE]] = edge_gain, edge_start * scale_factor, edge_slope * scale_factor
    rules[R.SCALE_FACTOR] = scale_factor
    rules[R.COMPENSATION_FLOOR] = model.compensation_floor
    rules[R.COLOR_FLOOR] = -math.inf if model.color_floor is None else model.color_floor
    rules[R.BRIGHTNESS] = brightness
    rules[R.STOP] = model.stop
    rules[R.ROUNDING] = 1.5 * 2.0 ** np.finfo(np.dtype(dtype)).nmant
    return rules.astype(dtype)


def choice_array(model: Model, *, scale_factor: float, gamma_to_linear: bool, quantizes: bool) -> NDArray[np.int64]:
    """Return the alternatives of a model that kernels read."""
    from gsplat_tools.kernels import rules as R

    choices = np.zeros(R.CHOICES_SIZE, np.int64)
    choices[R.COMPENSATION] = R.COMPENSATION_RATIO if model.compensation == "ratio" else R.COMPENSATION_NONE
    choices[R.FOOTPRINT] = R.FOOTPRINT_TILES if model.tile_footprint else R.FOOTPRINT_ELLIPSE
    choices[R.AXES] = R.AXES_UNDEFINED if model.undefined_axes else R.AXES_ALIGNED if model.aligns_axes else R.AXES_EXACT
    # At scale factor 1 the quad cuts only what lies below the floor of alpha.
    choices[R.IN_AXES] = model.edge is not None or (model.name == "unity" and scale_factor < 1)
    choices[R.GAMMA] = gamma_to_linear
    choices[R.IS_FRONT_TO_BACK] = model.front_to_back
    choices[R.IS_QUANTIZED] = quantizes and not model.front_to_back
    choices[R.SQUARE_PIXELS] = model.square_pixels
    choices[R.CULLS_EXTENT] = model.culls_extent
    return choices
