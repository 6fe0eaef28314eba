"""What a visual tolerance decides besides codes: codebooks and steps as fine as what they show is worth in bits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats.sog4d.rules import MAX_CODEBOOK
from gsplat_tools.ops.visibility import MOST, VisibleCosts

Float32 = NDArray[np.float32]

_ENTRY_BITS = 40.0
"""Of the text of a scale triple, deflated."""

_LARGEST_GROWTH = 4
"""Of the scale codebook: more entries are slow to fit and gain little."""

# Half the entries of a codebook, or half the steps, save a bit in each number and show four times as much. Rounding is no
# movement to common codes, so that the factors of `VisibleCosts` overstate it, and by how much was measured
# (docs/visual-tolerance.md): the next coarser choice costs more at equal bytes where the mean splat shows more than this.
_COLOR_BITS = 2.5
"""A channel."""
_ROTATION_BITS = 5.0
"""A splat."""

# Not far below what there is without a tolerance: there, errors of neighbors are alike and no longer average out.
_ENTRIES = (48, 64, 80, 96, 128)
_STEPS = (40, 48, 56, 64)

_PROBES = 20_000


def scale_size(entries: Float32, points: Float32, costs: VisibleCosts) -> int:
    """Return the size, at least that of a codebook, at which one more entry saves in what shows what it costs in bits.

    Parameters
    ----------
    entries
        (K, 3) of the codebook, as `scale_coordinates`.
    points
        (N, 3) splats, likewise.
    costs
        Of the N splats.

    Notes
    -----
    Between them, N splats pay log2 K bits each for their label and the text of K entries; what shows falls as 1 / K.
    """
    from gsplat_tools.codecs.palette import nearest_labels

    _, squares = nearest_labels(points, entries)
    shown = float(np.minimum(costs.scale * squares, MOST).sum())
    # The root of a K^2 + b K = shown x size: the derivatives balance.
    a, b = _ENTRY_BITS, len(points) / np.log(2)
    size = (np.sqrt(b * b + 4 * a * shown * len(entries)) - b) / (2 * a)
    return int(np.clip(size, len(entries), max(len(entries), min(_LARGEST_GROWTH * len(entries), MAX_CODEBOOK))))


def color_entries(fit: Callable[[int], Float32], sh0: Float32, costs: VisibleCosts) -> int:
    """Return the fewest entries of the color codebook whose rounding shows no more than it may.

    Parameters
    ----------
    fit
        Returns the codebook of so many entries, ascending.
    sh0
        (N, 3) colors.
    costs
        Of the N splats.
    """
    from gsplat_tools.codecs.scalar_codebook import nearest_entry

    rows = _probes(len(sh0))
    values, weights = sh0[rows], costs.color[rows, None]
    for count in _ENTRIES[:-1]:
        codebook = fit(count)
        errors = values.astype(np.float64) - codebook[nearest_entry(values, codebook)]
        if np.minimum(weights * np.square(errors), MOST).mean() <= _COLOR_BITS:
            return count
    return _ENTRIES[-1]


def rotation_steps(quats: Float32, costs: VisibleCosts) -> int:
    """Return the fewest steps of w whose rounding shows no more than it may.

    Parameters
    ----------
    quats
        (N, 4) wxyz, w the largest component, of any length.
    costs
        Of the N splats.
    """
    from gsplat_tools.attributes.quaternions import multiply, normalize
    from gsplat_tools.codecs import quaternion_u8

    rows = _probes(len(quats))
    unit = normalize(quats[rows].astype(np.float64))
    inverse = unit * np.array([1.0, -1.0, -1.0, -1.0])
    for steps in _STEPS[:-1]:
        stored = quaternion_u8.decode(quaternion_u8.encode_constant_w(quats[rows], steps))
        turns = 2 * multiply(inverse, stored.astype(np.float64))[:, 1:]
        shown = (costs.rotation[rows] * np.square(turns)).sum(axis=1)
        if np.minimum(shown, MOST).mean() <= _ROTATION_BITS:
            return steps
    return _STEPS[-1]


def _probes(count: int) -> slice:
    """Return the splats that are looked at."""
    return slice(None, None, max(1, -(-count // _PROBES)))
