"""Each model against the picture of one splat, worked out by hand from the model's definition."""

import numpy as np
import pytest

from gsplat_tools.reference.models import MODELS, find_model
from gsplat_tools.reference.rasterizer import render
from tests.reference.splats import FOCAL, camera, pixel_offsets, splats

Z = 4.0
SIGMA = 0.2
SIGMA2_PX = (FOCAL * SIGMA / Z) ** 2
"""A ball on the axis of the camera: its covariance is (f s / z)^2 in both directions."""
COLOR = np.array([0.8, 0.4, 0.2])
OPACITY = 0.7
TOLERANCE = 1e-6


def ball(**changes):  # type: ignore[no-untyped-def]
    return splats((0, 0, Z), scales=SIGMA, opacities=OPACITY, colors=COLOR, **changes)


def expected(variance, falloff, floor, *, opacity=OPACITY, cap=1.0):  # type: ignore[no-untyped-def]
    """Alphas of the ball: falloff(d2 in sigmas, dx, dy in sigmas), with the rules that all models share."""
    view = camera()
    x, y = pixel_offsets(view, 32, 24)
    alphas = np.minimum(cap, opacity * falloff((x * x + y * y) / variance, x / np.sqrt(variance), y / np.sqrt(variance)))
    return np.where(alphas >= floor, alphas, 0)


def gauss(d2, _x, _y):  # type: ignore[no-untyped-def]
    return np.exp(-d2 / 2)


def inside(limit, falloff):  # type: ignore[no-untyped-def]
    return lambda d2, x, y: np.where(d2 <= limit, falloff(d2, x, y), 0)


def edged(d2, x, y):  # type: ignore[no-untyped-def]
    """Variant 1.2.1: A = d^2 / 8, the unit quad reaches to sqrt(8) sigmas."""
    m = np.maximum(abs(x), abs(y)) / np.sqrt(8)
    return np.exp(-d2 / 2) - np.exp((m - 1.16) * 25)


def shifted(d2, _x, _y):  # type: ignore[no-untyped-def]
    return (np.exp(-d2 / 2) - np.exp(-4)) / (1 - np.exp(-4))


def visionary_opacity() -> float:
    det, blurred = SIGMA2_PX**2, (SIGMA2_PX + 0.1) ** 2
    return OPACITY * np.sqrt(det / (blurred + 1e-6) + 1e-6)


CASES = {
    "inria": ("inria", None, lambda: expected(SIGMA2_PX + 0.3, gauss, 1 / 255, cap=0.99)),
    "unity 1.0": ("unity", "1.0", lambda: expected(SIGMA2_PX + 0.075, inside(8, gauss), 1 / 255)),
    "unity 1.2.1": ("unity", "1.2.1", lambda: expected(SIGMA2_PX + 0.075, inside(8, edged), 1 / 255)),
    "unity fork-4d": ("unity", "fork-4d", lambda: expected(SIGMA2_PX + 0.075, inside(8, shifted), 1 / 255)),
    "spark": (
        "spark",
        "none",
        lambda: expected(SIGMA2_PX + 0.3, inside(8, gauss), 0.5 / 255, opacity=OPACITY * SIGMA2_PX / (SIGMA2_PX + 0.3)),
    ),
    "visionary": (
        "visionary",
        "float",
        lambda: expected(SIGMA2_PX + 0.1, inside(4 * np.sqrt(np.log(255)), gauss), 0, opacity=visionary_opacity(), cap=0.99),
    ),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", TOLERANCE), ("float32", 1e-5)])
def test_render__draws_one_ball_as_its_model_says(case: str, dtype: str, tolerance: float) -> None:
    model, variant, alphas = CASES[case]

    rendering = render(ball(), camera(), model=model, variant=variant, dtype=dtype)  # type: ignore[arg-type]

    assert rendering.image.dtype == dtype
    assert np.abs(rendering.alphas - alphas()).max() < tolerance
    # The color is stored as float32 and comes back by SH.
    assert np.abs(rendering.image - alphas()[:, :, None] * COLOR).max() < tolerance + 1e-6
    assert rendering.counts.drawn == 1


@pytest.mark.parametrize("case", CASES)
def test_render__mixes_the_background_through_what_is_not_covered(case: str) -> None:
    model, variant, alphas = CASES[case]
    background = np.array([0.1, 0.5, 0.9])

    rendering = render(ball(), camera(), model=model, variant=variant, background=background, dtype="float64")

    assert np.abs(rendering.image - (alphas()[:, :, None] * COLOR + (1 - alphas()[:, :, None]) * background)).max() < 2e-6


@pytest.mark.parametrize(("model", "counted"), [("inria", 0), ("unity", 1), ("spark", 0), ("visionary", 1)])
def test_render__counts_eigenvectors_that_the_target_leaves_undefined(model: str, counted: int) -> None:
    assert render(ball(), camera(), model=model).counts.undefined_eigenvectors == counted


def test_inria__draws_only_in_tiles_that_the_square_touches() -> None:
    # Center (32, 24) px: 31.5 -+ r in that rasterizer's numbering. sigma^2 = 0.01^2 + 0.3: r = ceil(3 * 0.93) = 3, since
    # its root is floored at sqrt(0.1): tiles 28.5 / 16 -> 1 up to (34.5 + 15) / 16 -> 3 (exclusive).
    tiny = splats((0, 0, Z), scales=1e-4, opacities=0.999)
    wide = splats((0, 0, Z), scales=0.6, opacities=0.999)  # 15 px: r = ceil(3 * sqrt(225.3 + 0.316)) = 46

    assert np.flatnonzero(render(tiny, camera()).alphas.any(axis=0)).min() >= 16
    columns = np.flatnonzero(render(wide, camera(400, 304), dtype="float64").alphas.any(axis=0))

    # The Gaussian itself stays above 1/255 to 3.33 sigmas, 50 px: 150..249; the square ends at tile 199.5 -+ 46.
    assert columns.min() == 150
    assert columns.max() == 249
    narrow = render(splats((0.0, 0, Z), scales=0.6, opacities=0.999), camera(416, 304), dtype="float64").alphas
    # Center 208 = 13 tiles: from floor(161.5 / 16) = 10 tiles to floor((253.5 + 15) / 16) = 16 tiles: 160..255.
    assert np.flatnonzero(narrow.any(axis=0)).min() == 160
    assert np.flatnonzero(narrow.any(axis=0)).max() == 255


def test_inria__leaves_out_what_is_nearer_than_a_fifth() -> None:
    assert render(splats((0, 0, 0.2)), camera()).counts.culled == 1
    assert render(splats((0, 0, 0.21)), camera()).counts.drawn == 1


@pytest.mark.parametrize(("model", "drawn"), [("inria", 1), ("unity", 0), ("spark", 0), ("visionary", 0)])
def test_render__leaves_out_what_lies_beyond_the_far_plane(model: str, drawn: int) -> None:
    view = camera(near=0.5, far=3.0)

    assert render(splats((0, 0, 3.5)), view, model=model).counts.drawn == drawn


@pytest.mark.parametrize(("model", "drawn"), [("inria", 1), ("unity", 1), ("spark", 0), ("visionary", 0)])
def test_render__culls_at_the_near_plane_where_the_model_does(model: str, drawn: int) -> None:
    view = camera(near=0.5, far=3.0)

    assert render(splats((0, 0, 0.4)), view, model=model).counts.drawn == drawn


@pytest.mark.parametrize("model", MODELS)
def test_render__draws_nothing_at_or_behind_the_camera(model: str) -> None:
    rendering = render(splats([(0, 0, 0), (0, 0, -1), (0, 0, -1e-9)], scales=0.3), camera(), model=model)

    assert rendering.counts.drawn == 0
    assert not rendering.image.any()


def test_unity__leaves_out_splats_below_a_pixel() -> None:
    # lambda1 = (f s / z)^2 + 0.075 against 0.125: s = 0.00894 at z = 4.
    assert render(splats((0, 0, Z), scales=0.0088), camera(), model="unity").counts.culled == 1
    assert render(splats((0, 0, Z), scales=0.0091), camera(), model="unity").counts.drawn == 1


def test_unity__squeezes_splats_to_the_cap() -> None:
    # The longest half axis is min(1024, W, H) = 48 px: sqrt(8 lambda) = 48.
    alphas = render(
        splats((0, 0, Z), scales=4.0, opacities=0.9), camera(), model="unity", variant="1.0", dtype="float64"
    ).alphas
    x, y = pixel_offsets(camera(), 32, 24)
    d2 = (x * x + y * y) / (48**2 / 8)

    assert np.abs(alphas - 0.9 * np.exp(-d2 / 2) * (d2 <= 8)).max() < TOLERANCE


def test_spark__squeezes_splats_to_512_px() -> None:
    view = camera(1200, 40)
    alphas = render(splats((0, 0, Z), scales=40.0, opacities=0.9), view, model="spark", variant="none", dtype="float64").alphas
    x, y = pixel_offsets(view, 600, 20)
    d2 = (x * x + y * y) / (512**2 / 8)

    assert np.abs(alphas - 0.9 * np.exp(-d2 / 2) * (d2 <= 8)).max() < 1e-5


def test_unity__crops_splats_by_the_scale_factor() -> None:
    s = 0.5
    alphas = render(ball(), camera(), model="unity", scale_factor=s, dtype="float64").alphas
    variance = SIGMA2_PX + 0.075
    x, y = (offset / np.sqrt(8 * variance) for offset in pixel_offsets(camera(), 32, 24))
    m = np.maximum(abs(x), abs(y))
    wanted = OPACITY * (np.exp(-4 * (x * x + y * y)) - np.exp((m - 1.16 * s) * 25 * s))

    assert np.abs(alphas - np.where((m <= s) & (wanted >= 1 / 255), wanted, 0)).max() < TOLERANCE


def test_unity__keeps_negative_colors_and_others_do_not() -> None:
    dark = splats((0, 0, Z), scales=SIGMA, colors=(-0.5, 0.5, 1.5))

    for model in MODELS:
        image = render(dark, camera(), model=model, variant="none" if model == "spark" else None).image

        assert (image.min() < -0.1) == (model == "unity")
        assert image.max() > 0.5


def test_unity__applies_brightness_and_decodes_gamma() -> None:
    plain = render(ball(), camera(), model="unity", dtype="float64")

    bright = render(ball(), camera(), model="unity", brightness=2.0, dtype="float64")
    linear = render(ball(), camera(), model="unity", gamma_to_linear=True, dtype="float64")

    assert np.allclose(bright.image, 2 * plain.image)
    assert np.array_equal(bright.alphas, plain.alphas)
    # Within 0.01 of the sRGB transfer function, which the shader approximates.
    exact = ((COLOR + 0.055) / 1.055) ** 2.4
    assert np.abs(linear.image.max(axis=(0, 1)) / plain.alphas.max() - exact).max() < 0.01


def test_inria__compensates_clouds_that_were_trained_that_way() -> None:
    plain, trained = (render(ball(splat_model=name), camera()).alphas.max() for name in ("default", "antialiased"))

    assert trained / plain == pytest.approx(SIGMA2_PX / (SIGMA2_PX + 0.3), rel=1e-4)
    assert render(ball(), camera(), antialias=True).alphas.max() == trained
    assert render(ball(splat_model="antialiased"), camera(), antialias=False).alphas.max() == plain


def test_visionary__stores_centers_in_half_precision() -> None:
    # Halves near ndc 0.3 are 2^-12 apart, half a pixel of 4000.
    view = camera(4000, 48)
    cloud = splats((6.003, 0, 1.0), scales=0.02, opacities=0.9)

    halves, floats = (render(cloud, view, model="visionary", variant=v, dtype="float64").alphas for v in ("half", "float"))
    centers = [float((alphas * (np.arange(4000) + 0.5)).sum() / alphas.sum()) for alphas in (halves, floats)]

    stored = float(np.float16((2000 + 600.3) / 2000 - 1))
    assert centers[1] == pytest.approx(2600.3, abs=0.02)
    assert centers[0] == pytest.approx((1 + stored) * 2000, abs=0.02)
    assert abs(centers[0] - centers[1]) > 0.1


def test_unity__sees_band_4_with_its_wrong_constant() -> None:
    shN = np.zeros((1, 24, 3), np.float32)
    shN[0, 15, 0] = 1.0
    # Direction (1, 0.5, 2) normalized: x y (x^2 - y^2) = 0.375 / 5.25^2.
    cloud = splats((1.0, 0.5, 2.0), colors=(0.5, 0.5, 0.5), shN=shN, opacities=0.9)
    view = camera(200, 200)
    basis = 2.5033429417967046 * 0.5 * 0.75 / 5.25**2

    for model, factor in (("inria", 1.0), ("unity", 0.25)):
        rendering = render(cloud, view, model=model, dtype="float64")
        peak = rendering.alphas == rendering.alphas.max()

        assert rendering.image[peak][0, 0] / rendering.alphas[peak][0] == pytest.approx(0.5 + factor * basis, abs=1e-5)


def test_find_model__names_what_there_is() -> None:
    with pytest.raises(ValueError, match=r"inria, unity, spark, visionary"):
        find_model("gpu")
    with pytest.raises(ValueError, match=r"1\.2\.1, 1\.0, fork-4d"):
        find_model("unity", "2")
    assert find_model("unity").variant == "1.2.1"
    assert find_model("spark").variant == "packed"
