"""The bundled scene is what its script makes, and has the traits that it is there for."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from gsplat_tools.attributes.activations import sigmoid
from gsplat_tools.constants import SH_C0
from gsplat_tools.formats import load

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def garden():
    return load(ROOT / "fixtures" / "garden.ply", strict=True)


def test_garden__is_what_the_script_makes(garden):
    spec = importlib.util.spec_from_file_location("make_fixtures", ROOT / "tools" / "make_fixtures.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    made = script.make_garden()

    assert len(made) == len(garden)
    assert made.coordinate_system == garden.coordinate_system == "RDF"
    for name, values in garden.arrays().items():
        # Two units of the rounding to 16 bits, for machines whose sine differs.
        np.testing.assert_allclose(made.arrays()[name], values, rtol=2.0**-14, atol=2.0**-20, err_msg=name)


def test_garden__has_the_traits_of_a_trained_scene(garden):
    scales = np.exp(garden.log_scales.astype(np.float64))
    opacities = sigmoid(garden.opacity_logits)
    lengths = np.linalg.norm(garden.quats, axis=1)
    aspects = scales.max(axis=1) / scales.min(axis=1)
    colors = garden.sh0 * SH_C0 + 0.5

    assert garden.sh_degree == 3
    assert (ROOT / "fixtures" / "garden.ply").stat().st_size < 1_100_000
    assert scales.min() < 1.1e-4
    assert scales.max() > 0.8
    assert aspects.max() > 90
    assert np.count_nonzero(aspects > 20) > 500
    assert opacities.min() < 0.01
    assert opacities.max() > 0.995
    assert lengths.min() < 0.6
    assert lengths.max() > 1.9
    assert colors.max() > 1
    for band in (slice(0, 3), slice(3, 8), slice(8, 15)):
        assert np.abs(garden.shN[:, band]).max() > 0.25
