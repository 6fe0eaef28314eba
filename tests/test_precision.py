"""One test for every loss of precision that was found; each comment says what it was. See docs/numerics.md."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
import pytest

from gsplat_tools.attributes import activations, quaternions
from gsplat_tools.attributes.covariance import covariance_matrices
from gsplat_tools.attributes.motion import positions_at, weights_at
from gsplat_tools.attributes.spherical_harmonics import evaluate_colors
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import attribute_errors
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.inspection import describe_values, statistics
from gsplat_tools.ops.filtering import locate_invalid
from gsplat_tools.ops.motion import at_time
from gsplat_tools.ops.motion_fitting import fit_motion
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.sorting import sort_by_depth
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.reference.splats import camera, splats


def round_trip(cloud: GaussianCloud, format_id: str, **options: Any) -> tuple[GaussianCloud, dict[str, Any]]:
    """What comes back from a file, and the bounds that the format states."""
    record = FORMATS[format_id]
    assert record.write is not None
    assert record.read is not None
    assert record.bounds is not None
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        record.write(cloud, stream, record.write_options(**options))
        stream.seek(0)
        scene = record.read(stream, record.read_options())
    decoded = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
    stream.seek(0)
    return decoded, dict(record.bounds(cloud, stream, 0))


def sequence(*frames: GaussianCloud) -> GaussianSequence:
    return GaussianSequence(
        lambda i: frames[i], num_splats=len(frames[0]), sh_degree=frames[0].sh_degree, num_frames=len(frames)
    )


# -- measuring


def test_opacity_errors__are_not_rounded_to_float32() -> None:
    # Both sigmoids were rounded to float32 first: errors near 1 were off by up to 6e-8, above the bounds of bytes.
    a = random_cloud(1).replace(opacity_logits=np.array([16.0]))
    b = a.replace(opacity_logits=np.array([15.0]))

    error = attribute_errors(a, b)["opacities"][0]

    assert error == pytest.approx(1 / (1 + np.exp(-16.0)) - 1 / (1 + np.exp(-15.0)), rel=1e-9)


def test_covariance_errors__of_splats_that_grew_beyond_float64_are_infinite() -> None:
    # exp overflowed and infinity less infinity gave NaN, which no bound holds.
    thin = random_cloud(1).replace(log_scales=np.full((1, 3), -1e4))
    thick = thin.replace(log_scales=np.full((1, 3), -12.0))

    assert attribute_errors(thin, thick)["covariances"].tolist() == [np.inf]
    assert attribute_errors(thick, thin)["covariances"] == pytest.approx([1.0])


# -- bounds


@pytest.mark.parametrize("size", [1e-8, 1e3])
def test_sog_positions__stay_within_bounds_that_count_their_rounding(size: float) -> None:
    # Half a step of the logarithm was the whole bound; the float32 that comes out is rounded too, 19 % more at 1000.
    means = size * np.array([1.0, -0.5, 0.25]) + min(size, 5.0) * np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    cloud = random_cloud(2000, sh_degree=0).replace(means=means)

    decoded, limits = round_trip(cloud, "sog")

    assert (np.abs(cloud.means.astype(np.float64) - decoded.means) <= limits["means"]).all()


def test_sog4d_scales__below_the_floor_of_the_codebook_are_known_to_grow() -> None:
    # Scales below e^-27 become e^-27; bounds took the nearest entry for near and promised 1e-5.
    cloud = random_cloud(50, sh_degree=0).replace(log_scales=np.full((50, 3), -60.0))

    decoded, limits = round_trip(cloud, "sog4d")
    errors = attribute_errors(cloud, decoded)

    assert errors["scales"].min() > 32.9
    assert (errors["scales"] <= limits["scales"]).all()
    assert (errors["covariances"] <= limits["covariances"]).all()


def test_uncompressed_scales__beyond_float32_have_a_bound() -> None:
    # exp of the log overflowed in the bound itself, and nothing was promised.
    cloud = random_cloud(4, sh_degree=0).replace(log_scales=np.full((4, 3), 1000.0))

    decoded, limits = round_trip(cloud, "uncompressed")

    assert attribute_errors(cloud, decoded)["scales"].max() == pytest.approx(1000 - 88.7228, abs=1e-3)
    assert limits["scales"].max() == pytest.approx(1000 - 88.7228, abs=1e-3)
    assert limits["covariances"].max() == pytest.approx(1.0, abs=1e-3)


def test_ply_times__out_of_range_are_bounded_by_what_reading_clamps() -> None:
    # A lossless format promised zero, but times out of their range are repaired when they are read.
    still = random_cloud(3, sh_degree=0, motion=True)
    cloud = still.replace(times=np.array([-0.5, 0.2, 3.0]), durations=np.array([0.5, 0.5, -1.0]))

    decoded, limits = round_trip(cloud, "ply")

    assert np.allclose(limits["times"], [0.5, 0.0, 2.0])
    for name in ("times", "durations"):
        assert (np.abs(getattr(cloud, name) - getattr(decoded, name)) <= limits[name]).all()


@pytest.mark.parametrize("length", [2.0**-100, 2.0**100])
def test_visionary_rotations__do_not_depend_on_the_length_of_quaternions(length: float) -> None:
    # Squares left float32, and the first frame was taken instead of the closest.
    from gsplat_tools.codecs.visionary_int8 import sort_axes

    cloud = random_cloud(200, sh_degree=0)
    units = quaternions.normalize(cloud.quats.astype(np.float64))

    (codes, logs), (expected, sorted_logs) = (
        sort_axes((size * units).astype(np.float32), cloud.log_scales) for size in (length, 1.0)
    )

    assert np.array_equal(codes, expected)
    assert np.array_equal(logs, sorted_logs)


@pytest.mark.parametrize("format_id", ["spz", "compressed-ply", "sog", "sog4d", "spark"])
@pytest.mark.parametrize("largest", [1e-41, 3e38])
@pytest.mark.parametrize("rotation", ["best", "small"])
def test_rotations__stay_within_bounds_at_the_ends_of_float32(format_id: str, largest: float, rotation: str) -> None:
    # Turning a quaternion into another frame added components, which left float32, or rounded them to its smallest steps.
    cloud = random_cloud(300, sh_degree=0)
    rows = np.random.default_rng(1).normal(size=(300, 4))
    quats = (largest * rows / np.abs(rows).max(axis=1, keepdims=True)).astype(np.float32)
    cloud = cloud.replace(quats=quats, log_scales=np.tile(np.float32([-1, -2, -3]), (300, 1)))

    decoded, limits = round_trip(cloud, format_id, rotation=rotation)

    assert (attribute_errors(cloud, decoded)["covariances"] <= limits["covariances"]).all()


# -- far from zero


@pytest.mark.parametrize("model", ["inria", "unity", "spark", "visionary"])
def test_render__of_a_scene_far_from_zero_is_that_about_zero(model: str) -> None:
    # The view was applied in float32: at 2^20 units centers moved by up to a tenth of a unit.
    near = splats([[0.25, -0.5, 4.0], [-0.75, 0.25, 5.0], [0.5, 0.5, 6.0]], scales=0.1)
    shift = np.array([2.0**20, -(2.0**21), 2.0**20])
    size: dict[str, Any] = {"fov_y": 50, "width": 64, "height": 48}
    eye, target = np.array([0.3, 0.7, -0.2]), np.array([0.0, 0.0, 5.0])
    view = Camera.look_at(eye, target, **size)
    far = near.replace(means=near.means + shift)
    moved = Camera.look_at(shift + eye, shift + target, **size)

    here, there = render(near, view, model=model), render(far, moved, model=model)

    assert here.alphas.max() > 0.3
    assert np.abs(here.image - there.image).max() <= 1e-6


def test_sort__of_a_scene_far_from_zero_keeps_what_float32_would_tie() -> None:
    # Depths were sums in float32: seen from 3e6 units on the diagonal, steps of a half were lost.
    steps = np.arange(64) * 0.5
    means = np.array([2.0**21, 2.0**21, 2.0**21]) + steps[:, None] * [1.0, 0.0, 0.0]
    cloud = splats(means)
    eye = np.array([2.0**21] * 3) - 10
    view = Camera.look_at(eye, eye + np.ones(3), fov_y=60, width=64, height=48)

    assert sort_by_depth(cloud, view).tolist() == list(range(64))[::-1]
    assert sort_by_depth(cloud, view, metric="radial").tolist() == list(range(64))[::-1]


def test_radial_depths__neither_overflow_nor_vanish() -> None:
    # Squares of distances above 1.8e19 and below 1e-23 left float32, and distances tied.
    for size in (1e-30, 1e30):
        cloud = splats(np.array([[0, 0, 1.0], [0, 0, 3.0], [0, 0, 2.0]]) * size)
        assert sort_by_depth(cloud, camera(near=1e-3), metric="radial").tolist() == [1, 2, 0]


# -- projection


@pytest.mark.parametrize("model", ["inria", "spark"])
def test_render__of_enormous_splats_covers_the_picture(model: str) -> None:
    # The determinant overflowed float32 from 4e9 px on: the splat was counted as invalid, or lost its opacity.
    cloud = splats([[0.0, 0.0, 1.0]], scales=1e10, opacities=0.5)

    rendering = render(cloud, camera(), model=model, variant="none" if model == "spark" else None)

    assert rendering.counts.invalid == 0
    # Spark caps axes at 512 px, so that its picture falls off a little.
    assert rendering.alphas == pytest.approx(np.full((48, 64), 0.5), abs=1e-6 if model == "inria" else 0.012)


@pytest.mark.parametrize("distance", [1e-25, 1e-3, 1e25])
def test_colors__do_not_depend_on_the_distance(distance: float) -> None:
    # The length of the way to the eye squared under float32's least or over its largest number: SH saw no direction.
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels.sh_eval import evaluate_colors as kernel

    shN = np.zeros((1, 3, 3), np.float32)
    shN[0, 2] = 1.0
    table = np.zeros((1, R.SPLAT_SIZE), np.float32)
    table[0, R.MEAN] = distance

    kernel(np.zeros((1, 3), np.float32), shN, np.zeros(3, np.float32), 1, np.float32(2.5033429), 0, table)

    assert table[0, R.COLOR] == pytest.approx(0.5 - 0.4886025119, abs=1e-7)


def test_evaluate_colors__normalizes_directions() -> None:
    # Polynomials were evaluated at whatever came: colors grew with the square of the length, and zero gave half of band 4.
    shN = np.ones((3, 24, 3), np.float32)
    sh0 = np.zeros((3, 3), np.float32)
    unit = np.array([[2.0, -1.0, 2.0]]) / 3

    colors = evaluate_colors(sh0, shN, unit * [[1e-200], [1.0], [1e200]])

    assert np.allclose(colors[0], colors[1], rtol=1e-14)
    assert np.allclose(colors[2], colors[1], rtol=1e-14)
    assert np.array_equal(
        evaluate_colors(sh0, shN, np.zeros((3, 3))), evaluate_colors(sh0, shN, np.tile([0.0, 0.0, 1.0], (3, 1)))
    )


def test_covariances__beyond_float64_are_infinite_and_not_nan() -> None:
    # Infinite axes times the zeros of a rotation, and infinities of both signs, made NaN of a splat that is only too large.
    quats = np.array([[1.0, 0, 0, 0], [1.0, 1.0, 0, 0]])
    matrices = covariance_matrices(quats, np.array([[1000.0, 1000.0, 0.0]] * 2), dtype=np.float64)

    assert matrices[0].tolist() == [[np.inf, 0, 0], [0, np.inf, 0], [0, 0, 0]]
    assert not np.isnan(matrices[1]).any()
    assert np.isposinf(matrices[1].diagonal().max())


# -- time


def test_sequence__of_equal_frames_changes_nothing() -> None:
    # (1 - f) x + f x in float32 was an ulp or two off, so that what stood still trembled.
    cloud = random_cloud(500, sh_degree=1)
    cloud = cloud.replace(log_scales=np.maximum(cloud.log_scales, -18))

    for t in (0.1, 0.3, 0.7):
        between = sequence(cloud, cloud).at(t)
        for name in ("means", "log_scales", "sh0", "shN"):
            assert np.array_equal(getattr(between, name), getattr(cloud, name)), name
        shown = np.isfinite(between.opacity_logits)
        assert np.allclose(between.opacity_logits[shown], cloud.opacity_logits[shown], rtol=2**-23, atol=0)


def test_sequence__keeps_opacities_that_are_nearly_1() -> None:
    # 1 - opacity was formed from the opacity, which float64 rounds to 1 from a logit of 37 on: interpolation gave infinity.
    cloud = random_cloud(1).replace(opacity_logits=np.array([50.0]))

    assert sequence(cloud, cloud).at(0.5).opacity_logits == pytest.approx([50.0])
    assert activations.mixed_logits(np.array([50.0]), np.array([60.0]), 0.5) == pytest.approx(
        [50 + np.log(2) - np.log1p(np.exp(-10))]
    )


def test_sequence__interpolates_quaternions_of_any_length() -> None:
    # Their squares overflowed float32, the norm was infinite, and the rotation zero.
    quats = np.array([[0.6, 0.8, 0.0, 0.0]])
    cloud = random_cloud(1).replace(quats=1e25 * quats)

    assert sequence(cloud, cloud).at(0.5).quats == pytest.approx(quats)


def test_sequence__of_frames_with_different_origins_interpolates_in_the_world() -> None:
    # The second frame's means were taken as relative to the origin of the first.
    a = splats([[0.0, 0.0, 0.0]]).replace(origin=np.array([1e6, 0, 0]))
    b = splats([[0.0, 0.0, 0.0]]).replace(origin=np.array([1e6 + 2, 0, 0]))

    between = sequence(a, b).at(0.5)

    assert (between.origin + between.means).tolist() == [[1e6 + 1, 0, 0]]


def test_positions__of_fast_splats_do_not_feel_the_rounding_of_time() -> None:
    # t was rounded to float32 before it was multiplied: what comes back from far away was a fifth of a unit off.
    means, velocities = np.full((1, 3), -11744051.0, np.float32), np.full((1, 3), 2.0**24, np.float32)

    found = positions_at(means, velocities, np.zeros(1, np.float32), 0.7)

    assert found == pytest.approx(np.full((1, 3), 0.2), abs=1e-7)


def test_weights__of_short_gaussians_do_not_feel_the_rounding_of_time() -> None:
    # Against a sigma of 1e-6 the rounding of t to float32 was 2 percent.
    time, sigma, t = np.float32(0.7), np.float32(1e-6), 0.7000011
    expected = np.exp(-0.5 * ((t - float(time)) / float(sigma)) ** 2)

    found = weights_at(np.array([time]), np.array([sigma]), t, "gaussian")

    assert found[0] == pytest.approx(expected, rel=1e-6)


def test_at_time__fades_opacities_that_are_nearly_1() -> None:
    # A logit of 40 times a weight just below 1 went through an opacity that float64 rounds.
    logits, weights = np.array([40.0, 40.0, np.inf]), np.array([1 - 2.0**-24, 1.0, 0.5])

    found = activations.weighted_logits(logits, weights)

    assert found == pytest.approx([24 * np.log(2), 40.0, 0.0], rel=1e-7, abs=1e-12)
    gone = random_cloud(1, sh_degree=0, motion=True).replace(opacity_logits=np.array([-np.inf]))
    assert at_time(gone, 0.3).opacity_logits.tolist() == [-np.inf]


def test_fit_motion__follows_splats_whose_times_cluster_far_from_zero() -> None:
    # Sums of squares cancelled: with times 2e-6 apart and positions of 1e5, velocities lost half of their digits.
    base = random_cloud(20, sh_degree=0).replace(opacity_logits=np.full(20, 3.0))
    times = 0.5 + 2e-6 * np.arange(5)
    frames = [base.replace(means=np.full((20, 3), 2.0**17 + 2.0**-6 * i)) for i in range(5)]
    moved = GaussianSequence(lambda i: frames[i], num_splats=20, sh_degree=0, frame_times=times)

    fitted, _ = fit_motion(moved)

    assert np.allclose(fitted.velocities, 2.0**-6 / 2e-6, rtol=1e-6)


# -- reports


def test_statistics__of_huge_quaternions_and_flat_axes_are_finite(tmp_path: Any) -> None:
    # Norms overflowed float32, and a point, flat along all three axes, had no aspect.
    from gsplat_tools.formats import save

    cloud = random_cloud(3, sh_degree=0).replace(
        quats=np.full((3, 4), 1e25), log_scales=np.array([[0, 0, 0], [0, -np.inf, -np.inf], [-np.inf] * 3])
    )
    save(cloud, tmp_path / "scene.ply")

    attributes = statistics(tmp_path / "scene.ply")["attributes"]

    assert attributes["quat_norms"]["max"] == pytest.approx(2e25)
    assert (attributes["aspect"]["nan"], attributes["aspect"]["inf"]) == (0, 1)


def test_statistics__of_values_closer_than_bins_can_be_make_one_bin() -> None:
    # numpy refuses such a histogram, and the whole report went with it.
    values = np.array([1.0, 1.0 + 2.0**-52])

    assert describe_values(values)["histogram"]["counts"] == [2]
    assert describe_values(np.array([-1e308, 1e308]))["histogram"]["counts"] == [2]


def test_invalid_splats__are_located_where_they_are() -> None:
    # Every cause was reported at the first invalid splat of any.
    cloud = random_cloud(9, sh_degree=0)
    means, quats = cloud.means.copy(), cloud.quats.copy()
    means[2, 1], means[7, 0], quats[5] = np.nan, np.nan, -0.0

    assert locate_invalid(cloud.replace(means=means, quats=quats)) == {"means-nan": (2, 2), "quats-zero": (1, 5)}


def test_spark__counts_colors_that_are_not_numbers() -> None:
    # They were clamped to black or white before the check for invalid splats, and drawn.
    cloud = splats([[0, 0, 3.0]] * 3).replace(sh0=np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0]]))

    counts = render(cloud, camera(), model="spark").counts

    assert (counts.invalid, counts.drawn) == (2, 1)
