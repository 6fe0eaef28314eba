"""Bundle to lazy frames."""

from __future__ import annotations

import functools
import warnings
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import REST_COEFFICIENTS, GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats._issues import raise_errors
from gsplat_tools.formats.sog4d.bundle import Bundle
from gsplat_tools.formats.sog4d.meta import frame_path
from gsplat_tools.formats.sog4d.options import ShnOrder, Sog4dReadOptions
from gsplat_tools.formats.sog4d.piece import Piece
from gsplat_tools.formats.sog4d.rules import RULES
from gsplat_tools.formats.sog4d.textures import check_indices, indices_of, pixels_of
from gsplat_tools.parallel import map_ordered
from gsplat_tools.sequence import GaussianSequence

GENERATOR = "gsplat_tools"
"""Start of the field `generator` of bundles that this package wrote."""

Float32 = NDArray[np.float32]


def read(stream: BinaryIO, options: Sog4dReadOptions) -> GaussianSequence:
    """Open a bundle; its frames are decoded when they are asked for, so the stream has to stay open.

    Raises
    ------
    FormatError
        The bundle breaks a rule of docs/formats/sog4d.md; frames raise theirs when they are decoded.

    Warns
    -----
    GsplatWarning
        Legacy vectors, duplicate entries, or SH whose order may be scrambled.
    """
    bundle = Bundle(stream)
    meta = bundle.meta
    for issue in [*bundle.archive.issues, *bundle.issues]:
        place = "" if issue.field is None else f"{issue.field}: "
        warnings.warn(GsplatWarning(place + issue.message, code=issue.code), stacklevel=3)
    is_ours = (meta.generator or "").startswith(GENERATOR)
    if meta.bands > 0 and not is_ours and options.shn_order == "interleaved":
        warnings.warn(
            GsplatWarning(
                "this bundle is not from gsplat_tools: ply_sequence_to_sog4d.py scrambles SH; if its colors are wrong from the "
                "side, read it with --shn-order channel-major (library: shn_order='channel-major')",
                code="foreign-sh",
            ),
            stacklevel=3,
        )
    decoder = FrameDecoder(bundle, options.shn_order)
    low, high = meta.range_min.min(axis=0).astype(np.float64), meta.range_max.max(axis=0).astype(np.float64)
    return GaussianSequence(
        decoder.frame,
        num_splats=meta.splat_count,
        sh_degree=meta.bands,
        frame_times=meta.frame_times,
        num_frames=meta.frame_count,
        load_bounds=lambda: (low, high),
    )


class FrameDecoder:
    """Frames of a bundle as clouds; palettes and tables are read once."""

    def __init__(self, bundle: Bundle | Piece, shn_order: ShnOrder = "interleaved") -> None:
        self.bundle = bundle
        self._shn_order = shn_order

    @functools.cached_property
    def _centroids(self) -> list[Float32]:
        return [self.bundle.centroids(palette) for palette in self.bundle.meta.palettes]

    @functools.cached_property
    def _log_codebook(self) -> Float32:
        with np.errstate(divide="ignore"):
            return np.log(self.bundle.meta.scale_codebook.astype(np.float64)).astype(np.float32)

    def frame(self, frame: int) -> GaussianCloud:
        """Return the stored values of a frame.

        Raises
        ------
        FormatError
            An image, an index or a label breaks a rule.
        """
        from gsplat_tools.codecs import quaternion_u8

        meta = self.bundle.meta
        paths = meta.stream_paths()
        names = ("position_hi", "position_lo", "scale_indices", "rotation", "sh0")
        images = dict(
            zip(names, map_ordered(lambda name: self.bundle.image(frame_path(paths[name], frame), frame), names), strict=True)
        )
        count = meta.splat_count
        low_bytes, high_bytes = (pixels_of(images[name], count)[:, :3] for name in ("position_lo", "position_hi"))
        indices = indices_of(images["scale_indices"], count)
        path = frame_path(meta.scale_indices_path, frame)
        raise_errors(check_indices("index-range", indices, len(meta.scale_codebook), "scale index", path, frame), RULES)
        colors = pixels_of(images["sh0"], count)
        return GaussianCloud(
            means=positions(low_bytes, high_bytes, meta.range_min[frame], meta.range_max[frame]),
            log_scales=self._log_codebook[indices],
            quats=quaternion_u8.decode(pixels_of(images["rotation"], count)),
            opacity_logits=OPACITY_LOGITS[colors[:, 3]],
            sh0=meta.sh0_codebook[colors[:, :3]],
            shN=self._rest(frame),
        )

    def _rest(self, frame: int) -> Float32:
        """Return the SH coefficients above the constant term."""
        meta = self.bundle.meta
        parts = [
            centroids[self.bundle.labels(palette, frame)]
            for palette, centroids in zip(meta.palettes, self._centroids, strict=True)
        ]
        if not parts:
            return np.empty((meta.splat_count, 0, 3), np.float32)
        rest = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        if self._shn_order == "channel-major":
            return rest.reshape(len(rest), 3, REST_COEFFICIENTS[meta.bands]).transpose(0, 2, 1)
        return rest


def positions(low_bytes: NDArray[np.uint8], high_bytes: NDArray[np.uint8], low: Float32, high: Float32) -> Float32:
    """Return positions from the two bytes of each coordinate: min + q / 65535 (max - min), rounded once."""
    codes = low_bytes | high_bytes.astype(np.uint16) << 8
    span = high.astype(np.float64) - low
    return (low + codes * (span / 65535)).astype(np.float32)


def _opacity_logits() -> Float32:
    """Return the logit of each opacity byte: -inf at 0, +inf at 255."""
    opacities = np.arange(256) / 255
    with np.errstate(divide="ignore"):
        return (np.log(opacities) - np.log1p(-opacities)).astype(np.float32)


OPACITY_LOGITS = _opacity_logits()
