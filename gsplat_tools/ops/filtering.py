"""Drop splats: those with values that no splat may hold, and those too faint to matter. What was dropped is counted.

Legal: opacity logits of +-inf (opaque, absent) and log scales of -inf (flat). Invalid: NaN anywhere, a log scale of +inf,
infinity in anything else, and a quaternion that is zero. A splat is counted once, under its first cause in the order of
CAUSES.

Source: what viewers and converters of 3DGS files have settled on; infinite logits and flat axes come out of 8-bit codes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError, counts_in_words
from gsplat_tools.ops.visibility import Viewpoint, lit_pixels
from gsplat_tools.parallel import run_blocks

# Which infinities are legal, as kernels.validity numbers them; that module is imported where it runs.
_REFUSES_INFINITY, _ALLOWS_NEGATIVE_INFINITY, _ALLOWS_INFINITY = 0, 1, 2
_POLICIES = {"log_scales": _ALLOWS_NEGATIVE_INFINITY, "opacity_logits": _ALLOWS_INFINITY}

_ORDER = ("means", "log_scales", "quats", "opacity_logits", "sh0", "shN", "velocities", "times", "durations")

CAUSES: tuple[str, ...] = tuple(
    f"{name}-{kind}"
    for name in _ORDER
    for kind in (("nan", "inf", "zero") if name == "quats" else ("nan",) if name == "opacity_logits" else ("nan", "inf"))
)
"""Names of the causes, first to last."""

_CODES = {cause: code for code, cause in enumerate(CAUSES, start=1)}


def classify_invalid(cloud: GaussianCloud) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Find the splats with values that no splat may hold.

    Parameters
    ----------
    cloud
        N Gaussians.

    Returns
    -------
    tuple
        keeps (N,) bool, true for valid splats · the number of invalid splats per cause, without zeros, in the order of
        CAUSES.
    """
    codes = invalid_codes(cloud)
    return (np.ones(len(cloud), np.bool_), {}) if codes is None else (codes == 0, count_causes(codes))


def count_causes(codes: NDArray[np.uint8]) -> dict[str, int]:
    """Return the number of splats per cause, without zeros, in the order of CAUSES."""
    counts = np.bincount(codes, minlength=len(CAUSES) + 1)[1:]
    return {cause: int(count) for cause, count in zip(CAUSES, counts, strict=True) if count}


def locate_invalid(cloud: GaussianCloud) -> dict[str, tuple[int, int]]:
    """Return (number of splats, index of the first) per cause, in the order of CAUSES; empty where all are valid."""
    codes = invalid_codes(cloud)
    if codes is None:
        return {}
    found = {cause: codes == code for cause, code in _CODES.items()}
    return {cause: (int(np.count_nonzero(mask)), int(np.argmax(mask))) for cause, mask in found.items() if mask.any()}


def drop_invalid(cloud: GaussianCloud) -> tuple[GaussianCloud, dict[str, int]]:
    """Return the valid splats and the number of others per cause; the same cloud where all are valid."""
    keeps, dropped = classify_invalid(cloud)
    return (cloud.take(keeps), dropped) if dropped else (cloud, dropped)


def refuse_invalid(cloud: GaussianCloud) -> None:
    """Let a cloud pass that has no invalid splats.

    Raises
    ------
    CloudError
        There are invalid splats; the message gives the counts per cause and the index of the first.
    """
    keeps, dropped = classify_invalid(cloud)
    if dropped:
        causes = counts_in_words(dropped)
        raise CloudError(
            f"{sum(dropped.values())} of {len(cloud)} splats are invalid: {causes}; the first is splat {int(np.argmin(keeps))}"
            "; repair them, or leave out --strict to drop them",
            field=next(iter(dropped)).rsplit("-", 1)[0],
        )


def prune_opacity(cloud: GaussianCloud, threshold: float) -> tuple[GaussianCloud, int]:
    """Drop splats that are too faint.

    Parameters
    ----------
    cloud
        N Gaussians.
    threshold
        Opacity in [0, 1]; splats below it are dropped. 0 drops nothing.

    Returns
    -------
    tuple
        The other splats, the same cloud where none is dropped · the number of those dropped. NaN is not below anything.

    Raises
    ------
    ValueError
        The threshold is not in [0, 1].
    """
    if not 0 <= threshold <= 1:
        raise ValueError(f"the opacity threshold must be in [0, 1], got {threshold}")
    if threshold == 0 or len(cloud) == 0:
        return cloud, 0
    from gsplat_tools.attributes.activations import sigmoid

    is_faint = sigmoid(cloud.opacity_logits) < threshold
    count = int(np.count_nonzero(is_faint))
    return (cloud.take(~is_faint), count) if count else (cloud, 0)


def prune_faint(cloud: GaussianCloud, threshold: float, view: Viewpoint) -> tuple[GaussianCloud, int]:
    """Drop splats that hardly show.

    Parameters
    ----------
    cloud
        N valid Gaussians.
    threshold
        Lit pixels (`ops.visibility.lit_pixels`); splats below are dropped.
    view
        From where the scene is looked at.

    Returns
    -------
    tuple
        The other splats, the same cloud where none is dropped · the number of those dropped.
    """
    is_faint = lit_pixels(cloud, view) < threshold
    count = int(np.count_nonzero(is_faint))
    return (cloud.take(~is_faint), count) if count else (cloud, 0)


def invalid_codes(cloud: GaussianCloud) -> NDArray[np.uint8] | None:
    """Return the code of each splat's first cause, 0 for valid ones; None where all are valid."""
    if len(cloud) == 0:
        return None
    from gsplat_tools.kernels import validity

    arrays = cloud.arrays()
    bits = {name: arrays[name].view(np.uint32).reshape(len(cloud), -1) for name in _ORDER if name in arrays}
    codes = np.zeros(len(cloud), np.uint8)

    def mark(start: int, stop: int) -> None:
        for name, values in bits.items():
            part = values[start:stop]
            if validity.has_nonfinite(part.reshape(-1)):
                nan_code = _CODES[f"{name}-nan"]
                inf_code = _CODES.get(f"{name}-inf", 0)
                validity.mark_nonfinite(part, _POLICIES.get(name, _REFUSES_INFINITY), nan_code, inf_code, codes[start:stop])
            if name == "quats" and validity.has_zero_rows(part):
                validity.mark_zero_rows(part, _CODES["quats-zero"], codes[start:stop])

    run_blocks(mark, len(cloud))
    return codes if codes.any() else None
