"""One cloud through one format: every value's error against its own bound."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import attribute_errors
from gsplat_tools.errors import GsplatError, GsplatWarning
from gsplat_tools.formats.base import Bounds, Format, Scene
from gsplat_tools.formats.preparing import SaveChoices, prepare
from gsplat_tools.numerics import rotations, sizes
from gsplat_tools.numerics.palettes import palette_limits
from gsplat_tools.sequence import GaussianSequence

_MOMENTS = (0.0, 0.3, 1.0)
"""Normalized times at which paths are compared."""

_FLOAT32_HALF_STEP = 2.0**-24
"""Rounding to float32, relative."""

_COMPANIONS = {rotations.ATTRIBUTE: "covariances", sizes.ATTRIBUTE: "scales"}
"""Rows that are shown wherever another is: what it leaves open."""

_UNBOUNDED = {
    "scales": f"a logarithm that becomes or was -inf is infinitely off: see {sizes.ATTRIBUTE!r}",
    "covariances": f"relative to a covariance that is 0, or beyond float64: see {sizes.ATTRIBUTE!r}",
    "shN": "labels that are kept from frame to frame, or moved within a tolerance, are not in the file",
    rotations.ATTRIBUTE: "the covariance errs by as much as its eigenvalues differ, which leaves its axes free",
    sizes.ATTRIBUTE: "a point gets an extent, or lengths are beyond float64",
}
"""Why a value may have no bound."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Errors of one attribute in one format under one condition.

    Parameters
    ----------
    format, attribute, condition
        Format id; attribute as `Bounds` names it; sweep and point of it.
    bound
        Largest derived bound of any value; None where none is known.
    measured_max, measured_rms
        Largest and root mean square error; over the values that have a bound, where any has.
    within
        Whether every value is at most its own bound away; None where nothing is bounded.
    tightness
        Largest error relative to its own bound, 0 to 1 where all are within; None where no bound is above 0.
    sweep, x
        Name of the sweep and the magnitude that it varies, for plots.
    note
        Why the format refused, how many values have no bound, or what was warned about.
    """

    format: str
    attribute: str
    condition: str
    bound: float | None = None
    measured_max: float | None = None
    measured_rms: float | None = None
    within: bool | None = None
    tightness: float | None = None
    sweep: str = ""
    x: float | None = None
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Transfer:
    """What became of a scene on its way through a format.

    Parameters
    ----------
    prepared, decoded
        What was handed to the writer, and what was read back.
    stream
        The file.
    warnings
        Codes of what was warned about, in order.
    """

    prepared: GaussianCloud | GaussianSequence
    decoded: GaussianCloud | GaussianSequence
    stream: io.BytesIO
    warnings: tuple[str, ...]


def transfer(scene: Scene, record: Format) -> Transfer:
    """Write a scene in memory and read it back, splats in their order.

    Raises
    ------
    GsplatError
        The format refuses the scene.
    """
    assert record.write is not None
    assert record.read is not None
    stream = io.BytesIO()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        prepared = prepare(scene, record, SaveChoices(order="none")).scene
        if isinstance(prepared, CloudChunks):
            prepared = prepared.read()
        record.write(prepared, stream, record.write_options())
        stream.seek(0)
        decoded = record.read(stream, record.read_options())
    codes = tuple(dict.fromkeys(w.message.code for w in caught if isinstance(w.message, GsplatWarning)))
    return Transfer(prepared, decoded, stream, codes)


def measure_cloud(
    cloud: GaussianCloud,
    record: Format,
    *,
    watched: Iterable[str] | None = None,
    sweep: str = "scene",
    label: str = "",
    x: Any = None,
) -> list[Row]:
    """Return the errors of one cloud in one format.

    Parameters
    ----------
    cloud
        N valid splats.
    record
        A format that reads and writes.
    watched
        Attributes to report; None reports all. An attribute that leaves its bound is reported in any case.
    sweep, label, x
        Name of the sweep, its point in words and as a number.

    Returns
    -------
    list of Row
        A row an attribute; means are those of the given cloud, all else of what the format was given to write. A format
        that refuses the cloud gives rows that say so.
    """
    # A format that is always in one system would turn the axes of a cloud that says nothing.
    system = record.required_coordinates or cloud.coordinate_system
    cloud = cloud.replace(coordinate_system=system)
    facts = {"format": record.id, "condition": f"{sweep} {label}".strip(), "sweep": sweep, "x": x}
    names = None if watched is None else tuple(watched)
    try:
        done = transfer(cloud, record)
        # Frames are read when they are asked for, and may be refused only then.
        source, decoded = _frame(done.prepared), _frame(done.decoded)
    except GsplatError as error:
        return [Row(**facts, attribute=name, note=f"refused: {error.message}") for name in names or ("all",)]
    if len(source) != len(decoded) or len(source) != len(cloud):
        lost = f"{len(cloud)} splats, {len(source)} written, {len(decoded)} read"
        return [Row(**facts, attribute="splats", within=False, note=lost)]
    errors, limits = compare_clouds(cloud, source, decoded, record, done.stream, 0)
    # What a format clamps or drops beyond its bounds is said beside the row.
    note = ", ".join(done.warnings)
    rows = [judge(name, values, limits.get(name), note=note, **facts) for name, values in errors.items()]
    return [row for row in rows if names is None or _is_watched(row.attribute, names) or row.within is False]


def _is_watched(attribute: str, names: tuple[str, ...]) -> bool:
    """Whether an attribute, or the one that it accompanies, is among the names."""
    return attribute in names or _COMPANIONS.get(attribute) in names


def _frame(scene: GaussianCloud | GaussianSequence) -> GaussianCloud:
    """Return a cloud, or the first frame of a sequence."""
    return scene.frame(0) if isinstance(scene, GaussianSequence) else scene


def compare_clouds(
    original: GaussianCloud, prepared: GaussianCloud, decoded: GaussianCloud, record: Format, stream: io.BytesIO, frame: int
) -> tuple[dict[str, NDArray[np.float64]], Bounds]:
    """Return errors per attribute and their bounds: world positions from end to end, all else from what was written."""
    errors = attribute_errors(prepared, decoded)
    limits: Bounds = {}
    if record.bounds is not None:
        stream.seek(0)
        limits = dict(record.bounds(prepared, stream, frame))
        shN = palette_limits(prepared, decoded, record, stream, frame)
        if shN is not None:
            limits["shN"] = shN
    reach = sizes.covariance_reach(prepared.log_scales, record)
    if reach is not None and "scales" in limits:
        limits["scales"] = np.fmin(limits["scales"], sizes.reach_limits(prepared, reach))
    errors[sizes.ATTRIBUTE] = sizes.size_errors(prepared, decoded)
    limits[sizes.ATTRIBUTE] = sizes.size_limits(prepared, limits, reach)
    errors[rotations.ATTRIBUTE] = rotations.rotation_errors(prepared, decoded)
    turns = rotations.rotation_limits(prepared, record, stream, frame, limits.get("covariances"))
    if turns is not None:
        limits[rotations.ATTRIBUTE] = turns
    errors["means"] = attribute_errors(original, decoded)["means"]
    if not np.array_equal(original.origin, prepared.origin) and "means" in limits:
        # Moving the origin rounds each mean once.
        limits["means"] = limits["means"] + np.abs(prepared.means.astype(np.float64)) * _FLOAT32_HALF_STEP
    if prepared.has_motion and decoded.has_motion:
        errors["path"], limits["path"] = _paths(prepared, decoded, limits)
    return errors, limits


def _paths(prepared: GaussianCloud, decoded: GaussianCloud, limits: Bounds) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far mean + velocity (t - time) is off at any of some moments, and what the parts' bounds allow."""

    def parts(cloud: GaussianCloud) -> tuple[NDArray[np.float64], ...]:
        assert cloud.velocities is not None
        assert cloud.times is not None
        return cloud.means.astype(np.float64), cloud.velocities.astype(np.float64), cloud.times.astype(np.float64)[:, None]

    (means, velocities, times), (means_read, velocities_read, times_read) = parts(prepared), parts(decoded)
    off, allowed = np.zeros(means.shape), np.zeros(means.shape)
    for t in _MOMENTS:
        # Differences of the parts, so that nothing large cancels.
        difference = (
            (means_read - means) + (velocities_read - velocities) * (t - times_read) - velocities * (times_read - times)
        )
        off = np.maximum(off, np.abs(difference))
        late = np.reshape(limits.get("times", np.zeros(1)), (-1, 1))
        speed = limits.get("velocities", np.zeros((1, 3)))
        bound = limits["means"] + speed * (np.abs(t - times) + late) + np.abs(velocities) * late
        allowed = np.maximum(allowed, bound)
    return off, allowed


def judge(name: str, errors: NDArray[np.float64], limit: NDArray[Any] | None, *, note: str = "", **facts: Any) -> Row:
    """Return the row of one attribute."""
    if errors.size == 0:
        return Row(attribute=name, note=note, **facts)
    if limit is None:
        note = ", ".join(filter(None, [note, f"no bound is known: {_UNBOUNDED.get(name, 'the format states none')}"]))
        return Row(attribute=name, measured_max=_max(errors), measured_rms=_rms(errors), note=note, **facts)
    bounds = np.broadcast_to(np.asarray(limit, np.float64), errors.shape)
    is_bounded = np.isfinite(bounds)
    if not is_bounded.all():
        count = int(np.count_nonzero(~is_bounded))
        why = _UNBOUNDED.get(name, "the encoding leaves them open")
        note = ", ".join(filter(None, [note, f"{count} of {bounds.size} values have no bound ({why})"]))
        if not is_bounded.any():
            return Row(attribute=name, measured_max=_max(errors), measured_rms=_rms(errors), note=note, **facts)
    kept, own = errors[is_bounded], bounds[is_bounded]
    positive = own > 0
    return Row(
        attribute=name,
        bound=float(own.max()),
        measured_max=_max(kept),
        measured_rms=_rms(kept),
        within=bool((kept <= own).all()),
        tightness=float((kept[positive] / own[positive]).max()) if positive.any() else None,
        note=note,
        **facts,
    )


def _max(errors: NDArray[np.float64]) -> float:
    return float(errors.max())


def _rms(errors: NDArray[np.float64]) -> float:
    """Return the root of the mean square, by the largest so that no square overflows or vanishes."""
    largest = float(np.abs(errors).max())
    if not 0 < largest < np.inf:
        return largest
    return largest * float(np.sqrt(np.square(errors / largest).mean()))
