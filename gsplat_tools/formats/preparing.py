"""Fit a scene to its target before it is written: drop, prune, convert axes, recenter, lower the degree, order.

What the decisions need is found in one pass over the chunks; they are then applied chunk by chunk, so that memory
stays bounded where the target streams.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes.coordinate_systems import is_known
from gsplat_tools.chunks import CloudChunks, as_chunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import CapabilityError, GsplatWarning, LossyConversionWarning
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.scanning import Scan, clean, scan_chunks
from gsplat_tools.sequence import GaussianSequence

WORTHWHILE_GAIN = 2.0
"""Recentering is worth a stored origin once it saves a bit of position precision: a factor of two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SaveChoices:
    """Choices of `save` that are the same for every format.

    Parameters
    ----------
    sh_degree
        Highest band to keep; "auto" drops bands that are zero everywhere. By default "auto", or what the source has
        where the target is lossless.
    prune_opacity
        Splats with a lower opacity are dropped; 0 prunes nothing.
    prune_faint
        Splats that light fewer pixels (`ops.visibility.lit_pixels`) are dropped; 0 prunes nothing. By default what a visual
        tolerance is worth, else 0.
    outliers
        "drop" leaves out far splats that hardly show where they stretch the box (`ops.outliers`), of still scenes; "auto"
        does so with a visual tolerance.
    order
        "morton", "hilbert2d" or "none"; by default what suits the format.
    source_coordinates
        Axis letters that the source is in; by default what the source says.
    target_coordinates
        Axis letters to convert to; by default nothing is converted.
    recenter
        "auto" subtracts an origin where that gains precision and the target stores it; "on" always; "off" never.
    strict
        Refuse what would be dropped.
    """

    sh_degree: int | Literal["auto"] | None = None
    prune_opacity: float = 0.0
    prune_faint: float | None = None
    outliers: Literal["auto", "keep", "drop"] = "auto"
    order: Literal["morton", "hilbert2d", "none"] | None = None
    source_coordinates: str | None = None
    target_coordinates: str | None = None
    recenter: Literal["auto", "on", "off"] = "auto"
    strict: bool = False

    def __post_init__(self) -> None:
        choices = {
            "order": (None, "morton", "hilbert2d", "none"),
            "outliers": ("auto", "keep", "drop"),
            "recenter": ("auto", "on", "off"),
            "strict": (True, False),
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise CapabilityError(f"{name} must be one of {', '.join(map(str, known))}, got {getattr(self, name)!r}")
        for name in ("source_coordinates", "target_coordinates"):
            axes = getattr(self, name)
            if axes is not None and not is_known(axes):
                raise CapabilityError(f"{name} must be axis letters such as RUB, RDF, RUF or LUF, got {axes!r}")
        if not 0 <= self.prune_opacity <= 1:
            raise CapabilityError(f"prune_opacity must be 0 to 1, got {self.prune_opacity}")
        if self.prune_faint is not None and not 0 <= self.prune_faint < np.inf:
            raise CapabilityError(f"prune_faint must be a number of pixels, 0 or more, got {self.prune_faint}")


@dataclass(frozen=True, slots=True)
class Prepared:
    """A scene as it will be handed to the writer, and what was left out on the way."""

    scene: GaussianCloud | CloudChunks | GaussianSequence
    dropped: dict[str, int] = field(default_factory=dict)


def prepare(scene: Scene, target: Format, choices: SaveChoices) -> Prepared:
    """Fit a scene to its target.

    Parameters
    ----------
    scene
        Cloud, chunks or sequence, invalid splats included.
    target
        Format that will be written.
    choices
        What was asked for.

    Returns
    -------
    Prepared
        A sequence for a sequence, chunks where the target streams and no order was asked for, else a cloud.

    Raises
    ------
    CapabilityError
        The target cannot hold the scene, and dropping is refused or makes no sense.
    CloudError
        `strict` and there are invalid splats, or axes are to be converted from an unknown system.

    Warns
    -----
    LossyConversionWarning, NonFiniteWarning
        What was dropped, with counts.
    """
    if isinstance(scene, GaussianSequence):
        if target.holds_sequences:
            from gsplat_tools.formats.preparing_frames import prepare_sequence  # which decides with what is here

            return prepare_sequence(scene, target, choices)
        if len(scene) > 1:
            raise CapabilityError(
                f"{target.title} holds one frame and the source has {len(scene)}; choose one with --frame or --time"
            )
        scene = scene.frame(0)
    order = choices.order or target.order
    in_one = not target.streams or order != "none"
    num_outliers = 0
    if choices.outliers == "drop":
        scene, num_outliers = _without_outliers(scene, choices)
    chunks = as_chunks(scene, max(len(scene), 1)) if in_one else as_chunks(scene)
    scan = scan_chunks(chunks, choices)
    if num_outliers:
        scan.dropped["outliers"] += num_outliers
    fit = Fit(chunks.template, target, choices, scan)
    prepared = chunks.map(fit, num_splats=scan.num_kept)
    if not in_one:
        return Prepared(prepared, dict(scan.dropped))
    cloud = prepared.read()
    if order != "none":
        from gsplat_tools.ops.ordering import splat_order

        cloud = cloud.take(splat_order(cloud, order))
    return Prepared(cloud, dict(scan.dropped))


def _without_outliers(scene: GaussianCloud | CloudChunks, choices: SaveChoices) -> tuple[GaussianCloud | CloudChunks, int]:
    """Leave out far splats that hardly show, which is told from all splats that are written."""
    from gsplat_tools.attributes.activations import sigmoid
    from gsplat_tools.ops.filtering import classify_invalid
    from gsplat_tools.ops.outliers import find_outliers

    cloud = scene if isinstance(scene, GaussianCloud) else scene.read()
    written, _ = classify_invalid(cloud)
    if choices.prune_opacity > 0:
        written = written & (sigmoid(cloud.opacity_logits) >= choices.prune_opacity)
    outliers = np.flatnonzero(written)[find_outliers(cloud.take(written))]
    if len(outliers) == 0:
        return scene, 0
    stays = np.ones(len(cloud), np.bool_)
    stays[outliers] = False
    return cloud.take(stays), len(outliers)


class Fit:
    """The decisions about one scene, applied to any piece of it."""

    def __init__(self, template: GaussianCloud, target: Format, choices: SaveChoices, scan: Scan) -> None:
        self._target = target
        self._choices = choices
        self._drops_anything = bool(scan.dropped)
        self._view = scan.view
        self._source_system, self._target_system = self._choose_coordinates(template)
        self._sh_degree = self._choose_degree(template, scan)
        self._drops_motion = template.has_motion and not target.holds_motion
        if self._drops_motion:
            self._lose(f"the motion of {scan.num_kept} splats", "motion")
        self._drops_extra = bool(template.extra) and not target.holds_extra
        if self._drops_extra:
            self._lose(f"{len(template.extra)} extra properties ({', '.join(sorted(template.extra))})", "extra")
        if template.source_format and target.is_lossy:
            warnings.warn(
                LossyConversionWarning(
                    f"the source was stored as {template.source_format}, which is lossy, and {target.id} is lossy too: errors "
                    "add up; convert from the original where there is one",
                    code="lossy-to-lossy",
                ),
                stacklevel=4,
            )
        if template.splat_model != "default" and not target.stores_splat_model:
            self._lose(f"the splat model {template.splat_model!r}", "splat-model")
        # The box follows the axes: convert its corners like any position.
        self._folds_origin, self._shift = False, np.zeros(3)
        if scan.num_kept:
            corners = template.replace(**_corner_arrays(scan.low, scan.high, template))
            turned = self._turn(corners)
            self._choose_origin(turned, scan)

    def __call__(self, chunk: GaussianCloud) -> GaussianCloud:
        """Clean a chunk as it was found and apply the decisions to it."""
        return self.apply(clean(chunk, self._choices, self._view) if self._drops_anything else chunk)

    def apply(self, chunk: GaussianCloud) -> GaussianCloud:
        """Apply the decisions to splats that are already clean."""
        from gsplat_tools.ops.harmonics import with_sh_degree
        from gsplat_tools.ops.recentering import recenter, without_origin

        if chunk.sh_degree != self._sh_degree:
            chunk = with_sh_degree(chunk, self._sh_degree)
        if self._drops_motion:
            chunk = chunk.replace(velocities=None, times=None, durations=None)
        if self._drops_extra:
            chunk = chunk.replace(extra={})
        chunk = self._turn(chunk)
        if self._folds_origin:
            chunk = without_origin(chunk)
        if self._shift.any():
            chunk = recenter(chunk, chunk.origin + self._shift)
        if not self._target.stores_origin and chunk.origin.any():
            chunk = chunk.replace(origin=np.zeros(3))  # given up with a warning: what is written starts from here
        return chunk

    def box(self, template: GaussianCloud, scan: Scan) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the ends of the positions as they will be written, (3,) each.

        Axes trade places and change their signs, and shifts are rounded, which keeps the order: corners stay corners.
        """
        corners = self.apply(template.replace(**_corner_arrays(scan.low, scan.high, template)))
        return corners.means.min(axis=0), corners.means.max(axis=0)

    def _turn(self, cloud: GaussianCloud) -> GaussianCloud:
        """Name the source's axes and convert them."""
        from gsplat_tools.ops.coordinates import convert_coordinates

        if cloud.coordinate_system != self._source_system:
            cloud = cloud.replace(coordinate_system=self._source_system)
        if self._target_system not in (None, self._source_system):
            cloud = convert_coordinates(cloud, self._target_system)
        return cloud

    def _lose(self, what: str, code: str) -> None:
        """Warn about something that the target cannot hold, or refuse with `strict`."""
        if self._choices.strict:
            raise CapabilityError(f"{self._target.title} cannot hold {what}; leave out --strict to drop it")
        warnings.warn(
            LossyConversionWarning(f"{self._target.title} cannot hold {what}: dropped", code=f"dropped-{code}"), stacklevel=4
        )

    def _choose_coordinates(self, template: GaussianCloud) -> tuple[str, str | None]:
        """Return the axes of the source and those to convert to (None: as they are)."""
        source = self._choices.source_coordinates or template.coordinate_system
        wanted = self._choices.target_coordinates
        required = self._target.required_coordinates
        if required is None:
            return source, wanted
        if wanted not in (None, required):
            raise CapabilityError(f"{self._target.title} is always {required}, not {wanted}")
        if source == "unknown":
            source = "RUB"
            warnings.warn(
                GsplatWarning(
                    f"the source does not say its axes: taken as {source} and converted to {required}; "
                    "give --source-coordinates to be sure",
                    code="assumed-coordinates",
                ),
                stacklevel=4,
            )
        return source, required

    def _choose_degree(self, template: GaussianCloud, scan: Scan) -> int:
        """Return the highest band to write."""
        wanted = self._choices.sh_degree
        if wanted is None:
            wanted = template.sh_degree if self._target.lossless else "auto"
        if wanted == "auto":
            degree = scan.sh_degree
        elif 0 <= int(wanted) <= 4:
            degree = min(int(wanted), template.sh_degree)
        else:
            raise ValueError(f"sh_degree must be 0 to 4 or 'auto', got {wanted!r}")
        if degree > self._target.max_sh_degree:
            bands = (
                f"{self._target.max_sh_degree + 1}"
                if degree == self._target.max_sh_degree + 1
                else (f"{self._target.max_sh_degree + 1} to {degree}")
            )
            self._lose(f"SH band {bands} of {scan.num_kept} splats", "sh-bands")
            degree = self._target.max_sh_degree
        return degree

    def _choose_origin(self, corners: GaussianCloud, scan: Scan) -> None:
        """Decide what happens to the origin, from the two corners of the box in the target's axes."""
        from gsplat_tools.ops.recentering import choose_origin, position_step

        low, high = corners.means.min(axis=0).astype(np.float64), corners.means.max(axis=0).astype(np.float64)
        mode = self._choices.recenter
        stores = self._target.stores_origin
        has_origin = bool(corners.origin.any())
        self._folds_origin = has_origin and (mode == "off" or (mode == "auto" and not stores))
        if self._folds_origin:
            low, high = low + corners.origin, high + corners.origin
        center = choose_origin(low, high)
        before, after = float(np.abs([low, high]).max()), float(np.abs([low - center, high - center]).max())
        gains = before > WORTHWHILE_GAIN * after
        kind = self._target.position_type
        if kind == "fixed":  # ranges follow the scene, wherever it is
            kind = "f32"
        steps = f"steps of up to {position_step(before, kind):.3g}, recentered {position_step(after, kind):.3g}"
        if mode == "on" or (mode == "auto" and stores and gains and not self._target.lossless):
            self._shift = center
            if mode == "on" and not stores:
                place = ", ".join(
                    repr(float(value)) for value in (np.zeros(3) if self._folds_origin else corners.origin) + center
                )
                warnings.warn(
                    LossyConversionWarning(
                        f"{self._target.title} does not store the origin {place}; add it to place the scene", code="origin-lost"
                    ),
                    stacklevel=4,
                )
        elif mode == "auto" and gains and not stores and (has_origin or kind == "f16"):
            warnings.warn(
                GsplatWarning(
                    f"positions reach {before:.6g} and are stored in {steps}; {self._target.title} has no place for an origin: "
                    "use --recenter on to subtract it all the same",
                    code="position-step",
                ),
                stacklevel=4,
            )


def _corner_arrays(low: NDArray[np.float64], high: NDArray[np.float64], template: GaussianCloud) -> dict[str, object]:
    """Return the arrays of a cloud of two splats at the corners of a box."""
    arrays: dict[str, object] = {
        name: np.zeros((2, *values.shape[1:]), np.float32) for name, values in template.arrays().items()
    }
    arrays["means"] = np.array([low, high], np.float32)
    arrays["quats"] = np.tile(np.array([1, 0, 0, 0], np.float32), (2, 1))
    arrays["extra"] = {name: np.zeros((2, *values.shape[1:]), values.dtype) for name, values in template.extra.items()}
    return arrays
