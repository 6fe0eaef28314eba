"""render: the picture that a target shows of a scene, by its rendering model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools import parallel
from gsplat_tools.reference import models
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.cutouts import Cutout, find_survivors
from gsplat_tools.reference.models import Model
from gsplat_tools.reference.motion import TEMPORAL_GAUSSIAN_CUTOFF, Scene, SceneState, evaluate_scene
from gsplat_tools.reference.sorting import checked_order, drawing_keys, sort_pairs

Precision = Literal["float32", "float64"]
Framebuffer = Literal["float", "unorm8"]

_MAX_ENTRIES = 1 << 26
"""Entries of tile lists held at once, 256 MB; larger pictures are drawn in bands of tiles."""

_BINNING_BLOCKS = 32
_TILES_PER_TASK = 32


@dataclass(frozen=True, slots=True)
class Counts:
    """What became of the splats of a scene.

    Parameters
    ----------
    splats
        All of them.
    drawn
        Reached the blending; this includes those whose eigenvector is undefined.
    culled
        Left out by the model's rules, or outside the picture.
    hidden
        Outside their time window, or cut out, or not named by the given order.
    invalid
        Held NaN, an infinity that means nothing, a quaternion of norm 0, or overflowed in projection.
    undefined_eigenvectors
        Drawn with an axis that the target leaves undefined, see docs/rendering.md.
    """

    splats: int
    drawn: int
    culled: int
    hidden: int
    invalid: int
    undefined_eigenvectors: int


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A picture and how it came about.

    Parameters
    ----------
    image
        (H, W, 3) colors over the background, not clamped unless the framebuffer has 8 bits.
    alphas
        (H, W) coverage, 1 - transmittance.
    counts
        What became of the splats.
    model
        The model that drew it.
    """

    image: NDArray[Any]
    alphas: NDArray[Any]
    counts: Counts
    model: Model


@dataclass(frozen=True, slots=True, eq=False)
class _Projection:
    """Splats in image space, rows as in kernels/rules.py."""

    records: NDArray[Any]
    bounds: NDArray[np.int32]
    states: NDArray[np.uint8]


def render(
    scene: Scene,
    camera: Camera,
    *,
    model: str = "inria",
    variant: str | None = None,
    t: float | None = None,
    order: ArrayLike | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    dtype: Precision = "float32",
    sh_degree: int | None = None,
    framebuffer: Framebuffer = "float",
    scale_factor: float = 1.0,
    brightness: float = 1.0,
    gamma_to_linear: bool = False,
    antialias: bool | None = None,
    cutouts: Sequence[Cutout] = (),
    temporal_cutoff: float = TEMPORAL_GAUSSIAN_CUTOFF,
) -> Rendering:
    """Draw a scene as a target would show it.

    Parameters
    ----------
    scene
        N splats, or a sequence, of which the frame at `t` is taken.
    camera
        In world coordinates: world = origin of the cloud + means.
    model
        "inria" (the original 3DGS rasterizer), "unity" (gsplat-unity), "spark" (Spark 2) or "visionary".
    variant
        unity: "1.2.1" (default), "1.0", "fork-4d"; spark: "packed" (default), "ext", "none"; visionary: "half" (default,
        projected splats stored in half precision), "float".
    t
        Normalized time; None takes a cloud as it is stored.
    order
        (M,) indices of splats, far first, such as an earlier `sort_by_depth`; splats that it does not name are hidden.
        By default the model's own order.
    background
        RGB behind everything.
    dtype
        "float32" as the targets compute, or "float64", the same code as an oracle.
    sh_degree
        Highest SH band used; by default what scene and model both have.
    framebuffer
        "float", or "unorm8": colors are clamped and rounded to 8 bits after every blend (back-to-front models) or at the
        end (front-to-back models, which blend in registers).
    scale_factor, brightness, gamma_to_linear
        Options of gsplat-unity: size of the quad, which crops splats; factor of colors; decoding of colors before blending.
    antialias
        Whether opacities are compensated for the low-pass filter. By default models without a rule of their own do so for
        clouds trained that way (splat_model "antialiased"), but for `unity`, which never does.
    cutouts
        Volumes that hide splats, see `Cutout`; model `unity` only.
    temporal_cutoff
        Weight below which a splat of the gaussian time model is hidden.

    Returns
    -------
    Rendering
        Image and alphas in the type that was computed in. The same bits for any number of threads.

    Raises
    ------
    ValueError
        An argument is not one of those above.

    Notes
    -----
    Blending order of equal depths is the order of the splats. Memory: 84 bytes a splat in float32, plus lists of tiles.
    """
    rules = _checked_model(scene, model, variant, antialias)
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype must be 'float32' or 'float64', got {dtype!r}")
    if framebuffer not in ("float", "unorm8"):
        raise ValueError(f"framebuffer must be 'float' or 'unorm8', got {framebuffer!r}")
    if sh_degree is not None and sh_degree < 0:
        raise ValueError(f"sh_degree must not be negative, got {sh_degree}")
    if not scale_factor > 0:
        raise ValueError(f"scale_factor must be positive, got {scale_factor}")
    is_unity = rules.name == "unity"
    if not is_unity and (scale_factor != 1 or brightness != 1 or gamma_to_linear or len(cutouts)):
        raise ValueError(f"scale_factor, brightness, gamma_to_linear and cutouts belong to model 'unity', not {model!r}")
    backdrop = np.asarray(background, np.float64)
    if backdrop.shape != (3,) or not np.isfinite(backdrop).all():
        raise ValueError(f"background must be three finite numbers, got {background!r}")

    state = evaluate_scene(scene, t, dtype=dtype, temporal_cutoff=temporal_cutoff)
    if cutouts:
        is_kept = find_survivors(state, cutouts)
        state = replace(state, is_visible=is_kept if state.is_visible is None else is_kept & state.is_visible)
    numbers = models.rule_array(rules, camera, dtype, scale_factor=scale_factor, brightness=brightness)
    choices = models.choice_array(
        rules, scale_factor=scale_factor, gamma_to_linear=gamma_to_linear, quantizes=framebuffer == "unorm8"
    )
    projection = _project(state, camera, rules, numbers, choices, sh_degree)
    named = _named_splats(state, order)
    drawing = _drawing_order(projection.states, state, camera, rules, named)
    planes = _blend(projection, drawing, camera, numbers, choices, backdrop)
    image, alphas = _compose(planes, camera, rules, backdrop, quantizes=framebuffer == "unorm8")
    return Rendering(image, alphas, _count(projection.states, drawing, state, named), rules)


def _checked_model(scene: Scene, name: str, variant: str | None, antialias: bool | None) -> Model:
    """Return the model with the compensation that is asked for."""
    model = models.find_model(name, variant)
    if antialias is None:
        antialias = model.name == "inria" and getattr(scene, "splat_model", None) == "antialiased"
        return _antialiased(model) if antialias else model
    if antialias:
        return _antialiased(model) if model.compensation == "none" else model
    return replace(model, compensation="none")


def _antialiased(model: Model) -> Model:
    """Return a model that compensates opacities; the 3DGS rasterizer keeps a least ratio."""
    return replace(model, compensation="ratio", compensation_floor=0.000025 if model.name == "inria" else 0.0)


def _project(
    state: SceneState,
    camera: Camera,
    model: Model,
    numbers: NDArray[Any],
    choices: NDArray[np.int64],
    sh_degree: int | None,
) -> _Projection:
    """Project all splats, block by block."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels.accumulator import EXTENDED, PACKED, requantize
    from gsplat_tools.kernels.projection import activate, project
    from gsplat_tools.kernels.sh_eval import evaluate_colors

    cloud, means = state.cloud, state.means
    count, dtype = len(cloud), means.dtype
    projection = _Projection(
        records=np.empty((count, R.RECORD_SIZE), dtype),
        bounds=np.empty((count, 4), np.int32),
        states=np.empty(count, np.uint8),
    )
    packs_anew = model.accumulator != "none"
    # Accumulators hold splats relative to the camera.
    lens = models.lens_array(model, camera, camera.position if packs_anew else cloud.origin, dtype)
    weights = np.empty(0, dtype) if state.weights is None else state.weights
    eye = (camera.position - cloud.origin).astype(dtype)
    degree = min(cloud.sh_degree, model.max_sh_degree, cloud.sh_degree if sh_degree is None else sh_degree)
    band_4_first = dtype.type(model.band_4_first)

    def project_block(start: int, stop: int) -> None:
        splats = np.empty((stop - start, R.SPLAT_SIZE), dtype)
        activate(means, cloud.log_scales, cloud.quats, cloud.opacity_logits, weights, start, stop, splats)
        evaluate_colors(cloud.sh0, cloud.shN, eye, degree, band_4_first, start, splats)
        if packs_anew:
            requantize(splats, eye, PACKED if model.accumulator == "packed" else EXTENDED)
        project(splats, lens, numbers, choices, start, projection.records, projection.bounds, projection.states)

    parallel.run_blocks(project_block, count)
    return projection


def _named_splats(state: SceneState, order: ArrayLike | None) -> NDArray[np.uint32] | None:
    """Return the order that was given, checked."""
    return None if order is None else checked_order(order, len(state.cloud))


def _drawing_order(
    states: NDArray[np.uint8], state: SceneState, camera: Camera, model: Model, named: NDArray[np.uint32] | None
) -> NDArray[np.uint32]:
    """Return the indices of the splats that are drawn, in drawing order."""
    from gsplat_tools.kernels import rules as R

    is_drawn = (states & ~np.uint8(R.EIGENVECTOR_UNDEFINED)) == R.DRAWN
    if state.is_visible is not None:
        is_drawn &= state.is_visible
    if named is not None:
        drawn = named[is_drawn[named]]
        return np.ascontiguousarray(drawn[::-1]) if model.front_to_back else drawn
    indices = np.flatnonzero(is_drawn).astype(np.uint32)
    keys = drawing_keys(state, camera, metric=model.metric, far_first=not model.front_to_back)
    return sort_pairs(keys[indices], indices)[1]


def _blend(
    projection: _Projection,
    drawing: NDArray[np.uint32],
    camera: Camera,
    numbers: NDArray[Any],
    choices: NDArray[np.int64],
    backdrop: NDArray[np.float64],
) -> NDArray[Any]:
    """Bin the splats to tiles and draw them; return the planes transmittance, red, green, blue, padded to whole tiles."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels.tile_binning import TILE_HEIGHT, TILE_WIDTH, count_tiles

    tiles_x, tiles_y = -(-camera.width // TILE_WIDTH), -(-camera.height // TILE_HEIGHT)
    num_tiles = tiles_x * tiles_y
    planes = np.zeros((4, tiles_y * TILE_HEIGHT, tiles_x * TILE_WIDTH), numbers.dtype)
    # Pixels of the padding start finished, so that tiles at the rim can end early.
    planes[0, : camera.height, : camera.width] = 1
    if not choices[R.IS_FRONT_TO_BACK]:
        planes[1:] = backdrop[:, None, None]
    block = max(parallel.BLOCK_SIZE, -(-len(drawing) // _BINNING_BLOCKS))
    counts = np.zeros((max(1, len(parallel.blocks(len(drawing), block))), num_tiles), np.int64)
    records, bounds = projection.records, projection.bounds
    parallel.run_blocks(
        lambda start, stop: count_tiles(drawing, records, bounds, tiles_x, start, stop, counts[start // block]),
        len(drawing),
        block,
    )
    offsets = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    positions = np.cumsum(counts, axis=0) - counts + offsets[:-1]
    for first, last in _bands(offsets):
        _draw_band(first, last, projection, drawing, block, offsets, positions, numbers, choices, planes)
    return planes


def _draw_band(
    first: int,
    last: int,
    projection: _Projection,
    drawing: NDArray[np.uint32],
    block: int,
    offsets: NDArray[np.int64],
    positions: NDArray[np.int64],
    numbers: NDArray[Any],
    choices: NDArray[np.int64],
    planes: NDArray[Any],
) -> None:
    """Fill the lists of the tiles first .. last - 1 and draw them."""
    from gsplat_tools.kernels.blending import blend_tiles
    from gsplat_tools.kernels.tile_binning import TILE_WIDTH, scatter_tiles

    records, bounds = projection.records, projection.bounds
    tiles_x = planes.shape[2] // TILE_WIDTH
    lists = np.empty(offsets[last] - offsets[first], np.uint32)
    places = positions - offsets[first]
    parallel.run_blocks(
        lambda start, stop: scatter_tiles(
            drawing, records, bounds, tiles_x, start, stop, first, last, places[start // block], lists
        ),
        len(drawing),
        block,
    )
    parallel.run_blocks(
        lambda start, stop: blend_tiles(
            records, bounds, lists, offsets, first, first + start, first + stop, numbers, choices, planes
        ),
        last - first,
        _TILES_PER_TASK,
    )


def _bands(offsets: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return ranges of tiles whose lists stay within the limit, one tile at least."""
    bands, first = [], 0
    while first < len(offsets) - 1:
        last = int(np.searchsorted(offsets, offsets[first] + _MAX_ENTRIES, side="right")) - 1
        last = min(max(last, first + 1), len(offsets) - 1)
        bands.append((first, last))
        first = last
    return bands


def _compose(
    planes: NDArray[Any], camera: Camera, model: Model, backdrop: NDArray[np.float64], *, quantizes: bool
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return image and alphas without the padding."""
    inside = planes[:, : camera.height, : camera.width]
    transmittance = np.abs(inside[0])
    image = np.ascontiguousarray(np.moveaxis(inside[1:], 0, 2))
    alphas = 1 - transmittance
    if model.front_to_back:
        image += transmittance[:, :, None] * backdrop.astype(planes.dtype)
        if quantizes:
            image, alphas = (np.rint(np.clip(values, 0, 1) * 255) / 255 for values in (image, alphas))
    return image.astype(planes.dtype, copy=False), alphas.astype(planes.dtype, copy=False)


def _count(
    states: NDArray[np.uint8], drawing: NDArray[np.uint32], state: SceneState, named: NDArray[np.uint32] | None
) -> Counts:
    """Count what became of the splats."""
    from gsplat_tools.kernels import rules as R

    states = states.copy()
    if state.is_visible is not None:
        states[~state.is_visible & (states != R.INVALID)] = R.HIDDEN
    if named is not None:
        is_named = np.zeros(len(states), np.bool_)
        is_named[named] = True
        states[~is_named & (states != R.INVALID)] = R.HIDDEN
    tally = np.bincount(states, minlength=256)
    undefined = int(tally[R.DRAWN + R.EIGENVECTOR_UNDEFINED])
    return Counts(
        splats=len(states),
        drawn=len(drawing),
        culled=int(tally[R.CULLED]),
        hidden=int(tally[R.HIDDEN]),
        invalid=int(tally[R.INVALID]),
        undefined_eigenvectors=undefined,
    )
