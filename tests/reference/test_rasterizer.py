"""render as a whole: bits, edges, orders, options, what becomes of every splat."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools import parallel
from gsplat_tools.reference import _stages
from gsplat_tools.reference.cutouts import Cutout
from gsplat_tools.reference.models import MODELS
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.sorting import sort_by_depth
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.reference.splats import camera, splats

EVERY_VARIANT = [(model, variant) for model, variants in MODELS.items() for variant in variants]


def view(width: int = 100, height: int = 75):  # type: ignore[no-untyped-def]
    return camera(width, height, near=0.1, far=50.0)


def in_front(cloud):  # type: ignore[no-untyped-def]
    return cloud.replace(means=cloud.means + np.array([0, 0, 4], np.float32))


@pytest.mark.parametrize(("model", "variant"), EVERY_VARIANT)
def test_render__gives_the_same_bits_for_any_number_of_threads(model: str, variant: str | None, monkeypatch) -> None:
    monkeypatch.setattr(parallel, "BLOCK_SIZE", 128)
    monkeypatch.setattr(_stages, "_TILES_PER_TASK", 1)
    cloud = in_front(random_cloud(1000))
    images = []

    for jobs in (1, 2, 4, 8):
        with parallel.use_jobs(jobs):
            images.append(render(cloud, view(), model=model, variant=variant).image.tobytes())

    assert len(set(images)) == 1


@pytest.mark.parametrize("model", MODELS)
def test_render__does_not_depend_on_how_tiles_are_banded(model: str, monkeypatch) -> None:
    cloud = in_front(random_cloud(300))
    whole = render(cloud, view(), model=model)

    monkeypatch.setattr(_stages, "_MAX_ENTRIES", 50)
    banded = render(cloud, view(), model=model)

    assert np.array_equal(whole.image, banded.image)
    assert np.array_equal(whole.alphas, banded.alphas)


@pytest.mark.parametrize(("model", "variant"), EVERY_VARIANT)
def test_render__in_float32_stays_close_to_float64(model: str, variant: str | None) -> None:
    cloud = in_front(random_cloud(200, seed=3))

    single, double = (render(cloud, view(), model=model, variant=variant, dtype=dtype) for dtype in ("float32", "float64"))  # type: ignore[arg-type]
    difference = np.abs(single.image - double.image).max(axis=2)

    # Off the thresholds rounding stays below 2e-3; a fragment on the floor of alpha may flip, which moves colors by at
    # most a few 255ths, in few pixels. Codes of the packed accumulator may flip as well.
    assert np.mean(difference > 2e-3) < 0.01
    assert difference.max() < 0.05


@pytest.mark.parametrize("model", MODELS)
@given(exponent=st.floats(-8, 8), aspect=st.floats(-4, 4), turn=st.floats(0, np.pi), depth=st.floats(-1, 3))
def test_render__stays_finite_whatever_the_size(model: str, exponent: float, aspect: float, turn: float, depth: float) -> None:
    """Footprints from 1e-6 to 1e6 px and beyond, needles at any angle, at, before and behind the camera."""
    scales = 10.0 ** np.clip([exponent, exponent + aspect, exponent], -30, 12)
    cloud = splats(
        [(0.1, 0.2, depth), (0, 0, 2)], scales=scales[None], opacities=0.9, quats=(np.cos(turn), 0.3, 0.1, np.sin(turn))
    )

    rendering = render(cloud, view(), model=model)

    assert np.isfinite(rendering.image).all()
    assert rendering.alphas.min() >= 0
    assert rendering.alphas.max() <= 1
    counts = rendering.counts
    assert counts.drawn + counts.culled + counts.hidden + counts.invalid == counts.splats == 2


def test_render__draws_needles_as_thin_as_they_are() -> None:
    """A needle of 1000 px by 0.55 px at 30 degrees: the naive determinant in float32 is off by percents here."""
    half = np.deg2rad(30) / 2
    cloud = splats((0, 0, 1), scales=((10.0, 1e-4, 1e-4),), opacities=0.9, quats=(np.cos(half), 0, 0, np.sin(half)))

    alphas = {dtype: render(cloud, view(), dtype=dtype).alphas for dtype in ("float32", "float64")}  # type: ignore[arg-type]
    x, y = np.meshgrid(np.arange(100) + 0.5 - 50, np.arange(75) + 0.5 - 37.5)
    along, across = x * np.cos(2 * half) + y * np.sin(2 * half), y * np.cos(2 * half) - x * np.sin(2 * half)
    exact = 0.9 * np.exp(-0.5 * (along**2 / (1000**2 + 0.3) + across**2 / (0.01**2 + 0.3)))

    drawn = exact > 1.02 / 255
    assert np.abs(alphas["float64"] - exact)[drawn].max() < 1e-6
    assert np.abs(alphas["float32"] - exact)[drawn].max() < 2e-3


@pytest.mark.parametrize("model", MODELS)
def test_render__composites_two_splats_by_hand(model: str) -> None:
    """Both orders of the list, so that only the depth decides."""
    colors, opacities = np.array([[1.0, 0.5, 0.0], [0.0, 0.5, 1.0]]), np.array([0.6, 0.9])
    both = splats([(0, 0, 3), (0, 0, 5)], scales=0.3, opacities=opacities, colors=colors)
    variant = "none" if model == "spark" else "float" if model == "visionary" else None

    alone = [render(both.take([i]), view(), model=model, variant=variant, dtype="float64").alphas for i in (0, 1)]  # type: ignore[arg-type]
    together = render(both, view(), model=model, variant=variant, dtype="float64")
    swapped = render(both.take([1, 0]), view(), model=model, variant=variant, dtype="float64")  # type: ignore[arg-type]

    near, far = (alpha[:, :, None] for alpha in alone)
    assert np.abs(together.image - (near * colors[0] + (1 - near) * far * colors[1])).max() < 2e-6
    assert np.array_equal(together.image, swapped.image)


def test_inria__stops_before_the_splat_that_would_end_a_pixel() -> None:
    # Transmittance after each of the opaque splats: 0.01, then 1e-4 (float32: 0.99 caps alpha), which is below the stop.
    cloud = splats([(0, 0, z) for z in (2, 3, 4)], scales=1.0, opacities=1.0, colors=[(1, 0, 0), (0, 1, 0), (0, 0, 1)])

    rendering = render(cloud, camera(33, 33), dtype="float64")
    center = rendering.image[16, 16]

    # 0.01 * (1 - 0.99) = 1e-4 in real numbers; in float64 it falls just below or above, so look at the third splat.
    assert center[0] == pytest.approx(0.99)
    assert center[2] == 0
    assert center[1] in (pytest.approx(0.0), pytest.approx(0.0099))


def test_unorm8__rounds_after_every_blend() -> None:
    """Ten faint splats of alpha 0.004 on white: each blend moves 255 by less than half a step, so nothing changes."""
    faint = splats([(0, 0, 3 + i) for i in range(10)], scales=100.0, opacities=0.0045, colors=(0.9, 0.9, 0.9))
    white = (1.0, 1.0, 1.0)

    rounded = render(faint, view(), model="visionary", variant="float", background=white, framebuffer="unorm8")
    smooth = render(faint, view(), model="spark", variant="none", background=white)
    each = render(faint, view(), model="spark", variant="none", background=white, framebuffer="unorm8")

    assert rounded.counts.drawn == 0  # below 0.02
    assert smooth.image.min() < 1 - 8 * 0.0045 * 0.1
    assert each.image.min() == 1.0


def test_unorm8__clamps_each_fragment_and_keeps_to_steps() -> None:
    cloud = in_front(random_cloud(300))

    image = render(cloud, view(), model="unity", framebuffer="unorm8").image
    float_image = render(cloud, view(), model="unity").image

    assert image.min() >= 0
    assert image.max() <= 1
    assert np.abs(image * 255 - np.rint(image * 255)).max() < 1e-4
    assert float_image.min() < 0  # negative colors are there


@pytest.mark.parametrize("model", MODELS)
def test_render__takes_a_given_order(model: str) -> None:
    cloud = in_front(random_cloud(400))
    variant = "none" if model == "spark" else None
    metric = {"spark": "radial", "visionary": "clip"}.get(model, "depth")

    own = render(cloud, view(), model=model, variant=variant)
    given_order = render(cloud, view(), model=model, variant=variant, order=sort_by_depth(cloud, view(), metric=metric))  # type: ignore[arg-type]
    stale = render(cloud, view(), model=model, variant=variant, order=np.arange(400))

    assert np.array_equal(own.image, given_order.image)
    assert not np.array_equal(own.image, stale.image)


def test_render__hides_what_the_order_does_not_name() -> None:
    cloud = in_front(random_cloud(100))

    part = render(cloud, view(), order=np.arange(40, dtype=np.uint32)[::-1])

    assert part.counts.hidden == 60
    with pytest.raises(ValueError, match=r"name splats 0\.\.99"):
        render(cloud, view(), order=[100])


def test_render__counts_invalid_splats_and_draws_the_rest() -> None:
    cloud = in_front(random_cloud(20, sh_degree=0))
    means, log_scales, quats, logits = (a.copy() for a in (cloud.means, cloud.log_scales, cloud.quats, cloud.opacity_logits))
    means[0, 1] = np.nan
    means[1, 0] = np.inf
    log_scales[2, 0] = np.nan
    log_scales[3, 0] = np.inf
    log_scales[4] = 89.0  # exp overflows
    quats[5] = 0
    logits[6] = np.nan
    broken = cloud.replace(means=means, log_scales=log_scales, quats=quats, opacity_logits=logits)

    for model in MODELS:
        rendering = render(broken, view(), model=model)
        rest = render(cloud.take(slice(7, None)), view(), model=model)

        assert rendering.counts.invalid == 7
        assert np.array_equal(rendering.image, rest.image)


def test_render__accepts_infinite_opacities_and_flat_axes() -> None:
    cloud = splats([(0, 0, 3), (0, 0, 4)], scales=((0.2, 0.2, 0.0), (0.2, 0.2, 0.2)), opacities=[1.0, 0.0])

    rendering = render(cloud, view())

    assert np.isposinf(cloud.opacity_logits[0])
    assert np.isneginf(cloud.opacity_logits[1])
    assert rendering.counts.invalid == 0
    assert rendering.counts.drawn == 1
    assert rendering.alphas.max() == pytest.approx(0.99, abs=1e-3)


def test_render__of_nothing_is_the_background() -> None:
    for model in MODELS:
        rendering = render(random_cloud(0), view(), model=model, background=(0.25, 0.5, 0.75))

        assert np.all(rendering.image == np.array([0.25, 0.5, 0.75], np.float32))
        assert not rendering.alphas.any()


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (33, 17), (64, 16)])
def test_render__is_the_middle_of_a_larger_picture(size: tuple[int, int]) -> None:
    """Sizes that are no multiple of a tile; the model without any rule of tiles or of the size of the image."""
    cloud = in_front(random_cloud(100))
    width, height = size

    small = render(cloud, camera(width, height), model="unity", variant="1.0").image
    large = render(cloud, camera(width + 64, height + 64), model="unity", variant="1.0").image

    # The cap min(1024, W, H) squeezes wide splats in small pictures only; none of these is that wide in 33 px and more.
    if min(size) > 30:
        assert np.abs(small - large[32:-32, 32:-32]).max() < 1e-5
    assert small.shape == (height, width, 3)


def test_render__measures_from_the_origin_of_the_cloud() -> None:
    cloud = in_front(random_cloud(50))
    far_away = np.array([4e5, -3e6, 120.0])
    moved = cloud.replace(origin=far_away)
    viewmat = np.eye(4)
    viewmat[:3, 3] = -far_away
    here = view()
    there = type(here)(viewmat, here.K, here.width, here.height, here.near, here.far)

    for model in MODELS:
        assert np.array_equal(render(cloud, here, model=model).image, render(moved, there, model=model).image)


def test_render__limits_the_sh_degree() -> None:
    cloud = in_front(random_cloud(100, sh_degree=3))

    for degree in (0, 1, 2):
        kept = (degree + 1) ** 2 - 1
        cut = cloud.replace(shN=cloud.shN[:, :kept])
        assert np.array_equal(render(cloud, view(), sh_degree=degree).image, render(cut, view()).image)
    fourth = in_front(random_cloud(100, sh_degree=4))
    third = fourth.replace(shN=fourth.shN[:, :15])
    assert np.array_equal(render(fourth, view(), model="spark").image, render(third, view(), model="spark").image)
    assert not np.array_equal(render(fourth, view()).image, render(third, view()).image)


def test_render__evaluates_motion_as_the_sort_does() -> None:
    cloud = in_front(random_cloud(200, motion=True))

    rendering = render(cloud, view(), model="unity", variant="fork-4d", t=0.3)
    visible = (cloud.times <= np.float32(0.3)) & (np.float32(0.3) <= cloud.times + cloud.durations)
    moved = cloud.means + cloud.velocities * (0.3 - cloud.times.astype(np.float64))[:, None]
    frozen = cloud.replace(means=moved, velocities=None, times=None, durations=None).take(visible)

    assert rendering.counts.hidden == np.count_nonzero(~visible)
    assert np.array_equal(rendering.image, render(frozen, view(), model="unity", variant="fork-4d").image)


def test_render__draws_the_frame_of_a_sequence() -> None:
    clouds = [in_front(random_cloud(50, seed=seed)) for seed in (1, 2)]
    sequence = GaussianSequence(clouds.__getitem__, num_splats=50, sh_degree=3, num_frames=2)

    assert np.array_equal(render(sequence, view(), t=1.0).image, render(sequence.at(1.0), view()).image)
    assert not np.array_equal(render(sequence, view(), t=0.0).image, render(sequence, view(), t=1.0).image)


def test_unity__hides_what_a_cutout_cuts() -> None:
    cloud = in_front(random_cloud(200))
    matrix = np.diag([1.0, 1.0, 1.0, 1.0])
    matrix[2, 3] = -4.0

    rendering = render(cloud, view(), model="unity", cutouts=[Cutout(matrix, "box")])
    kept = (np.abs(cloud.means - np.array([0, 0, 4], np.float32)) <= 1).all(axis=1)

    assert rendering.counts.hidden == np.count_nonzero(~kept)
    assert np.array_equal(rendering.image, render(cloud.take(kept), view(), model="unity").image)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dtype": "float16"}, "dtype must be"),
        ({"framebuffer": "hdr"}, "framebuffer must be"),
        ({"sh_degree": -1}, "sh_degree must not be negative"),
        ({"scale_factor": 0.0, "model": "unity"}, "scale_factor must be positive"),
        ({"brightness": 2.0}, "belong to model 'unity'"),
        ({"background": (0, 0)}, "background must be three"),
        ({"t": np.nan}, "time must be finite"),
        ({"order": [[0]]}, "one-dimensional"),
        ({"variant": "fast"}, "variants of model 'inria': none"),
    ],
)
def test_render__refuses_arguments_that_mean_nothing(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        render(splats((0, 0, 2)), view(), **arguments)
