"""render: the picture that a target shows of a scene, by its rendering model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools.reference import models
from gsplat_tools.reference._stages import compose_image, draw_splats, find_order, project_scene
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.cutouts import Cutout, find_survivors
from gsplat_tools.reference.models import Model
from gsplat_tools.reference.motion import Scene, SceneState, evaluate_scene
from gsplat_tools.reference.sorting import checked_order
from gsplat_tools.reference.visionary_drawing import project_state

Precision = Literal["float32", "float64"]
Framebuffer = Literal["float", "unorm8"]


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
    temporal_cutoff: float | None = None,
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
        Weight below which a splat of the gaussian time model is hidden; by default the cloud's own.

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
    rules = models.find_model(model, variant)
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

    quantizes = framebuffer == "unorm8"
    if quantizes:
        backdrop = np.rint(np.clip(backdrop, 0, 1) * 255) / 255

    state = evaluate_scene(scene, t, dtype=dtype, temporal_cutoff=temporal_cutoff)
    rules = _compensated(rules, state, antialias)
    if cutouts:
        is_kept = find_survivors(state, cutouts)
        state = replace(state, is_visible=is_kept if state.is_visible is None else is_kept & state.is_visible)
    numbers = models.rule_array(rules, camera, dtype, scale_factor=scale_factor, brightness=brightness)
    choices = models.choice_array(rules, scale_factor=scale_factor, gamma_to_linear=gamma_to_linear, quantizes=quantizes)
    named = None if order is None else checked_order(order, len(state.cloud))
    if rules.name == "visionary":
        projection, drawing, states = project_state(state, camera, rules, sh_degree, named, dtype)
    else:
        projection = project_scene(state, camera, rules, numbers, choices, sh_degree)
        states = projection.states
        drawing = find_order(states, state, camera, rules, named)
    planes = draw_splats(projection, drawing, camera, numbers, choices, backdrop)
    image, alphas = compose_image(planes, camera, rules, backdrop, quantizes=quantizes)
    return Rendering(image, alphas, _count(states, drawing, state, named), rules)


def _compensated(model: Model, state: SceneState, antialias: bool | None) -> Model:
    """Return the model with the compensation of opacities that is asked for."""
    if antialias is None:
        antialias = model.compensation != "none" or (model.name == "inria" and state.cloud.splat_model == "antialiased")
    if not antialias:
        return replace(model, compensation="none")
    if model.compensation != "none":
        return model
    # The 3DGS rasterizer keeps a least ratio.
    return replace(model, compensation="ratio", compensation_floor=0.000025 if model.name == "inria" else 0.0)


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
