"""The stages of `render`: projection, drawing order, tiles, composition; each calls kernels over fixed blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools import parallel
from gsplat_tools.reference import models
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.models import Model
from gsplat_tools.reference.motion import SceneState
from gsplat_tools.reference.sorting import drawing_keys, sort_pairs

_MAX_ENTRIES = 1 << 26
"""Entries of tile lists held at once, 256 MB; larger pictures are drawn in bands of tiles."""

_BINNING_BLOCKS = 32
_TILES_PER_TASK = 32


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Splats in image space, rows as in kernels/rules.py."""

    records: NDArray[Any]
    bounds: NDArray[np.int32]
    states: NDArray[np.uint8]


def project_scene(
    state: SceneState,
    camera: Camera,
    model: Model,
    numbers: NDArray[Any],
    choices: NDArray[np.int64],
    sh_degree: int | None,
) -> Projection:
    """Project all splats, block by block."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels.accumulator import EXTENDED, PACKED, requantize
    from gsplat_tools.kernels.projection import activate, project
    from gsplat_tools.kernels.sh_eval import evaluate_colors

    cloud, means = state.cloud, state.means
    count, dtype = len(cloud), means.dtype
    projection = Projection(
        records=np.empty((count, R.RECORD_SIZE), dtype),
        bounds=np.empty((count, 4), np.int32),
        states=np.empty(count, np.uint8),
    )
    # Splats become relative to the camera in float64: a scene far from zero is drawn like one about it.
    lens = models.lens_array(model, camera, camera.position, dtype)
    lens[[R.VIEW + 3, R.VIEW + 7, R.VIEW + 11]] = 0
    weights = np.empty(0, dtype) if state.weights is None else state.weights
    eye, center = camera.position - cloud.origin, np.zeros(3, dtype)
    degree = min(cloud.sh_degree, model.max_sh_degree, cloud.sh_degree if sh_degree is None else sh_degree)
    band_4_first = dtype.type(model.band_4_first)

    def project_block(start: int, stop: int) -> None:
        splats = np.empty((stop - start, R.SPLAT_SIZE), dtype)
        activate(means, eye, cloud.log_scales, cloud.quats, cloud.opacity_logits, weights, start, stop, splats)
        evaluate_colors(cloud.sh0, cloud.shN, center, degree, band_4_first, start, splats)
        if model.accumulator != "none":
            requantize(splats, center, PACKED if model.accumulator == "packed" else EXTENDED)
        project(splats, lens, numbers, choices, start, projection.records, projection.bounds, projection.states)

    parallel.run_blocks(project_block, count)
    return projection


def find_order(
    states: NDArray[np.uint8], state: SceneState, camera: Camera, model: Model, named: NDArray[np.uint32] | None
) -> NDArray[np.uint32]:
    """Return the indices of the splats that are drawn, in drawing order."""
    from gsplat_tools.kernels import rules as R

    is_drawn = (states & ~np.uint8(R.EIGENVECTOR_UNDEFINED)) == R.DRAWN
    if state.is_visible is not None:
        is_drawn &= state.is_visible
    if named is not None:
        drawn = named[is_drawn[named]]
        return np.ascontiguousarray(drawn[::-1]) if model.front_to_back else drawn
    indices = np.flatnonzero(is_drawn).astype(np.uint32)
    keys = drawing_keys(state, camera, metric=model.metric, far_first=not model.front_to_back)
    return sort_pairs(keys[indices], indices)[1]


def draw_splats(
    projection: Projection,
    drawing: NDArray[np.uint32],
    camera: Camera,
    numbers: NDArray[Any],
    choices: NDArray[np.int64],
    backdrop: NDArray[np.float64],
) -> NDArray[Any]:
    """Bin the splats to tiles and draw them; return the planes transmittance, red, green, blue, padded to whole tiles."""
    from gsplat_tools.kernels import rules as R
    from gsplat_tools.kernels.tile_binning import TILE_HEIGHT, TILE_WIDTH, count_tiles

    tiles_x, tiles_y = -(-camera.width // TILE_WIDTH), -(-camera.height // TILE_HEIGHT)
    num_tiles = tiles_x * tiles_y
    planes = np.zeros((4, tiles_y * TILE_HEIGHT, tiles_x * TILE_WIDTH), numbers.dtype)
    # Pixels of the padding start finished, so that tiles at the rim can end early.
    planes[0, : camera.height, : camera.width] = 1
    if not choices[R.IS_FRONT_TO_BACK]:
        planes[1:] = backdrop[:, None, None]
    block = max(parallel.BLOCK_SIZE, -(-len(drawing) // _BINNING_BLOCKS))
    counts = np.zeros((max(1, len(parallel.blocks(len(drawing), block))), num_tiles), np.int64)
    records, bounds = projection.records, projection.bounds
    parallel.run_blocks(
        lambda start, stop: count_tiles(drawing, records, bounds, tiles_x, start, stop, counts[start // block]),
        len(drawing),
        block,
    )
    offsets = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    positions = np.cumsum(counts, axis=0) - counts + offsets[:-1]
    for first, last in _bands(offsets):
        _draw_band(first, last, projection, drawing, block, offsets, positions, numbers, choices, planes)
    return planes


def _draw_band(
    first: int,
    last: int,
    projection: Projection,
    drawing: NDArray[np.uint32],
    block: int,
    offsets: NDArray[np.int64],
    positions: NDArray[np.int64],
    numbers: NDArray[Any],
    choices: NDArray[np.int64],
    planes: NDArray[Any],
) -> None:
    """Fill the lists of the tiles first .. last - 1 and draw them."""
    from gsplat_tools.kernels.blending import blend_tiles
    from gsplat_tools.kernels.tile_binning import TILE_WIDTH, scatter_tiles

    records, bounds = projection.records, projection.bounds
    tiles_x = planes.shape[2] // TILE_WIDTH
    lists = np.empty(offsets[last] - offsets[first], np.uint32)
    places = positions - offsets[first]
    parallel.run_blocks(
        lambda start, stop: scatter_tiles(
            drawing, records, bounds, tiles_x, start, stop, first, last, places[start // block], lists
        ),
        len(drawing),
        block,
    )
    parallel.run_blocks(
        lambda start, stop: blend_tiles(
            records, bounds, lists, offsets, first, first + start, first + stop, numbers, choices, planes
        ),
        last - first,
        _TILES_PER_TASK,
    )


def _bands(offsets: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return ranges of tiles whose lists stay within the limit, one tile at least."""
    bands, first = [], 0
    while first < len(offsets) - 1:
        last = int(np.searchsorted(offsets, offsets[first] + _MAX_ENTRIES, side="right")) - 1
        last = min(max(last, first + 1), len(offsets) - 1)
        bands.append((first, last))
        first = last
    return bands


def compose_image(
    planes: NDArray[Any], camera: Camera, model: Model, backdrop: NDArray[np.float64], *, quantizes: bool
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return image and alphas without the padding."""
    inside = planes[:, : camera.height, : camera.width]
    transmittance = np.abs(inside[0])
    image = np.ascontiguousarray(np.moveaxis(inside[1:], 0, 2))
    alphas = 1 - transmittance
    if model.front_to_back:
        if backdrop.any():
            image += transmittance[:, :, None] * backdrop.astype(planes.dtype)
        if quantizes:
            image, alphas = (np.rint(np.clip(values, 0, 1) * 255) / 255 for values in (image, alphas))
    return image.astype(planes.dtype, copy=False), alphas.astype(planes.dtype, copy=False)
