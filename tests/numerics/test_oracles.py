"""Formulas at the extremes against arithmetic of 60 digits, or closed forms; bounds are derived from float32's half step."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.attributes import activations, covariance, quaternions
from gsplat_tools.attributes.spherical_harmonics import evaluate_colors
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.reference.sorting import float_to_sortable, sort_pairs
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud
from tests.numerics.exact import HALF_STEP, MP, mp_matrix

EXTREMES = np.array(
    [0.0, 1e-45, 1e-40, 1.2e-38, 1e-30, 1e-8, 0.1, 0.5, 1.0, 5.54, 6.23, 16.64, 17.0, 37.0, 40.0, 87.0, 88.7, 103.0, 1e4, 3e38]
)


# -- activations


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_activations__are_exact_to_two_steps_from_subnormals_to_the_ends(dtype: Any) -> None:
    values = np.concatenate([EXTREMES, -EXTREMES]).astype(dtype)
    step = float(np.finfo(dtype).eps)
    least = float(np.finfo(dtype).smallest_subnormal)

    opacities, scales = activations.sigmoid(values), activations.exp_scales(values)

    for value, opacity, scale in zip(values, opacities, scales, strict=True):
        exact = 1 / (1 + MP.exp(-MP.mpf(float(value))))
        assert abs(MP.mpf(float(opacity)) - exact) <= exact * 2 * step + least
        if abs(value) < 1e4:
            exact = MP.exp(MP.mpf(float(value)))
            if np.isfinite(scale):
                assert abs(MP.mpf(float(scale)) - exact) <= exact * step + least
            else:
                assert exact > float(np.finfo(dtype).max)


@given(st.floats(0, 1, width=32))
def test_logit__is_exact_to_two_steps(opacity: float) -> None:
    found = float(activations.logit(np.array([opacity], np.float32))[0])

    if opacity in (0.0, 1.0):
        assert found == (np.inf if opacity else -np.inf)
        return
    p = MP.mpf(opacity)
    exact = MP.log(p / (1 - p))
    assert abs(MP.mpf(found) - exact) <= abs(exact) * 2 * HALF_STEP + MP.mpf(2) ** -52


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(0, 1))
def test_mixed_logits__are_those_of_the_mixed_opacities(a: float, b: float, fraction: float) -> None:
    found = float(activations.mixed_logits(np.array([a]), np.array([b]), fraction)[0])

    f = MP.mpf(fraction)

    def mix(sign: int) -> Any:
        return (1 - f) / (1 + MP.exp(-sign * MP.mpf(a))) + f / (1 + MP.exp(-sign * MP.mpf(b)))

    exact = MP.log(mix(1)) - MP.log(mix(-1))
    # 1 - fraction is rounded, and where the logits differ by 200 that is all there is of one side.
    slack = 2.0**-53 / max(1 - fraction, 2.0**-53) if fraction < 1 else 0.0
    assert abs(MP.mpf(found) - exact) <= 1e-14 * max(1, abs(exact)) + 4 * slack


# -- rotations and covariances


@pytest.mark.parametrize("length", [1e-300, 1e-30, 1.0, 1e30, 1e300])
def test_normalize__keeps_the_direction_at_any_length(length: float, rng: np.random.Generator) -> None:
    quats = rng.normal(size=(50, 4))

    units = quaternions.normalize(quats * length)

    for quat, unit in zip(quats, units, strict=True):
        norm = MP.sqrt(sum(MP.mpf(float(c * length)) ** 2 for c in quat))
        for component, found in zip(quat, unit, strict=True):
            assert abs(MP.mpf(float(found)) - MP.mpf(float(component * length)) / norm) <= 4 * 2.0**-53


@pytest.mark.parametrize("aspect", [1.0, 1e2, 1e5])
def test_covariances__of_needles_keep_their_thin_axes(aspect: float, rng: np.random.Generator) -> None:
    quats = rng.normal(size=(20, 4)).astype(np.float32)
    logs = np.tile(np.log([1.0, 1 / aspect, 1 / aspect]), (20, 1)).astype(np.float32)

    matrices = covariance.covariance_matrices(quats, logs, dtype=np.float64)

    for quat, log, found in zip(quats, logs, matrices, strict=True):
        rotation = mp_matrix(quat)
        exact = rotation * MP.diag([MP.exp(2 * MP.mpf(float(v))) for v in log]) * rotation.T
        assert np.array_equal(found, found.T)
        error = max(abs(MP.mpf(float(found[i, j])) - exact[i, j]) for i in range(3) for j in range(3))
        assert error <= 16 * 2.0**-53  # of the longest axis, 1


# -- keys


def test_keys__order_every_kind_of_float() -> None:
    values = [-np.inf, -3.4e38, -1.0, -1.2e-38, -1e-40, -1e-45, -0.0, 0.0, 1e-45, 1e-40, 1.2e-38, 1.0, 3.4e38, np.inf]
    floats = np.array(values, np.float32)

    keys = float_to_sortable(floats)

    assert (np.diff(keys.astype(np.int64)) > 0).all()
    nans = np.array([struct.unpack("<f", struct.pack("<I", bits))[0] for bits in (0x7FC00000, 0xFFC00000)], np.float32)
    low, high = float_to_sortable(nans)[[1, 0]]
    assert low < keys[0]
    assert high > keys[-1]


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=80))
def test_sort_pairs__of_float_keys_is_the_order_of_floats(values: list[float]) -> None:
    floats = np.array(values, np.float32)

    _, order = sort_pairs(float_to_sortable(floats), np.arange(len(floats), dtype=np.uint32))

    # -0 sorts below +0; everything else as floats do, ties in order.
    signs = np.signbit(floats)
    expected = sorted(range(len(floats)), key=lambda i: (floats[i], 0 if floats[i] != 0 else 0 if signs[i] else 1))
    assert order.tolist() == expected


# -- spherical harmonics


@pytest.mark.parametrize("length", [1e-300, 1e-20, 0.5, 1.0, 1e20, 1e300])
def test_evaluate_colors__is_exact_at_any_length_and_size(length: float, rng: np.random.Generator) -> None:
    shN = 1e3 * rng.uniform(-1, 1, (5, 24, 3))
    sh0 = 1e3 * rng.uniform(-1, 1, (5, 3))
    directions = rng.normal(size=(5, 3)) * length

    colors = evaluate_colors(sh0, shN, directions)

    for row in range(5):
        x, y, z = (MP.mpf(float(c)) for c in directions[row])
        norm = MP.sqrt(x * x + y * y + z * z)
        basis = [real_harmonic(band, m, z / norm, MP.atan2(y, x)) for band in range(1, 5) for m in range(-band, band + 1)]
        for channel in range(3):
            exact = MP.mpf("0.5") + MP.mpf(float(sh0[row, channel])) / (2 * MP.sqrt(MP.pi))
            exact += sum(MP.mpf(float(c)) * weight for c, weight in zip(shN[row, :, channel], basis, strict=True))
            # 25 terms of up to 3 x 1000, each with a dozen roundings.
            assert abs(MP.mpf(float(colors[row, channel])) - exact) <= 25 * 3e3 * 16 * 2.0**-53


LEGENDRE = ([1], [1, 0], [1.5, 0, -0.5], [2.5, 0, -1.5, 0], [4.375, 0, -3.75, 0, 0.375])
"""Legendre polynomials, highest power first."""


def real_harmonic(band: int, m: int, height: Any, azimuth: Any) -> Any:
    """Textbook real harmonic with the Condon-Shortley phase, as the 3DGS PLY has it."""
    n = abs(m)
    norm = MP.sqrt((2 * band + 1) / (4 * MP.pi) * MP.factorial(band - n) / MP.factorial(band + n))
    value = MP.mpf(0)
    for coefficient in np.polyder(np.array(LEGENDRE[band], float), n):
        value = value * height + MP.mpf(float(coefficient))
    legendre = (-1) ** n * MP.sqrt(1 - height**2) ** n * value
    if m == 0:
        return norm * legendre
    return MP.sqrt(2) * norm * legendre * (MP.cos(n * azimuth) if m > 0 else MP.sin(n * azimuth))


# -- time


def two_frames(a: GaussianCloud, b: GaussianCloud) -> GaussianSequence:
    return GaussianSequence(lambda i: (a, b)[i], num_splats=len(a), sh_degree=a.sh_degree, num_frames=2)


@pytest.mark.parametrize("angle", [1e-7, 1e-3, 1.0, np.pi - 1e-3, np.pi])
@pytest.mark.parametrize("sign", [1, -1])
def test_rotations__interpolate_on_one_hemisphere(angle: float, sign: int) -> None:
    base = random_cloud(1, sh_degree=0)
    a = base.replace(quats=np.array([[0.5, -0.5, 0.5, 0.5]]))
    turn = np.array([np.cos(angle / 2), 0, np.sin(angle / 2), 0])
    b = base.replace(quats=sign * quaternions.multiply(turn, a.quats.astype(np.float64)))

    for fraction in (0.25, 0.5):
        found = two_frames(a, b).at(fraction).quats[0].astype(np.float64)
        first, second = ([MP.mpf(float(c)) for c in cloud.quats[0]] for cloud in (a, b))
        if sum(p * q for p, q in zip(first, second, strict=True)) < 0:
            second = [-c for c in second]
        mixed = [(1 - MP.mpf(fraction)) * p + MP.mpf(fraction) * q for p, q in zip(first, second, strict=True)]
        norm = MP.sqrt(sum(c * c for c in mixed))
        for component, exact in zip(found, mixed, strict=True):
            assert abs(MP.mpf(float(component)) - exact / norm) <= HALF_STEP


@given(st.floats(-18, 88, width=32), st.floats(-18, 88, width=32), st.floats(0.01, 0.99))
def test_log_scales__interpolate_as_geometric_means(a: float, b: float, t: float) -> None:
    base = random_cloud(1, sh_degree=0)
    frames = two_frames(*(base.replace(log_scales=np.full((1, 3), v, np.float32)) for v in (a, b)))

    found = float(frames.at(t).log_scales[0, 0])

    exact = (1 - MP.mpf(t)) * MP.mpf(a) + MP.mpf(t) * MP.mpf(b)
    assert abs(MP.mpf(found) - exact) <= HALF_STEP * abs(exact) + (abs(a) + abs(b)) * 2.0**-50


# -- ends of the quantizers


def test_halves__round_at_their_ends_as_the_standard_says() -> None:
    from gsplat_tools.kernels.half_floats import round_to_half

    ends = [65504.0, 65519.996, 65520.0, 2.0**-24, 2.0**-25, 2.0**-25 * (1 + 2**-20), 6.1e-5, 2.0**-14, 0.0, 1e-45]
    values = np.array([*ends, *(-np.array(ends))], np.float32)

    found = np.array([round_to_half(value) for value in values], np.float32)

    with np.errstate(over="ignore"):
        expected = values.astype(np.float16).astype(np.float32)
    assert np.array_equal(found.view(np.uint32), expected.view(np.uint32))
    assert found[1] == 65504
    assert found[2] == np.inf
    assert found[4] == 0
    assert np.signbit(found[18])


@pytest.mark.parametrize("format_id", ["ply", "uncompressed"])
def test_lossless_positions__keep_every_bit(format_id: str) -> None:
    import io

    from gsplat_tools.formats.registry import FORMATS

    record = FORMATS[format_id]
    bits = np.array([0x80000000, 0, 1, 0x80000001, 0x007FFFFF, 0x00800000, 0x7F7FFFFF, 0xFF7FFFFF, 0x3F800001], np.uint32)
    cloud = random_cloud(3, sh_degree=0).replace(means=bits.view(np.float32).reshape(3, 3))
    stream = io.BytesIO()
    assert record.write is not None
    assert record.read is not None

    record.write(cloud, stream, record.write_options())
    stream.seek(0)
    decoded = record.read(stream, record.read_options())

    assert isinstance(decoded, GaussianCloud)
    assert np.array_equal(decoded.means.view(np.uint32).ravel(), bits)
