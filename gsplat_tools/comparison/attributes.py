"""Errors per attribute, in spaces where two encodings of the same splat agree, against derived bounds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations, quaternions
from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError
from gsplat_tools.formats.base import Bounds


@dataclass(slots=True)
class AttributeStatistics:
    """Errors of one attribute, gathered over chunks.

    Parameters
    ----------
    count, max, sum, sum_squares
        Number of values, largest error, and sums for mean and rms.
    bound
        Largest finite bound that the encoding allows, or None where none is known beforehand.
    exceeded
        Values that are further off than their own bound.
    """

    count: int = 0
    max: float = 0.0
    sum: float = 0.0
    sum_squares: float = 0.0
    bound: float | None = None
    exceeded: int = 0

    def add(self, errors: NDArray[np.float64], bound: NDArray[Any] | None) -> None:
        """Take the errors of one more chunk into account."""
        if errors.size == 0:
            return
        self.count += errors.size
        self.max = max(self.max, float(errors.max()))
        self.sum += float(errors.sum())
        self.sum_squares += float(np.square(errors).sum())
        if bound is not None:
            self.bound = max(self.bound or 0.0, float(bound.max(initial=0.0, where=np.isfinite(bound))))
            self.exceeded += int(np.count_nonzero(~(errors <= bound)))

    def to_json(self) -> dict[str, float | int | None]:
        """Return max, mean, rms, bound and exceeded; numbers that are not finite become None."""
        count = max(self.count, 1)
        numbers = {
            "max": self.max,
            "mean": self.sum / count,
            "rms": float(np.sqrt(self.sum_squares / count)),
            "bound": self.bound,
        }
        finite = {name: None if value is None or not np.isfinite(value) else value for name, value in numbers.items()}
        return {**finite, "exceeded": self.exceeded if self.bound is not None else None}


def attribute_errors(reference: GaussianCloud, candidate: GaussianCloud) -> dict[str, NDArray[np.float64]]:
    """Return the distance of every value, in spaces where two encodings of the same splat agree.

    Parameters
    ----------
    reference, candidate
        Clouds of the same length and order.

    Returns
    -------
    dict
        means (N, 3) world units · scales (N, 3), each splat's log scales sorted, because relabeling the axes does not
        change a Gaussian · covariances (N,), Frobenius norm of the difference relative to the reference ·
        opacities (N,) · sh0 (N, 3) · shN (N, K - 1, 3), missing bands count as zero · and motion where both have it.

    Raises
    ------
    CloudError
        The lengths differ.
    """
    if len(reference) != len(candidate):
        raise CloudError(f"the reference has {len(reference)} splats, the candidate {len(candidate)}")
    shift = reference.origin - candidate.origin
    means = np.abs(reference.means.astype(np.float64) + shift - candidate.means)
    sorted_a, sorted_b = np.sort(reference.log_scales, axis=1), np.sort(candidate.log_scales, axis=1)
    with np.errstate(invalid="ignore"):
        scales = np.where(sorted_a == sorted_b, 0.0, np.abs(sorted_a.astype(np.float64) - sorted_b))
    # Sigmoids in float64: rounded to float32, they would differ by 6e-8 of their own.
    opacities = np.abs(np.subtract(*(activations.sigmoid(c.opacity_logits.astype(np.float64)) for c in (reference, candidate))))
    errors = {
        "means": means,
        "scales": scales,
        "covariances": _covariance_errors(reference, candidate),
        "opacities": opacities,
        "sh0": np.abs(reference.sh0.astype(np.float64) - candidate.sh0),
    }
    num_rest = max(reference.shN.shape[1], candidate.shN.shape[1])
    if num_rest:
        difference = np.zeros((len(reference), num_rest, 3))
        difference[:, : reference.shN.shape[1]] += reference.shN
        difference[:, : candidate.shN.shape[1]] -= candidate.shN
        errors["shN"] = np.abs(difference)
    if reference.has_motion and candidate.has_motion:
        for name in ("velocities", "times", "durations"):
            errors[name] = np.abs(getattr(reference, name).astype(np.float64) - getattr(candidate, name))
    return errors


def _covariance_errors(reference: GaussianCloud, candidate: GaussianCloud) -> NDArray[np.float64]:
    """Return ||Sigma' - Sigma|| / ||Sigma||, each in units of a longest axis so that nothing overflows; inf beyond float64."""
    own, others = (
        cloud.log_scales.max(axis=1, initial=-np.inf, keepdims=True).astype(np.float64) for cloud in (reference, candidate)
    )
    own = np.where(np.isfinite(own), own, 0.0)
    unit = np.maximum(own, others)

    def covariances(cloud: GaussianCloud, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        axes = quaternions.to_matrix(cloud.quats.astype(np.float64)) * np.exp(cloud.log_scales - unit)[:, None, :]
        return np.asarray(axes @ axes.transpose(0, 2, 1))

    difference = np.linalg.norm(covariances(candidate, unit) - covariances(reference, unit), axis=(1, 2))
    norms = np.linalg.norm(covariances(reference, own), axis=(1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        relative = difference / np.where(norms > 0, norms, 1.0) * np.exp(2 * (unit - own)[:, 0])
    # No extent at all became some: nothing to be relative to. No difference times infinity is none.
    return np.where(difference == 0, 0.0, np.where(norms > 0, relative, np.inf))


class AttributeTally:
    """Errors of all attributes, gathered chunk by chunk."""

    def __init__(self) -> None:
        self.attributes: dict[str, AttributeStatistics] = {}

    def add(self, reference: GaussianCloud, candidate: GaussianCloud, bounds: Bounds | None = None) -> None:
        """Take one more pair of chunks into account."""
        bounds = bounds or {}
        for name, errors in attribute_errors(reference, candidate).items():
            statistics = self.attributes.setdefault(name, AttributeStatistics())
            if name in bounds:
                statistics.add(errors, np.broadcast_to(np.asarray(bounds[name], np.float64), errors.shape))
            else:
                statistics.add(errors, None)

    def exceeded(self) -> list[str]:
        """Return one phrase for every attribute that leaves its bound."""
        return [
            f"{name}: {tally.exceeded} of {tally.count} values beyond their bound (largest error {tally.max:.6g}, "
            f"largest bound {tally.bound:.6g})"
            for name, tally in self.attributes.items()
            if tally.exceeded
        ]

    def to_json(self) -> dict[str, dict[str, float | int | None]]:
        """Return every attribute's errors."""
        return {name: tally.to_json() for name, tally in self.attributes.items()}


def paired(
    reference: GaussianCloud | CloudChunks, candidate: GaussianCloud | CloudChunks
) -> Iterator[tuple[GaussianCloud, GaussianCloud]]:
    """Yield pieces of both scenes that cover the same splats, however each is cut."""
    streams = iter(as_chunks(reference)), iter(as_chunks(candidate))
    left = next(streams[0], None), next(streams[1], None)
    a, b = left
    while a is not None and b is not None:
        count = min(len(a), len(b))
        yield a.take(slice(0, count)), b.take(slice(0, count))
        a = a.take(slice(count, None)) if count < len(a) else next(streams[0], None)
        b = b.take(slice(count, None)) if count < len(b) else next(streams[1], None)


def match_splats(reference: GaussianCloud, candidate: GaussianCloud) -> NDArray[np.intp] | slice | None:
    """Return which splat of the candidate stands for each of the reference, or None where that cannot be told.

    Notes
    -----
    Two orders are tried: that of the reference, and the Morton order that encoders give their splats. None where the
    counts differ or neither brings most splats near their counterparts.
    """
    from gsplat_tools.ops.ordering import splat_order

    if len(reference) != len(candidate) or len(reference) == 0:
        return None
    world = reference.means + (reference.origin - candidate.origin)
    tolerance = 1e-3 * (float(np.ptp(world, axis=0).max()) or 1.0)

    def is_near(order: slice | NDArray[Any]) -> bool:
        return bool(np.median(np.abs(world[order] - candidate.means).max(axis=1)) <= tolerance)

    if is_near(slice(None)):
        return slice(None)
    order = splat_order(reference, "morton")
    if is_near(order):
        matched = np.empty(len(order), np.intp)
        matched[order] = np.arange(len(order))
        return matched
    return None
