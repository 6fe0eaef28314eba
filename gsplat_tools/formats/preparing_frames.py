"""Fit the frames of a sequence to their target alike: what each frame has to tell, and what follows from all of them.

Frames may be looked at anywhere and in any order; what is decided depends on their numbers alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CloudError, counts_in_words
from gsplat_tools.formats.base import Format
from gsplat_tools.formats.loading import warn_dropped
from gsplat_tools.formats.preparing import Fit, Prepared, SaveChoices
from gsplat_tools.formats.scanning import Scan
from gsplat_tools.ops.visibility import lit_pixels, viewpoint
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What one frame tells about the splats that may stay.

    Parameters
    ----------
    codes
        (N,) the cause for which each splat is invalid, as `ops.filtering` numbers them; None where all are valid.
    visible
        (N,) whether each shows enough to stay, as packed bits, by the cause for which others may go.
    scan
        Bounds and highest band.
    """

    codes: NDArray[np.uint8] | None
    visible: dict[str, NDArray[np.uint8]]
    scan: Scan


def look_at_frame(frame: GaussianCloud, choices: SaveChoices, keeps: NDArray[np.bool_] | None = None) -> FrameFacts:
    """Return what a frame tells; with `keeps`, the bounds of the splats that stay and nothing else."""
    from gsplat_tools.ops.filtering import invalid_codes

    scan = Scan()
    if keeps is not None:
        scan.add(frame.take(keeps))
        return FrameFacts(None, {}, scan)
    scan.add(frame)
    codes = invalid_codes(frame)
    return FrameFacts(codes, _visible(frame, codes, choices), scan)


@dataclass(frozen=True, slots=True)
class FrameFit:
    """What was decided for all frames.

    Parameters
    ----------
    fit
        Axes, origin and degree.
    selection
        (M,) splats that stay, in the order of the target.
    sh_degree
        Highest band of what is written.
    """

    fit: Fit
    selection: NDArray[np.intp]
    sh_degree: int

    def __call__(self, frame: GaussianCloud) -> GaussianCloud:
        """Return a frame as the target is to have it."""
        return self.fit.apply(frame.take(self.selection))


@dataclass(frozen=True, slots=True)
class Kept:
    """What all frames together tell.

    Parameters
    ----------
    keeps
        (N,) whether each splat stays; one that goes in one frame goes in all.
    scan
        Bounds and highest band of all splats; where some go, those that stay have to be looked at again.
    dropped
        Splats left out, per cause.
    """

    keeps: NDArray[np.bool_]
    scan: Scan
    dropped: dict[str, int]


def kept_splats(facts: Iterable[FrameFacts], count: int, choices: SaveChoices) -> Kept:
    """Return which of `count` splats stay, from what every frame tells, in their order.

    Raises
    ------
    CloudError
        `strict` and there are invalid splats.
    """
    from gsplat_tools.ops.filtering import count_causes

    keeps = np.ones(count, np.bool_)
    visible: dict[str, NDArray[np.uint8]] = {}
    causes: Counter[str] = Counter()
    scan = Scan(num_splats=count)
    for frame_id, each in enumerate(facts):
        if each.codes is not None:
            if choices.strict:
                raise CloudError(f"invalid splats: {counts_in_words(count_causes(each.codes))}", frame=frame_id)
            causes.update(count_causes(each.codes[keeps]))
            keeps &= each.codes == 0
        for cause, shown in each.visible.items():
            visible[cause] = visible[cause] | shown if cause in visible else shown
        scan.merge(each.scan)
    warn_dropped(dict(causes), count)
    for cause, shown in visible.items():
        is_visible = np.unpackbits(shown, count=count).astype(np.bool_)
        pruned = int(np.count_nonzero(keeps & ~is_visible))
        if pruned:
            causes[cause] = pruned
        keeps &= is_visible
    return Kept(keeps, scan, dict(causes))


def with_scan(kept: Kept, facts: Iterable[FrameFacts]) -> Kept:
    """Return the same with the bounds of what stays, from a second look at every frame."""
    scan = Scan(num_splats=len(kept.keeps))
    for each in facts:
        scan.merge(each.scan)
    return replace(kept, scan=scan)


def decide_fit(first: GaussianCloud, kept: Kept, target: Format, choices: SaveChoices) -> FrameFit:
    """Decide how all frames are fitted; the first frame gives the order.

    Raises
    ------
    CapabilityError, CloudError
        See `prepare`.
    """
    scan = replace(kept.scan, dropped=Counter(kept.dropped))
    fit = Fit(first.take(slice(0, 0)), target, choices, scan)
    fitted = fit.apply(first.take(kept.keeps))
    order = choices.order or target.order
    selection = np.flatnonzero(kept.keeps)
    if order != "none":
        from gsplat_tools.ops.ordering import splat_order

        selection = selection[splat_order(fitted, order)]
    return FrameFit(fit, selection, fitted.sh_degree)


def prepare_sequence(sequence: GaussianSequence, target: Format, choices: SaveChoices) -> Prepared:
    """Fit the frames of a sequence to their target; see `prepare`."""
    first = sequence.frame(0)

    def frames() -> Iterator[GaussianCloud]:
        yield first
        for frame_id in range(1, len(sequence)):
            yield sequence.frame(frame_id)

    def facts() -> Iterator[FrameFacts]:
        with stage("checking frames", len(sequence), "frames") as progress:
            for frame in frames():
                yield look_at_frame(frame, choices)
                progress.advance(1)

    kept = kept_splats(facts(), len(first), choices)
    if not kept.keeps.all():
        kept = with_scan(kept, (look_at_frame(frame, choices, kept.keeps) for frame in frames()))
    return Prepared(fitted_sequence(sequence, decide_fit(first, kept, target, choices)), kept.dropped)


def fitted_sequence(sequence: GaussianSequence, fit: FrameFit) -> GaussianSequence:
    """Return the frames as they are to be written, fitted when they are loaded."""
    return GaussianSequence(
        lambda frame_id: fit(sequence.frame(frame_id)),
        num_splats=len(fit.selection),
        sh_degree=fit.sh_degree,
        frame_times=None if sequence.is_uniform else sequence.frame_times,
        num_frames=len(sequence),
    )


def _visible(frame: GaussianCloud, codes: NDArray[np.uint8] | None, choices: SaveChoices) -> dict[str, NDArray[np.uint8]]:
    """Return which splats of a frame show enough to stay, looked at from where the valid ones of this frame are."""
    from gsplat_tools.attributes.activations import sigmoid

    visible = {}
    if choices.prune_opacity > 0:
        visible["pruned-opacity"] = np.packbits(sigmoid(frame.opacity_logits) >= choices.prune_opacity)
    if choices.prune_faint:
        view = viewpoint(frame if codes is None else frame.take(codes == 0))
        visible["pruned-faint"] = np.packbits(lit_pixels(frame, view) >= choices.prune_faint)
    return visible
