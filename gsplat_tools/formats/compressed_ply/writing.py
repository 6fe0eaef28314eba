"""Clouds to elements, binary little-endian."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.codecs.smallest_three import PACKED_PLY, Rotation, choose_frames, in_frames
from gsplat_tools.errors import CapabilityError, CloudError, LossyConversionWarning
from gsplat_tools.formats._ply_comments import comment_lines
from gsplat_tools.formats.base import Scene
from gsplat_tools.formats.compressed_ply.reading import BLOCK, BOUNDS, WORDS
from gsplat_tools.parallel import BLOCK_SIZE, blocks, run_blocks
from gsplat_tools.sequence import GaussianSequence

assert BLOCK_SIZE % BLOCK == 0


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressedPlyOptions:
    """Choices of the writer.

    Parameters
    ----------
    rotation
        Frame of each splat: "reference" as the format's own encoder; "best" brings the longest axis first and the
        shortest second in every block where that errs less, because boxes of sorted axes are narrow; "small" the frame
        with the smallest turn.
    """

    rotation: Rotation = "best"


def write(scene: Scene, stream: BinaryIO, options: CompressedPlyOptions) -> None:
    """Write a cloud of SH degree 0 to 3; neighbors in its order share a box, so that a spatial order is more exact.

    Raises
    ------
    CapabilityError
        The scene is a sequence.
    CloudError
        A position or quaternion is not finite, or a value is not a number.

    Warns
    -----
    LossyConversionWarning
        Scales or SH values were clamped, with counts.
    """
    from gsplat_tools.kernels import compressed_ply, smallest_three

    if isinstance(scene, GaussianSequence):
        raise CapabilityError("a compressed.ply file holds one moment; choose one with --time or --frame")
    cloud = scene if isinstance(scene, GaussianCloud) else as_chunks(scene).read()
    _check(cloud)
    count = len(cloud)
    quats, log_scales = in_frames(cloud.quats, cloud.log_scales, _frames(cloud, options.rotation))
    bounds = np.empty((-(-count // BLOCK), len(BOUNDS)), np.float32)
    words = np.empty((count, len(WORDS)), np.uint32)
    codes = np.empty((count, 3 * cloud.shN.shape[1]), np.uint8)
    counts = np.zeros((len(blocks(count)), compressed_ply.NUM_COUNTS), np.int64)

    def encode(start: int, stop: int) -> None:
        part = slice(start, stop)
        boxes = bounds[start // BLOCK : -(-stop // BLOCK)]
        found = counts[start // BLOCK_SIZE]
        rotations = np.empty(stop - start, np.uint32)
        smallest_three.pack_unsigned(quats[part], rotations)
        arrays = cloud.means[part], log_scales[part], cloud.opacity_logits[part], cloud.sh0[part]
        compressed_ply.encode_blocks(*arrays, rotations, boxes, words[part], found)
        if cloud.sh_degree:
            compressed_ply.encode_sh(cloud.shN[part], codes[part], found)

    run_blocks(encode, count)
    total = counts.sum(axis=0)
    if total[compressed_ply.INVALID]:
        raise CloudError(
            f"{total[compressed_ply.INVALID]} values of scale, opacity, color or SH are not numbers; drop those splats first"
        )
    stream.write(_header(cloud))
    stream.write(bounds.astype("<f4", copy=False).data)
    stream.write(words.astype("<u4", copy=False).data)
    stream.write(codes.data)
    clamped = {
        f"scale axes outside e^{-compressed_ply.MAX_LOG_SCALE:g}..e^{compressed_ply.MAX_LOG_SCALE:g}": compressed_ply.SCALES,
        "SH values outside -4..4": compressed_ply.SH,
    }
    parts = [f"{total[place]} {what}" for what, place in clamped.items() if total[place]]
    if parts:
        warnings.warn(LossyConversionWarning(f"clamped: {', '.join(parts)}", code="clamped"), stacklevel=2)


def _frames(cloud: GaussianCloud, rotation: Rotation) -> NDArray[np.uint8]:
    """Return the frame of every splat, or none where all keep theirs."""
    from gsplat_tools.kernels import compressed_ply, rotation_frames, smallest_three

    if rotation != "best":
        return choose_frames(cloud.quats, cloud.log_scales, PACKED_PLY, rotation)
    frames = np.empty(len(cloud), np.uint8)

    def choose(start: int, stop: int) -> None:
        part = slice(start, stop)
        num_blocks = -(-(stop - start) // BLOCK)
        quats, log_scales = cloud.quats[part], cloud.log_scales[part]
        smallest_three.sorted_frames(quats, log_scales, frames[part])
        turned, relabelled = np.empty_like(quats), np.empty_like(log_scales)
        rotation_frames.apply_frames(quats, log_scales, frames[part], turned, relabelled)
        errors = np.empty((2, num_blocks))
        compressed_ply.block_errors(quats, log_scales, errors[0])
        compressed_ply.block_errors(turned, relabelled, errors[1])
        keeps = np.repeat(errors[0] <= errors[1], BLOCK)[: stop - start]
        frames[part][keeps] = 0

    run_blocks(choose, len(cloud))
    return frames


def _check(cloud: GaussianCloud) -> None:
    """Refuse positions and quaternions that are not finite."""
    for name in ("means", "quats"):
        values = getattr(cloud, name)
        if not np.isfinite(values).all():
            bad = int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
            raise CloudError(f"{bad} splats have values that are not finite; drop them first", field=name)


def _header(cloud: GaussianCloud) -> bytes:
    """Return the header; the metadata stands in comments."""
    count = len(cloud)
    lines = ["ply", "format binary_little_endian 1.0", *comment_lines(cloud)]
    lines += [f"element chunk {-(-count // BLOCK)}", *[f"property float {name}" for name in BOUNDS]]
    lines += [f"element vertex {count}", *[f"property uint {name}" for name in WORDS]]
    if cloud.sh_degree:
        lines += [f"element sh {count}", *[f"property uchar f_rest_{i}" for i in range(3 * cloud.shN.shape[1])]]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
