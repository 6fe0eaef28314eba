"""Visionary's buffers: byte layouts by hand, halves to the bit, and round trips."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from gsplat_tools.attributes.covariance import covariance_triangles
from gsplat_tools.codecs import visionary_buffers as buffers

SCALARS = [1.0, -2.0, 0.5, 0.25, 0.125, 3.0, -4.0, 6.0, 8.0, -0.75]


def gaussian() -> tuple[Any, Any, Any]:
    values = np.array(SCALARS, np.float32)
    return values[None, :3], values[3:4], values[None, 4:]


def harmonics(degree: int, count: int = 2) -> tuple[Any, Any]:
    numbers = np.arange(count * 3 * (degree + 1) ** 2, dtype=np.float32).reshape(count, -1, 3)
    return numbers[:, 0], numbers[:, 1:]


@pytest.mark.parametrize(("precision", "code", "size"), [("f32", "<10f", 40), ("f16", "<10e", 20)])
def test_encode_gaussians__packs_ten_scalars_in_order(precision: Any, code: str, size: int) -> None:
    words = buffers.encode_gaussians(*gaussian(), precision=precision)

    assert words.tobytes() == struct.pack(code, *SCALARS)
    assert words.nbytes == size
    for decoded, values in zip(buffers.decode_gaussians(words, precision=precision), gaussian(), strict=True):
        assert np.array_equal(decoded, values)


@pytest.mark.parametrize(
    ("value", "bits"),
    [
        (0.1, 0x2E66),
        (1 + 2**-11, 0x3C00),  # a tie goes to the even neighbour
        (1 + 3 * 2**-11, 0x3C02),
        (2**-24, 0x0001),
        (2**-25, 0x0000),
        (65519.0, 0x7BFF),
        (65520.0, 0x7C00),
        (-np.inf, 0xFC00),
        (np.nan, 0x7E00),
        (-0.0, 0x8000),
    ],
)
def test_to_halves__rounds_as_visionary_does(value: float, bits: int) -> None:
    assert buffers.to_halves(np.array([value], np.float32)).view(np.uint16)[0] == bits


def test_encode_sh__interleaves_colors_of_each_coefficient() -> None:
    sh0, shN = harmonics(1, 1)

    words = buffers.encode_sh(sh0, shN, precision="f32")

    assert words.shape == (1, 48)
    assert words.view(np.float32)[0].tolist() == [*range(12), *[0] * 36]


def test_encode_sh__keeps_channels_apart_after_the_constant_term() -> None:
    sh0, shN = harmonics(1, 1)

    words = buffers.encode_sh(sh0, shN, precision="f16", layout="channel-major")

    assert words.shape == (1, 24)
    assert words.view(np.float16)[0, :12].tolist() == [0, 1, 2, 3, 6, 9, 4, 7, 10, 5, 8, 11]


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("layout", ["interleaved", "channel-major"])
@pytest.mark.parametrize("precision", ["f32", "f16"])
def test_decode_sh__gives_back_what_was_encoded(degree: int, layout: Any, precision: Any) -> None:
    sh0, shN = harmonics(degree)

    words = buffers.encode_sh(sh0, shN, precision=precision, layout=layout)
    found = buffers.decode_sh(words, degree, precision=precision, layout=layout)

    assert np.array_equal(found[0], sh0)
    assert np.array_equal(found[1], shN)


def test_decode_sh__of_interleaved_may_take_fewer_bands_but_channel_major_shifts() -> None:
    sh0, shN = harmonics(3)

    usual = buffers.decode_sh(buffers.encode_sh(sh0, shN), 1)[1]
    shifted = buffers.decode_sh(buffers.encode_sh(sh0, shN, layout="channel-major"), 1, layout="channel-major")[1]

    assert np.array_equal(usual, shN[:, :3])
    # With m = 3 green begins where red's fourth coefficient lies.
    assert np.array_equal(shifted[:, :, 0], shN[:, :3, 0])
    assert np.array_equal(shifted[:, :, 1], shN[:, 3:6, 0])


@pytest.mark.parametrize(("precision", "width"), [("f32", 3), ("f16", 2)])
def test_raw_colors__take_three_words_or_two(precision: Any, width: int) -> None:
    colors = np.array([[0.5, 0.25, 2.0], [0.0, 1.0, -1.0]], np.float32)

    words = buffers.encode_raw_colors(colors, precision=precision)

    assert words.shape == (2, width)
    assert precision == "f32" or (words.view(np.float16)[:, 3] == 0).all()
    assert np.array_equal(buffers.decode_raw_colors(words, precision=precision), colors)


def test_buffers__refuse_what_they_do_not_hold() -> None:
    sh0, shN = harmonics(4)
    with pytest.raises(ValueError, match="degrees 0 to 3"):
        buffers.encode_sh(sh0, shN)
    with pytest.raises(ValueError, match="layout"):
        buffers.encode_sh(sh0, shN[:, :3], layout="planar")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="precision"):
        buffers.encode_raw_colors(sh0, precision="i8")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"\(N, 5\) uint32"):
        buffers.decode_gaussians(np.zeros((2, 10), np.uint32))
    with pytest.raises(ValueError, match="degree"):
        buffers.decode_sh(np.zeros((2, 24), np.uint32), 4)


def test_half_covariance_losses__counts_what_becomes_of_the_smallest_axis() -> None:
    # Diagonal, so that every variance is rounded alone: 2^-26 vanishes, 0.75 * 2^-24 rises to 2^-24 (not by a factor of 4).
    diagonals = [(1.0, 1.0, 1.0), (1.0, 1.0, 2.0**-26), (1.0, 1.0, 0.75 * 2**-24), (1e5, 1.0, 1.0), (1.0, 1.0, 0.0)]
    covariances = np.zeros((5, 6))
    covariances[:, [0, 3, 5]] = diagonals

    assert buffers.half_covariance_losses(covariances) == buffers.CovarianceLosses(5, vanished=1, halved=1, overflowed=1)


def test_half_covariance_losses__of_a_turned_needle_is_total() -> None:
    # Variances 1 and 1e-5 along the diagonals of a plane: entries near 0.5 are rounded in steps of 2^-11.
    needle = np.array([[0.500005, 0.499995, 0.0, 0.500005, 0.0, 1.0]])

    losses = buffers.half_covariance_losses(needle)

    assert (losses.vanished, losses.halved) == (1, 1)


def test_convert_precision__packs_pairs_and_pads_odd_tails() -> None:
    scalars = np.array([[1.0, 2.0, -3.0]], np.float32)

    halves = buffers.convert_precision(scalars.view(np.uint32), source="f32", target="f16")
    back = buffers.convert_precision(halves, source="f16", target="f32")

    assert halves.tobytes() == struct.pack("<4e", 1.0, 2.0, -3.0, 0.0)
    assert back.view(np.float32).tolist() == [[1.0, 2.0, -3.0, 0.0]]
    with pytest.raises(ValueError, match="precision"):
        buffers.convert_precision(halves, source="f16", target="i8")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="uint32"):
        buffers.convert_precision(halves[0], source="f16", target="f32")


def test_half_error__bounds_the_conversion_and_is_reached(rng: np.random.Generator) -> None:
    values = np.concatenate([rng.normal(size=5000), np.exp(rng.uniform(-25, 11, 5000)), [1 + 2**-11, 2**-25, 65519.99]])
    values = values.astype(np.float32)[:, None]

    halves = buffers.convert_precision(values.view(np.uint32), source="f32", target="f16")
    errors = np.abs(
        buffers.convert_precision(halves, source="f16", target="f32").view(np.float32)[:, :1] - values.astype(float)
    )
    shares = errors / buffers.half_error(values)

    assert 0.99 < shares.max() <= 1
    assert buffers.half_error(np.array([65520.0, -1e6])).tolist() == [np.inf, np.inf]


def test_count_lost_needles__agrees_with_the_eigenvalues(rng: np.random.Generator) -> None:
    quats = rng.normal(size=(3000, 4)).astype(np.float32)
    log_scales = rng.uniform(-9, 1, (3000, 3)).astype(np.float32)
    log_scales[:50, 0] = -np.inf
    log_scales[50:60] = 6.0  # overflows
    log_scales[60:70] = -12.0  # vanishes as a whole

    covariances = covariance_triangles(quats, log_scales, dtype=np.float64)
    expected = buffers.half_covariance_losses(covariances).vanished

    assert expected > 500
    # Covariances are rounded twice, as Visionary's loaders do: one in a few thousand falls on the other side.
    assert buffers.count_lost_needles(quats, log_scales) == pytest.approx(expected, abs=3)
