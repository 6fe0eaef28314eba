"""What has to be known of a scene before it is fitted to its target, found chunk by chunk."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError, counts_in_words
from gsplat_tools.formats.loading import warn_dropped
from gsplat_tools.ops.visibility import Viewpoint, viewpoint_of
from gsplat_tools.progress import stage

if TYPE_CHECKING:
    from gsplat_tools.formats.preparing import SaveChoices


@dataclass(slots=True)
class Scan:
    """What one pass over a scene finds out."""

    num_splats: int = 0
    num_kept: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -np.inf))
    sh_degree: int = 0
    view: Viewpoint | None = None
    """From where splats are looked at that are dropped for being faint."""

    def add(self, cloud: GaussianCloud) -> None:
        """Take one more chunk, already cleaned, into account."""
        from gsplat_tools.ops.harmonics import effective_sh_degree

        self.num_kept += len(cloud)
        if len(cloud):
            self.low = np.minimum(self.low, cloud.means.min(axis=0))
            self.high = np.maximum(self.high, cloud.means.max(axis=0))
            if self.sh_degree < cloud.sh_degree:
                self.sh_degree = max(self.sh_degree, effective_sh_degree(cloud))

    def merge(self, other: Scan) -> None:
        """Take what another scan found into account."""
        self.num_kept += other.num_kept
        self.low = np.minimum(self.low, other.low)
        self.high = np.maximum(self.high, other.high)
        self.sh_degree = max(self.sh_degree, other.sh_degree)


def scan_chunks(chunks: CloudChunks, choices: SaveChoices) -> Scan:
    """Go through the scene: invalid splats, bounds, highest band in use; before that from where it is looked at, if it is.

    Raises
    ------
    CloudError
        `strict` and there are invalid splats.
    """
    scan = Scan(view=_view(chunks, choices))
    with stage("reading", len(chunks)) as progress:
        for chunk in chunks:
            scan.num_splats += len(chunk)
            scan.add(clean(chunk, choices, scan.view, scan.dropped))
            progress.advance(len(chunk))
    invalid = {cause: count for cause, count in scan.dropped.items() if cause not in ("pruned-opacity", "pruned-faint")}
    if choices.strict and invalid:
        raise CloudError(
            f"{sum(invalid.values())} of {scan.num_splats} splats would be dropped: {counts_in_words(invalid)}; "
            "repair them or leave out --strict"
        )
    warn_dropped(invalid, scan.num_splats)
    return scan


def _view(chunks: CloudChunks, choices: SaveChoices) -> Viewpoint | None:
    """Return from where valid and opaque splats are looked at; None where nothing is dropped for being faint."""
    if not choices.prune_faint:
        return None
    return viewpoint_of((clean(chunk, choices) for chunk in chunks), len(chunks))


def clean(
    chunk: GaussianCloud, choices: SaveChoices, view: Viewpoint | None = None, dropped: Counter[str] | None = None
) -> GaussianCloud:
    """Drop invalid and pruned splats of a chunk, counting them; with a view, faint ones too."""
    from gsplat_tools.ops.filtering import drop_invalid, prune_faint, prune_opacity

    kept, causes = drop_invalid(chunk)
    kept, pruned = prune_opacity(kept, choices.prune_opacity)
    causes["pruned-opacity"] = pruned
    if view is not None and choices.prune_faint:
        kept, causes["pruned-faint"] = prune_faint(kept, choices.prune_faint, view)
    if dropped is not None:
        dropped.update({cause: count for cause, count in causes.items() if count})
    return kept
