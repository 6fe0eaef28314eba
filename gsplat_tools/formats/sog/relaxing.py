"""Bits where they show: codes moved to cheap neighbors, as far as the visual tolerance lets them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs import relaxation
from gsplat_tools.formats._relaxing import relaxed_colors, relaxed_indices, smaller
from gsplat_tools.formats._webp import Image
from gsplat_tools.ops.visibility import MOST, VisibleCosts

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


def relax(
    images: dict[str, Image],
    cloud: GaussianCloud,
    log_scales: Float32,
    costs: VisibleCosts,
    tables: tuple[Float32, Float32],
    ends: tuple[Float64, Float64],
    distances: Float64,
) -> None:
    """Change the images of positions, scales and colors in place; rotations stay.

    Parameters
    ----------
    images
        RGBA by stream name, filled with the nearest codes.
    cloud
        The splats.
    log_scales
        (N, 3) theirs, as axes are named in the file.
    costs
        What changes show.
    tables
        Codebooks of scales and of sh0.
    ends
        Ranges of the signed logarithms of positions.
    distances
        (N, 3) signed logarithms of positions.
    """
    count = len(cloud)
    pixels = {name: image.reshape(-1, 4)[:count] for name, image in images.items()}
    height, width = images["sh0"].shape[:2]
    plain = pixels["means_l"][:, :3].astype(np.uint16) | pixels["means_u"][:, :3].astype(np.uint16) << np.uint16(8)
    codes = plain.copy()
    for axis in range(3):
        step = (ends[1][axis] - ends[0][axis]) / 65535
        if step > 0:
            targets = np.clip((distances[:, axis] - ends[0][axis]) / step, 0, 65535)
            lengths = step * np.exp(np.abs(distances[:, axis]))  # world units a step
            codes[:, axis] = relaxation.relax_numbers(targets, costs.position * lengths**2, low=0, high=65535, most=MOST)
    codes = smaller(codes, plain, (width, height))
    pixels["means_l"][:, :3] = codes & 0xFF
    pixels["means_u"][:, :3] = codes >> 8
    indices = pixels["scales"][:, :3].copy()
    pixels["scales"][:, :3] = smaller(relaxed_indices(log_scales, costs.scale, tables[0], indices), indices, (width, height))
    colors = pixels["sh0"].copy()
    pixels["sh0"][:] = smaller(relaxed_colors(cloud, tables[1], colors, costs), colors, (width, height))
