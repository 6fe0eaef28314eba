from __future__ import annotations

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.ops.harmonics import count_dropped, effective_sh_degree, with_sh_degree

RESTS = (0, 3, 8, 15, 24)


def _cloud(degree: int, count: int = 4) -> GaussianCloud:
    rng = np.random.default_rng(degree)
    return GaussianCloud(
        means=np.zeros((count, 3)),
        log_scales=np.zeros((count, 3)),
        quats=np.ones((count, 4)),
        opacity_logits=np.zeros(count),
        sh0=np.zeros((count, 3)),
        shN=rng.normal(size=(count, RESTS[degree], 3)),
    )


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("target", range(5))
def test_with_sh_degree__keeps_the_bands_both_have(degree: int, target: int) -> None:
    cloud = _cloud(degree)

    found = with_sh_degree(cloud, target)

    shared = min(RESTS[degree], RESTS[target])
    assert found.sh_degree == target
    np.testing.assert_array_equal(found.shN[:, :shared], cloud.shN[:, :shared])
    assert not found.shN[:, shared:].any()


def test_with_sh_degree__refuses_degree_5() -> None:
    with pytest.raises(ValueError, match="0 to 4"):
        with_sh_degree(_cloud(1), 5)


@pytest.mark.parametrize("degree", range(5))
def test_effective_sh_degree__sees_through_zero_bands(degree: int) -> None:
    assert effective_sh_degree(with_sh_degree(_cloud(degree), 4)) == degree


def test_effective_sh_degree__finds_a_single_last_coefficient() -> None:
    shN = np.zeros((4, 24, 3))
    shN[2, 23, 1] = 1e-30

    assert effective_sh_degree(_cloud(0).replace(shN=shN)) == 4


def test_count_dropped__counts_splats_by_band() -> None:
    shN = np.zeros((4, 15, 3))
    shN[0, 2] = 1
    shN[:2, 5, 0] = 1
    shN[:3, 9] = np.nan
    cloud = _cloud(0).replace(shN=shN)

    assert count_dropped(cloud, 0) == {1: 1, 2: 2, 3: 3}
    assert count_dropped(cloud, 2) == {3: 3}
    assert count_dropped(cloud, 3) == {}
