"""Codebooks of numbers are optimal, ascending, and span the data."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsplat_tools.codecs.scalar_codebook import fit_codebook, nearest_entry
from tests.oracles.clustering import best_cuts, nearest

FLOATS = st.floats(-100, 100, width=32)


@given(values=st.lists(FLOATS, min_size=2, max_size=11, unique=True), size=st.integers(2, 4))
def test_fit__without_guarded_ends_is_the_optimum(values: list[float], size: int) -> None:
    values = sorted(values)
    weights = np.linspace(1, 3, len(values)).astype(np.float32)

    codebook = fit_codebook(np.float32(values), weights, size=size, spans=False)

    if len(values) > size:
        error = (weights * (np.float32(values) - codebook[nearest_entry(np.float32(values), codebook)]) ** 2).sum()
        assert error <= best_cuts(values, weights, size) * 1.0001 + 1e-6


@given(values=st.lists(FLOATS, min_size=1, max_size=60), size=st.integers(2, 16))
def test_fit__is_ascending_and_holds_the_ends(values: list[float], size: int) -> None:
    codebook = fit_codebook(np.float32(values), size=size)

    assert len(codebook) == size
    assert (np.diff(codebook) >= 0).all()
    assert codebook[0] == np.float32(min(values))
    assert codebook[-1] == np.float32(max(values))


def test_fit__holds_few_values_exactly() -> None:
    values = np.float32([3, -1, 3, 7, -1])

    assert fit_codebook(values, size=5).tolist() == [-1, 3, 7, 7, 7]


def test_fit__of_a_normal_distribution_reaches_the_known_error() -> None:
    values = np.random.default_rng(0).normal(size=200_000).astype(np.float32)

    codebook = fit_codebook(values, size=16, spans=False)

    # Max 1960, Quantizing for minimum distortion: 16 levels leave 0.009497 of the variance.
    error = np.mean((values - codebook[nearest_entry(values, codebook)]) ** 2)
    assert error == pytest.approx(0.009497, rel=0.02)


def test_fit__keeps_entries_where_weights_are_small() -> None:
    values = np.float32([*np.linspace(0, 1, 5000), *np.linspace(-5, -4, 50)])
    weights = np.float32([1.0] * 5000 + [1e-4] * 50)

    codebook = fit_codebook(values, weights)

    assert codebook[0] == np.float32(-5)
    assert np.abs(values - codebook[nearest_entry(values, codebook)]).max() <= 1.0


def test_fit__survives_far_outliers() -> None:
    values = np.float32([*np.random.default_rng(1).normal(size=5000), 1e6, -1e6])

    codebook = fit_codebook(values)

    inner = values[:-2]
    assert np.abs(inner - codebook[nearest_entry(inner, codebook)]).mean() < 0.02


@given(values=st.lists(FLOATS, min_size=1, max_size=30), codebook=st.lists(FLOATS, min_size=2, max_size=12))
def test_nearest_entry__is_no_farther_than_the_nearest(values: list[float], codebook: list[float]) -> None:
    entries = np.sort(np.float32(codebook))

    found = np.abs(entries[nearest_entry(np.float32(values), entries)].astype(float) - np.float32(values))

    _, squares = nearest(np.float32(values)[:, None], entries[:, None])
    assert (found <= np.sqrt(squares) + 1e-5 * (1 + np.abs(values))).all()


def test_fit__refuses_what_it_cannot_order() -> None:
    with pytest.raises(ValueError, match="finite"):
        fit_codebook(np.float32([0, np.nan]))
    with pytest.raises(ValueError, match="at least 2"):
        fit_codebook(np.float32([0]), size=1)
    assert fit_codebook(np.zeros(0, np.float32), size=3).tolist() == [0, 0, 0]
