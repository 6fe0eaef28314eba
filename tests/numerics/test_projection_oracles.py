"""Projection of every model against 60 digits: eigenvalues and determinants of any size, and the image plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.kernels import rules as R
from gsplat_tools.reference import models
from gsplat_tools.reference.models import Model
from gsplat_tools.reference.rasterizer import render
from tests.numerics.exact import HALF_STEP, MP, mp_matrix
from tests.reference.splats import FOCAL, camera, splats

VARIANTS = {"inria": None, "unity": None, "spark": "none", "visionary": "float"}
"""Every model, without the rounding of splats to bytes or halves that some variants add."""

HALF_STEPS = {"float32": HALF_STEP, "float64": 2.0**-53}
ROUNDINGS = 32
"""Half steps that eigenvalues may be off: entries of J W R S carry a dozen roundings each, and are squared."""


@dataclass(frozen=True)
class Projected:
    """One splat in image space: its state, center in px, axes as unit distances in 1/px, and opacity."""

    state: int
    center: tuple[float, float]
    u: tuple[float, float]
    v: tuple[float, float]
    opacity: float

    @property
    def eigenvalues(self) -> tuple[float, float]:
        """Of the covariance, px^2: the axes are where half a squared distance is 1."""
        return 0.5 / np.hypot(*self.u) ** 2, 0.5 / np.hypot(*self.v) ** 2

    @property
    def determinant(self) -> Any:
        """Of the covariance, px^4, from the area that the axes span."""
        (ux, uy), (vx, vy) = self.u, self.v
        return 1 / (2 * (MP.mpf(ux) * MP.mpf(vy) - MP.mpf(uy) * MP.mpf(vx))) ** 2


def project_one(cloud: GaussianCloud, dtype: str, rules: Model, *, near: float = 1e-30, far: float = 1e30) -> Projected:
    """Project one splat with a model's own kernels."""
    from gsplat_tools.reference._stages import project_scene
    from gsplat_tools.reference.motion import evaluate_scene

    view = camera(near=near, far=far)
    state = evaluate_scene(cloud, None, dtype=dtype)
    if rules.name == "visionary":
        return project_visionary(state, dtype, rules, view)
    numbers = models.rule_array(rules, view, dtype, scale_factor=1.0, brightness=1.0)
    choices = models.choice_array(rules, scale_factor=1.0, gamma_to_linear=False, quantizes=False)
    projection = project_scene(state, view, rules, numbers, choices, None)
    record = projection.records[0].astype(np.float64)
    return Projected(
        state=int(projection.states[0]) & ~R.EIGENVECTOR_UNDEFINED,
        center=(record[R.REC_X], record[R.REC_Y]),
        u=(record[R.REC_UX], record[R.REC_UY]),
        v=(record[R.REC_VX], record[R.REC_VY]),
        opacity=record[R.REC_OPACITY],
    )


def project_visionary(state: Any, dtype: str, rules: Model, view: Any) -> Projected:
    """Return what the preprocess pass gives, before it is placed in a picture."""
    from gsplat_tools.kernels import visionary
    from gsplat_tools.reference._visionary_stages import Settings, preprocess_scene

    settings = Settings(kernel_size=rules.low_pass, precision="exact", mip=rules.compensation != "none")
    found = preprocess_scene(state, view, settings, dtype)
    drawn = int(found.states[0]) & ~R.EIGENVECTOR_UNDEFINED
    if drawn != R.DRAWN:
        return Projected(drawn, (0, 0), (0, 0), (0, 0), 0)
    values = found.values[0].astype(np.float64)
    size = np.array([view.width, view.height])
    long, short = (values[first : first + 2] * size for first in (visionary.VAL_V1, visionary.VAL_V2))
    ndc = values[visionary.VAL_POS : visionary.VAL_POS + 2] * [1, -1]
    return Projected(
        state=drawn,
        center=tuple((ndc + 1) / 2 * size),
        u=tuple(long / (long @ long)),
        v=tuple(short / (short @ short)),
        opacity=values[visionary.VAL_OPACITY],
    )


def exact_covariance(cloud: GaussianCloud, low_pass: float) -> Any:
    """The 2 x 2 covariance in pixels, J W R S S R^T W^T J^T + low pass."""
    x, y, z = (MP.mpf(float(c)) for c in cloud.means[0])
    f = MP.mpf(FOCAL)
    J = MP.matrix([[f / z, 0, -f * x / z**2], [0, f / z, -f * y / z**2]])
    rotation = mp_matrix(cloud.quats[0])
    scales = MP.diag([MP.exp(2 * MP.mpf(float(v))) for v in cloud.log_scales[0]])
    return J * rotation * scales * rotation.T * J.T + MP.mpf(low_pass) * MP.eye(2)


def determinant(sigma: Any) -> Any:
    return sigma[0, 0] * sigma[1, 1] - sigma[0, 1] ** 2


def exact_eigenvalues(sigma: Any) -> tuple[Any, Any]:
    middle, half = (sigma[0, 0] + sigma[1, 1]) / 2, (sigma[0, 0] - sigma[1, 1]) / 2
    largest = middle + MP.sqrt(half**2 + sigma[0, 1] ** 2)
    return largest, determinant(sigma) / largest


def drawn_eigenvalues(sigma: Any, rules: Model) -> tuple[Any, Any]:
    """Eigenvalues that a model draws: quads, which reach to 2 sqrt(2 lambda), are capped."""
    cap = min(view_sides()) if rules.axis_cap == "viewport" else rules.axis_cap
    exact = exact_eigenvalues(sigma)
    return exact if cap is None else (min(exact[0], MP.mpf(cap) ** 2 / 8), min(exact[1], MP.mpf(cap) ** 2 / 8))


def view_sides() -> tuple[int, int]:
    view = camera()
    return view.width, view.height


def allowed_eigenvalue_errors(exact: tuple[Any, Any], rules: Model, dtype: str) -> tuple[Any, Any]:
    """Bounds of the errors.

    Visionary's shader, which is followed step by step, finds the small eigenvalue as a difference of numbers as large as
    the other one: it owes it no more digits than those.
    """
    share = ROUNDINGS * HALF_STEPS[dtype]
    return share * exact[0], share * (exact[0] if rules.name == "visionary" else exact[1])


def exact_opacity(cloud: GaussianCloud) -> Any:
    return 1 / (1 + MP.exp(-MP.mpf(float(cloud.opacity_logits[0]))))


def needle(aspect: float, size: float) -> GaussianCloud:
    """A splat of length `size`, `aspect` times thinner, off the axis."""
    cloud = splats([[0.3, -0.2, 4.0]], quats=[np.cos(0.4), 0.1, -0.2, np.sin(0.4)], opacities=0.9)
    return cloud.replace(log_scales=np.log(size) + np.log([[1.0, 1 / aspect, 1 / aspect]]))


SIZES = [1e-8, 1e-3, 1.0, 1e6, 1e15]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("aspect", [1.0, 10.0, 1e3, 1e5])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("model", list(VARIANTS))
def test_eigenvalues__of_needles_are_exact_at_any_size(model: str, dtype: str, aspect: float, size: float) -> None:
    # The opacity that makes up for the low-pass would hide thin splats; the next test is about it.
    rules = replace(models.find_model(model, VARIANTS[model]), compensation="none")
    cloud = needle(aspect, size)

    found = project_one(cloud, dtype, rules, near=0.1, far=100.0)

    sigma = exact_covariance(cloud, rules.low_pass)
    if rules.smallest > exact_eigenvalues(sigma)[0]:
        assert found.state == R.CULLED
        return
    if model == "visionary" and dtype == "float32" and size > 1e14:
        # Squares of 6e32 px^2 overflow in its shader, whose records are infinite then: nothing is drawn, and it is counted.
        assert found.state == R.INVALID
        return
    assert found.state == R.DRAWN
    exact = drawn_eigenvalues(sigma, rules)
    errors = allowed_eigenvalue_errors(exact, rules, dtype)
    for value, expected, error in zip(found.eigenvalues, exact, errors, strict=True):
        assert abs(MP.mpf(float(value)) - expected) <= error


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("aspect", [1.0, 10.0, 1e3, 1e5])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("model", ["inria", "unity", "spark"])
def test_determinants__before_and_after_the_low_pass_are_exact(model: str, dtype: str, aspect: float, size: float) -> None:
    # Nothing is culled, capped or floored, and every model compensates: the opacity shows the ratio of determinants.
    rules = replace(
        models.find_model(model, VARIANTS[model]),
        compensation="ratio",
        compensation_floor=0.0,
        alpha_floor=0.0,
        smallest=0.0,
        axis_cap=None,
    )
    cloud = needle(aspect, size)

    found = project_one(cloud, dtype, rules)

    before, after = (determinant(exact_covariance(cloud, low_pass)) for low_pass in (0, rules.low_pass))
    assert found.state == R.DRAWN
    assert abs(found.determinant - after) <= 2 * ROUNDINGS * HALF_STEPS[dtype] * after
    ratio = (MP.mpf(float(found.opacity)) / exact_opacity(cloud)) ** 2
    assert abs(ratio - before / after) <= 4 * ROUNDINGS * HALF_STEPS[dtype] * before / after


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("aspect", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("size", [1e-3, 0.01, 1.0, 1e3])
def test_determinants__of_visionary_lose_no_more_than_their_shader_does(dtype: str, aspect: float, size: float) -> None:
    rules = models.find_model("visionary", "float")
    cloud = needle(aspect, size)

    found = project_one(cloud, dtype, rules, near=0.1, far=100.0)

    sigma = exact_covariance(cloud, 0)
    tiny = MP.mpf("1e-6")
    # a c - b^2 as the shader has it: it is off by roundings of a c, whatever is left of it.
    shares = ROUNDINGS * HALF_STEPS[dtype]
    off_before = shares * sigma[0, 0] * sigma[1, 1]
    before = determinant(sigma)
    after = determinant(sigma + MP.mpf(rules.low_pass) * MP.eye(2))
    off_after = shares * (sigma[0, 0] + rules.low_pass) * (sigma[1, 1] + rules.low_pass)
    assert found.state == R.DRAWN
    ratio = (MP.mpf(float(found.opacity)) / exact_opacity(cloud)) ** 2
    if before - off_before <= tiny and ratio == 0:
        return
    least, largest = ((before + s * off_before) / (after - s * off_after + tiny) + tiny for s in (-1, 1))
    assert before + off_before > tiny
    assert least * (1 - shares) <= ratio <= largest * (1 + shares)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("depth", [0.21, 0.2000001, 1e-3, 1e-10, 1e-30])
@pytest.mark.parametrize("model", list(VARIANTS))
def test_projection__near_the_image_plane_is_exact_or_culled(model: str, dtype: str, depth: float) -> None:
    cloud = splats([[0.1 * depth, -0.05 * depth, depth]], scales=0.01 * depth, opacities=0.9)
    rules = models.find_model(model, VARIANTS[model])
    # Visionary culls by ndc z, which is 1 to rounding for all that lies far beyond the near plane.
    planes = {"near": depth / 4, "far": depth * 4} if model == "visionary" else {"near": 1e-32, "far": 1e30}

    found = project_one(cloud, dtype, rules, **planes)

    if rules.z_min is not None and rules.z_min >= float(cloud.means[0, 2]):
        assert found.state == R.CULLED
        return
    assert found.state == R.DRAWN
    slopes = (cloud.means[0, :2].astype(np.float64) / cloud.means[0, 2].astype(np.float64)).tolist()
    assert found.center == pytest.approx((32 + FOCAL * slopes[0], 24 + FOCAL * slopes[1]), rel=8 * HALF_STEPS[dtype])
    if model == "visionary" and dtype == "float32" and float(np.exp(2 * cloud.log_scales.astype(np.float64))[0, 0]) < 1e-45:
        # Its buffers hold covariances, and this one is below the smallest float32: the low-pass is what is left.
        assert found.eigenvalues == pytest.approx((rules.low_pass, rules.low_pass), rel=1e-6)
        return
    exact = drawn_eigenvalues(exact_covariance(cloud, rules.low_pass), rules)
    errors = allowed_eigenvalue_errors(exact, rules, dtype)
    for value, expected, error in zip(found.eigenvalues, exact, errors, strict=True):
        assert abs(MP.mpf(float(value)) - expected) <= error


@pytest.mark.parametrize("depth", [1e-3, 1e-10, 1e-30])
@pytest.mark.parametrize("model", list(VARIANTS))
def test_projection__culls_all_that_lies_on_or_behind_the_near_plane(model: str, depth: float) -> None:
    rules = models.find_model(model, VARIANTS[model])
    near = float(np.float32(depth))
    if rules.z_min is not None:
        near = rules.z_min
    for z in (near, np.nextafter(np.float32(near), np.float32(0)), 0.0, -0.0, -1e-45, -near, -1.0):
        cloud = splats([[0.0, 0.0, float(z)]], opacities=0.9)

        found = project_one(cloud, "float32", rules, near=near or depth, far=max(1.0, 4 * near))

        assert found.state == R.CULLED


@pytest.mark.parametrize("model", ["inria", "unity", "spark"])
def test_projection__counts_every_splat_whatever_its_numbers(model: str) -> None:
    """No splat is lost between the states: it is drawn, culled or invalid."""
    grid = [10.0**k for k in (-44, -38, -20, -5, 0, 5, 18, 20, 38)]
    means = np.array([[0.1 * z, 0.0, z] for z in grid for _ in grid])
    logs = np.array([[np.log(s)] * 3 for _ in grid for s in grid])
    cloud = splats(means, opacities=0.9).replace(log_scales=logs)

    counts = render(cloud, camera(near=1e-30, far=1e30), model=model, variant="none" if model == "spark" else None).counts

    assert counts.drawn + counts.culled + counts.invalid == counts.splats
    wide = render(
        cloud, camera(near=1e-30, far=1e30), model=model, variant="none" if model == "spark" else None, dtype="float64"
    )
    # Only what float32 cannot hold is invalid: variances in pixels beyond 3e38.
    assert wide.counts.invalid == 0
