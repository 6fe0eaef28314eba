"""One frame to codes: a pure function of the frame, what is shared, and the labels before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.formats.sog4d.codebooks import DEFAULT_ROTATION_STEPS, Shared, scale_coordinates, turned
from gsplat_tools.formats.sog4d.labels import Labels
from gsplat_tools.formats.sog4d.textures import index_columns
from gsplat_tools.ops.visibility import MOST, VisibleCosts

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class FramePlanes:
    """One frame, or a piece of one, as codes.

    Parameters
    ----------
    columns
        (N, 2 to 4) the first bytes of every splat's pixel by stream name, labels included; see `textures.rgba_image`.
    range_min, range_max
        (3,) range of the positions.
    labels
        Scale indices under "scale", SH labels under the palette's name; the next frame of the segment starts from them.
    clipped
        Values that the sh0 codebook cannot reach, by what happened to them.
    """

    columns: dict[str, NDArray[np.uint8]]
    range_min: Float32
    range_max: Float32
    labels: dict[str, Labels]
    clipped: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Previous:
    """The frame before in the same segment, and the labels that it got."""

    cloud: GaussianCloud
    labels: dict[str, Labels]


def encode_frame(
    cloud: GaussianCloud,
    shared: Shared,
    previous: Previous | None = None,
    *,
    ends: tuple[Float32, Float32] | None = None,
) -> FramePlanes:
    """Quantize one frame, or a piece of one.

    Parameters
    ----------
    cloud
        The frame, splats in the order of the bundle.
    shared
        Codebooks, palettes and options of the bundle.
    previous
        The frame before in the same segment; None starts a segment. The result depends on its labels alone: splats that
        have not changed keep theirs without a search.
    ends
        (3,) least and largest position of the whole frame, for a piece of one. Pieces of a multiple of
        `parallel.BLOCK_SIZE` splats have the codes that they have in the whole, if there is no tolerance.
    """
    from gsplat_tools.codecs.scalar_codebook import nearest_entry

    low, high = (cloud.means.min(axis=0), cloud.means.max(axis=0)) if ends is None else ends
    codes = position_codes(cloud.means, low, high)
    quats, log_scales = turned(cloud, shared.rotation_frames)
    rotations = rotation_bytes(quats, shared)
    colors = np.empty((len(cloud), 4), np.uint8)
    colors[:, :3] = nearest_entry(cloud.sh0, shared.sh0_codebook)
    colors[:, 3] = opacity_bytes(cloud.opacity_logits)
    costs = None if shared.tolerance is None else shared.tolerance.costs(cloud, log_scales)
    if costs is not None:
        codes, rotations, colors = relaxed(cloud, quats, shared, costs, (codes, rotations, colors), (low, high))
    labels: dict[str, Labels] = {}
    labels["scale"] = choose_labels(
        scale_coordinates(log_scales),
        shared.scale_points,
        shared.options.keep_tolerance * shared.scale_error,
        None if previous is None else previous.labels["scale"],
        None if previous is None else (cloud.log_scales == previous.cloud.log_scales).all(axis=1),
        None if costs is None else costs.scale,
        moves=False,
    )
    columns = {
        "position_hi": (codes >> 8).astype(np.uint8),
        "position_lo": (codes & 0xFF).astype(np.uint8),
        "scale_indices": index_columns(labels["scale"]),
        "rotation": rotations,
        "sh0": colors,
    }
    for palette in shared.palettes:
        rows = palette.rows(cloud.shN)
        labels[palette.name] = choose_labels(
            rows,
            palette.centroids,
            shared.options.keep_tolerance * palette.error,
            None if previous is None else previous.labels[palette.name],
            None if previous is None else (rows == palette.rows(previous.cloud.shN)).all(axis=1),
            None if costs is None else costs.harmonics,
            pilot=None if shared.pilot is None else palette.rows(shared.pilot),
        )
        columns[f"{palette.name}_labels"] = index_columns(labels[palette.name])
    outside = (cloud.sh0 < shared.sh0_codebook[0]) | (cloud.sh0 > shared.sh0_codebook[-1])
    clipped = {"sh0": int(outside.any(axis=1).sum())} if outside.any() else {}
    return FramePlanes(columns, low, high, labels, clipped)


def relaxed(
    cloud: GaussianCloud,
    quats: Float32,
    shared: Shared,
    costs: VisibleCosts,
    plain: tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint8]],
    ends: tuple[Float32, Float32],
) -> tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return codes of positions, rotations and colors that compress better, or the plain ones where they do not."""
    from gsplat_tools.formats._relaxing import relaxed_colors, smaller
    from gsplat_tools.formats.sog4d import relaxing

    layout = (shared.width, shared.height)
    codes, rotations, colors = plain
    positions = relaxing.positions(cloud.means, *ends, codes, costs)
    codes = smaller(positions, codes, layout)
    if shared.options.rotation != "reference":
        rotations = smaller(relaxing.rotations(quats, shared.is_long, rotations, costs), rotations, layout)
    colors = smaller(relaxed_colors(cloud, shared.sh0_codebook, colors, costs), colors, layout)
    return codes, rotations, colors


def position_codes(means: Float32, low: Float32, high: Float32) -> NDArray[np.uint16]:
    """Return round((x - min) / (max - min) 65535), 0 on a flat axis."""
    span = high.astype(np.float64) - low
    steps = 65535 / np.where(span > 0, span, 1.0)
    return np.rint((means - low.astype(np.float64)) * steps).astype(np.uint16)


def rotation_bytes(quats: Float32, shared: Shared) -> NDArray[np.uint8]:
    """Return the bytes w x y z of quaternions in the frames that were chosen."""
    from gsplat_tools.codecs import quaternion_u8

    mode = shared.options.rotation
    if mode != "small":
        return quaternion_u8.encode(quats, mode=mode)
    codes = quaternion_u8.encode_constant_w(quats, shared.options.rotation_steps or DEFAULT_ROTATION_STEPS)
    if shared.is_long is not None:
        codes[shared.is_long] = quaternion_u8.encode(quats[shared.is_long], mode="best")
    return codes


def opacity_bytes(logits: Float32) -> NDArray[np.uint8]:
    """Return the opacity in 255ths, rounded."""
    from gsplat_tools.attributes.activations import sigmoid

    return np.rint(sigmoid(logits.astype(np.float64)) * 255).astype(np.uint8)


def choose_labels(
    points: Float32,
    centroids: Float32,
    tolerance: float,
    previous: Labels | None,
    is_unchanged: NDArray[np.bool_] | None = None,
    costs: NDArray[np.float64] | None = None,
    *,
    moves: bool = True,
    pilot: Float32 | None = None,
) -> Labels:
    """Return the nearest entry of every splat, or the one it had where that adds at most `tolerance` to the square error.

    With costs, the one it had also where the difference hardly shows, and where it had none a frequent entry (if `moves`).
    `pilot` as `nearest_labels` takes it.
    """
    from gsplat_tools.codecs.palette import nearest_labels

    if previous is None:
        nearest = nearest_labels(points, centroids, pilot=pilot)[0]
        if costs is not None and moves:
            from gsplat_tools.codecs.relaxation import relax_labels

            nearest = relax_labels(points, costs, centroids, nearest, most=MOST)
        return nearest.astype(np.uint16)
    chosen = previous.copy()
    rows = np.arange(len(points)) if is_unchanged is None else np.flatnonzero(~is_unchanged)
    if len(rows) == 0:
        return chosen
    moved = points[rows]
    labels, distances = nearest_labels(moved, centroids)
    offsets = moved - centroids[previous[rows]]
    allowed = np.full(len(rows), tolerance, np.float32)
    if costs is not None:
        allowed = np.maximum(allowed, (MOST / costs[rows]).astype(np.float32))
    keeps = np.einsum("nd,nd->n", offsets, offsets) <= distances + allowed
    chosen[rows] = np.where(keeps, previous[rows], labels)
    return chosen
