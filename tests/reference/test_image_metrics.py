import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from gsplat_tools.reference.image_metrics import compare_images, psnr, ssim


def test_psnr__of_a_known_error() -> None:
    a = np.zeros((4, 4, 3))

    # One value of 48 off by 0.5: mean square 0.25 / 48.
    b = a.copy()
    b[1, 2, 0] = 0.5

    assert psnr(a, b) == pytest.approx(10 * math.log10(48 / 0.25))
    assert psnr(a, a) is None


def test_psnr__clamps_both_pictures() -> None:
    a, b = np.full((2, 2, 3), 1.5), np.full((2, 2, 3), 1.0)

    assert psnr(a, b) is None
    assert compare_images(a, b).identical
    assert compare_images(np.full((2, 2, 3), -1.0), np.zeros((2, 2, 3))).identical


@pytest.mark.parametrize("shape", [(11, 11, 3), (20, 33, 3), (64, 48, 3)])
def test_ssim__equals_the_maintained_implementation(shape, rng) -> None:  # type: ignore[no-untyped-def]
    a = rng.random(shape)
    b = np.clip(a + rng.normal(0, 0.1, shape), 0, 1)

    wanted = structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2
    )

    assert ssim(a, b) == pytest.approx(wanted, abs=1e-9)


def test_ssim__of_small_pictures_is_not_defined() -> None:
    assert ssim(np.zeros((10, 50, 3)), np.ones((10, 50, 3))) is None


def test_compare_images__counts_pixels_beyond_steps() -> None:
    a = np.zeros((10, 10, 3))
    b = a.copy()
    b[0, 0, 1] = 1.5 / 255
    b[5, 5] = 9 / 255

    metrics = compare_images(a, b)

    assert metrics.share_above_1 == 0.02
    assert metrics.share_above_8 == 0.01
    assert metrics.max_abs == pytest.approx(9 / 255)
    assert metrics.mean_abs == pytest.approx((1.5 + 27) / 255 / 300)
    assert not metrics.identical


def test_compare_images__of_the_same_picture_has_no_psnr(rng) -> None:  # type: ignore[no-untyped-def]
    image = rng.random((16, 16, 3)).astype(np.float32)

    assert compare_images(image, image).to_json() == {
        "psnr": None,
        "identical": True,
        "ssim": 1.0,
        "max_abs": 0.0,
        "mean_abs": 0.0,
        "share_above_1": 0.0,
        "share_above_8": 0.0,
    }


def test_compare_images__refuses_other_shapes() -> None:
    for a, b in (((4, 4, 3), (4, 5, 3)), ((4, 4), (4, 4)), ((0, 4, 3), (0, 4, 3))):
        with pytest.raises(ValueError, match="one shape"):
            compare_images(np.zeros(a), np.zeros(b))
