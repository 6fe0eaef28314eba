"""SH far beyond colors: what half precision clamps is said, what no palette can be fitted to is refused."""

from __future__ import annotations

import dataclasses
import io
import warnings
from typing import Any

import numpy as np
import pytest

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, CorruptDataError, LossyConversionWarning
from gsplat_tools.formats._palettes import MAX_SH
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.numerics import measure_cloud
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud

PALETTES = ["sog", "sog4d", "splat4d"]


def scaled(size: float, count: int = 40) -> GaussianCloud:
    cloud = random_cloud(count, sh_degree=2)
    shN = cloud.shN / np.abs(cloud.shN).max() * np.float32(size)
    return cloud.replace(shN=shN.astype(np.float32), sh0=np.zeros_like(cloud.sh0))  # colors that bytes hold


def round_trip(cloud: GaussianCloud, format_id: str, **options: Any) -> GaussianCloud:
    record = FORMATS[format_id]
    assert record.write is not None
    assert record.read is not None
    stream = io.BytesIO()
    record.write(cloud, stream, record.write_options(**options))
    stream.seek(0)
    scene = record.read(stream, record.read_options())
    return scene.frame(0) if isinstance(scene, GaussianSequence) else scene


@pytest.mark.parametrize("format_id", PALETTES)
@pytest.mark.parametrize("size", [1e20, 3e38])
def test_harmonics_beyond_palettes__are_refused_with_a_remedy(format_id: str, size: float) -> None:
    # Squares left float32: eigenvalues that did not converge, indices out of bounds, files that their reader refused.
    with pytest.raises(CapabilityError, match=r"of 40 splats have SH .*--sh-degree 0") as caught:
        round_trip(scaled(size), format_id)
    assert caught.value.field == "shN"


@pytest.mark.parametrize("format_id", ["sog4d", "splat4d"])
@pytest.mark.parametrize("size", [1e5, MAX_SH])
def test_harmonics_beyond_halves__are_kept_as_float32(format_id: str, size: float) -> None:
    cloud = scaled(size)

    decoded = round_trip(cloud, format_id, centroids="f32")

    # As many entries as splats: what is left is the grid of entries.
    assert np.abs(decoded.shN - cloud.shN).max() < 0.02 * size


@pytest.mark.parametrize("format_id", ["sog4d", "splat4d"])
def test_harmonics_beyond_halves__are_clamped_with_a_warning(format_id: str) -> None:
    cloud = scaled(1e5)

    with pytest.warns(LossyConversionWarning, match=r"entries of the palette .* beyond 65504.*--centroids f32"):
        decoded = round_trip(cloud, format_id, centroids="f16")

    assert np.abs(decoded.shN).max() == 65504


def test_ordinary_harmonics__are_not_warned_about() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        round_trip(scaled(60000), "sog4d")


def test_frames_that_are_refused_when_they_are_read__make_a_refused_row() -> None:
    def frame(_index: int) -> GaussianCloud:
        raise CorruptDataError("expected finite numbers", field="x")

    record = dataclasses.replace(
        FORMATS["sog4d"], read=lambda _stream, _options: GaussianSequence(frame, num_splats=40, sh_degree=2, num_frames=1)
    )

    rows = measure_cloud(scaled(1.0), record)

    assert [row.note for row in rows] == ["refused: expected finite numbers"]
