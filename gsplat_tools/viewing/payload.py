"""Files as the page takes them: as they are where Spark or the page's own decoders read them, else in Spark's layout."""

from __future__ import annotations

import warnings
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.convert import convert
from gsplat_tools.errors import FormatError, GsplatWarning
from gsplat_tools.formats.base import FileInfo
from gsplat_tools.formats.loading import inspect_file, load
from gsplat_tools.formats.saving import save
from gsplat_tools.ops.coordinates import convert_coordinates
from gsplat_tools.ops.recentering import recenter
from gsplat_tools.reference.auto_cameras import auto_cameras, robust_sphere, world_axes
from gsplat_tools.sequence import GaussianSequence

READ_IN_THE_PAGE = {"spark": "gspk", "sog4d": "sog4d", "ply": "ply", "spz": "spz", "sog": "sog", "splat": "splat"}
"""Formats that the page reads by itself, and what it calls them."""

_VIEWS, _SIZE = 8, (1280, 720)
_DRAWN_DEGREE = 3
"""Spark 2.2 has no fourth band."""
_FAR = 8.0
"""Radii from zero beyond which a scene is drawn about its own middle: halves would show steps."""
_OPPOSITE = dict(zip("RLUDFB", "LRDUBF", strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Payload:
    """One file for the page.

    Parameters
    ----------
    path
        Bytes to hand over: the file itself, or a copy in Spark's layout.
    source
        The file that was named.
    kind
        What the page reads it as.
    note
        What was done to it, in a few words; empty where nothing was.
    splats, frames
        What it holds.
    error
        Why it cannot be shown; the rest means nothing then.
    """

    path: Path
    source: Path
    kind: str = ""
    note: str = ""
    splats: int = 0
    frames: int = 1
    error: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return what the page's configuration says of the file."""
        facts = {"name": self.source.name, "kind": self.kind, "note": self.note, "splats": self.splats, "frames": self.frames}
        return {**facts, "bytes": self.source.stat().st_size, "error": self.error}


@dataclass(frozen=True, slots=True, kw_only=True)
class Exhibit:
    """Files that are shown together, and where from."""

    payloads: list[Payload]
    view: dict[str, Any]


def prepare_exhibit(files: list[Path], keep: ExitStack) -> Exhibit:
    """Look at files, and rewrite those that the page cannot read.

    Parameters
    ----------
    files
        One file, or two to compare; the second is brought into the axes and the origin of the first.
    keep
        Holds the folder of rewritten files until it is closed.

    Returns
    -------
    Exhibit
        Payloads in order, and cameras around the first scene that can be shown.
    """
    folder = Path(keep.enter_context(TemporaryDirectory(prefix="gsplat-view-")))
    payloads: list[Payload] = []
    place: _Place | None = None
    for index, file in enumerate(files):
        try:
            payload, found = _prepare(file, folder / str(index), place)
        except FormatError as error:
            payloads.append(Payload(path=file, source=file, error=str(error)))
            continue
        payloads.append(payload)
        place = place or found
    return Exhibit(payloads=payloads, view={} if place is None else place.to_json())


@dataclass(frozen=True, slots=True)
class _Place:
    """The first scene as it is drawn, in axes that are right-handed and about an origin near it; and how it got there."""

    cloud: GaussianCloud
    world: NDArray[np.float64]

    def to_json(self) -> dict[str, Any]:
        """Return cameras around the scene, its middle, its direction up, and the way from the file's coordinates."""
        if len(self.cloud) == 0:
            return {}
        drawn = self.cloud.replace(origin=np.zeros(3))
        return {
            "cameras": [camera.to_json() for camera in auto_cameras(drawn, views=_VIEWS, size=_SIZE)],
            "center": robust_sphere(drawn)[0].tolist(),
            "up": world_axes(drawn.coordinate_system)[1].tolist(),
            "world": self.world.tolist(),
        }


def _place_of(cloud: GaussianCloud) -> _Place:
    """Return where a scene that comes first is drawn: three.js is right-handed, and Spark's positions are halves."""
    drawn = cloud
    matrix = np.eye(3)
    axes = world_axes(cloud.coordinate_system)
    if np.linalg.det(axes) < 0:
        target = cloud.coordinate_system[:2] + _OPPOSITE[cloud.coordinate_system[2]]
        drawn, matrix = convert_coordinates(cloud, target), np.diag([1.0, 1.0, -1.0])
    if len(drawn):
        center, radius = robust_sphere(drawn)
        if np.linalg.norm(center - drawn.origin) > _FAR * radius:
            drawn = recenter(drawn, center)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = matrix, -drawn.origin
    return _Place(drawn, world)


def _prepare(file: Path, target: Path, place: _Place | None) -> tuple[Payload, _Place]:
    """Return a file as the page takes it, and where its first frame is drawn if it is the first."""
    record, info = inspect_file(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        scene = load(file)
        if isinstance(scene, GaussianCloud) and scene.has_motion:
            baked = target.with_suffix(".sog4d")
            report = convert([file], baked, validation=None)
            moving = load(baked)
            assert isinstance(moving, GaussianSequence)
            first, notes = moving.frame(0), [f"baked to {report.frames} keyframes"]
            notes += _unmoved(first, place)
            payload = Payload(
                path=baked, source=file, kind="sog4d", note=", ".join(notes), splats=report.splats, frames=report.frames
            )
            return payload, _Place(first, np.eye(4))
        first = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
        if isinstance(scene, GaussianSequence):
            note = ", ".join(_unmoved(first, place))
            kind = READ_IN_THE_PAGE[record.id]
            payload = Payload(path=file, source=file, kind=kind, note=note, splats=len(first), frames=len(scene))
            return payload, _Place(first, np.eye(4))
        drawn = _place_of(first) if place is None else _Place(_brought_beside(first, place.cloud), place.world)
        facts: dict[str, Any] = {"source": file, "splats": len(first)}
        is_whole = info.splats in (None, len(first))
        if drawn.cloud is first and is_whole and record.id in READ_IN_THE_PAGE and _is_plain(record.id, info, first):
            return Payload(path=file, kind=READ_IN_THE_PAGE[record.id], **facts), drawn
        packed = target.with_suffix(".gspk")
        cloud = drawn.cloud.replace(origin=np.zeros(3))
        save(cloud, packed, to="spark", spark_encoding="fit", recenter="off", order="none")
    notes = ["in Spark's layout"]
    if not is_whole:
        notes.append(f"without {info.splats - len(first):,} invalid splats")
    if first.sh_degree > _DRAWN_DEGREE:
        notes.append(f"without SH band {first.sh_degree}")
    if drawn.cloud is not first and place is not None:
        notes.append("brought beside the first")
    return Payload(path=packed, kind="gspk", note=", ".join(notes), **facts), drawn


def _unmoved(first: GaussianCloud, place: _Place | None) -> list[str]:
    """Say that a sequence stays where it is, where the first file is drawn elsewhere."""
    is_apart = place is not None and _brought_beside(first, place.cloud) is not first
    return ["not brought beside the first"] if is_apart else []


def _is_plain(format_id: str, info: FileInfo, cloud: GaussianCloud) -> bool:
    """Whether the page reads this file of a format that it knows: Spark 2.2 takes little-endian PLY, SPZ to 3, three bands."""
    if format_id == "spz" and info.version not in {"1", "2", "3"}:
        return False
    if format_id == "ply":
        return "little" in str(info.encoding.get("encoding", info.version)) and cloud.sh_degree <= _DRAWN_DEGREE
    return cloud.sh_degree <= _DRAWN_DEGREE


def _brought_beside(cloud: GaussianCloud, other: GaussianCloud) -> GaussianCloud:
    """Return the cloud in the axes and about the origin of another; the same object where it is there already."""
    systems = (cloud.coordinate_system, other.coordinate_system)
    if "unknown" not in systems and systems[0] != systems[1]:
        cloud = convert_coordinates(cloud, other.coordinate_system)
    return cloud if np.array_equal(cloud.origin, other.origin) else recenter(cloud, other.origin)
