"""Files as the page takes them: as they are where Spark or the page's own decoders read them, else in Spark's layout."""

from __future__ import annotations

import warnings
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.convert import convert
from gsplat_tools.errors import FormatError, GsplatWarning
from gsplat_tools.formats.base import FileInfo
from gsplat_tools.formats.loading import inspect_file, load
from gsplat_tools.formats.saving import save
from gsplat_tools.ops.coordinates import convert_coordinates
from gsplat_tools.ops.recentering import recenter, without_origin
from gsplat_tools.reference.auto_cameras import auto_cameras, robust_sphere, world_axes
from gsplat_tools.sequence import GaussianSequence

READ_IN_THE_PAGE = {"spark": "gspk", "sog4d": "sog4d", "ply": "ply", "spz": "spz", "sog": "sog", "splat": "splat"}
"""Formats that the page reads by itself, and what it calls them."""

_VIEWS, _SIZE = 8, (1280, 720)


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
    frame: GaussianCloud | None = None
    for index, file in enumerate(files):
        try:
            payload, cloud = _prepare(file, folder / str(index), frame)
        except FormatError as error:
            payloads.append(Payload(path=file, source=file, error=str(error)))
            continue
        payloads.append(payload)
        if frame is None:
            frame = cloud
    return Exhibit(payloads=payloads, view={} if frame is None or len(frame) == 0 else _view_of(frame))


def _prepare(file: Path, target: Path, frame: GaussianCloud | None) -> tuple[Payload, GaussianCloud]:
    """Return a file as the page takes it, and its first frame in the coordinates that the page draws."""
    record, info = inspect_file(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        scene = load(file)
        if isinstance(scene, GaussianCloud) and scene.has_motion:
            baked = target.with_suffix(".sog4d")
            report = convert([file], baked, validation=None)
            moving = load(baked)
            assert isinstance(moving, GaussianSequence)
            note = f"baked to {report.frames} keyframes"
            payload = Payload(path=baked, source=file, kind="sog4d", note=note, splats=report.splats, frames=report.frames)
            return payload, moving.frame(0)
        first = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
        frames = len(scene) if isinstance(scene, GaussianSequence) else 1
        facts: dict[str, Any] = {"source": file, "splats": len(first), "frames": frames}
        moved = None if isinstance(scene, GaussianSequence) else _brought_beside(first, frame)
        if record.id in READ_IN_THE_PAGE and moved is None and _is_plain(record.id, info, first):
            return Payload(path=file, kind=READ_IN_THE_PAGE[record.id], **facts), first.replace(origin=np.zeros(3))
        packed = target.with_suffix(".gspk")
        cloud = first if moved is None else moved
        save(cloud.replace(origin=np.zeros(3)), packed, to="spark", spark_encoding="fit", recenter="off", order="none")
    note = "in Spark's layout" if moved is None else "in Spark's layout, brought beside the first"
    return Payload(path=packed, kind="gspk", note=note, **facts), cloud.replace(origin=np.zeros(3))


def _is_plain(format_id: str, info: FileInfo, cloud: GaussianCloud) -> bool:
    """Whether the page reads this file of a format that it knows: Spark 2.2 takes little-endian PLY, SPZ to 3, three bands."""
    if format_id == "spz" and info.version not in {"1", "2", "3"}:
        return False
    if format_id == "ply":
        return "little" in str(info.encoding.get("encoding", info.version)) and cloud.sh_degree <= 3
    return cloud.sh_degree <= 3


def _brought_beside(cloud: GaussianCloud, frame: GaussianCloud | None) -> GaussianCloud | None:
    """Return the cloud in the axes and about the origin of another, or None where it is there already."""
    if frame is None:
        return None
    moved = cloud
    systems = (cloud.coordinate_system, frame.coordinate_system)
    if "unknown" not in systems and systems[0] != systems[1]:
        moved = convert_coordinates(without_origin(moved), frame.coordinate_system)
    if not np.array_equal(moved.origin, frame.origin):
        moved = recenter(moved, frame.origin)
    return None if moved is cloud else moved


def _view_of(cloud: GaussianCloud) -> dict[str, Any]:
    """Return cameras around a scene, its middle and its direction up."""
    center, _ = robust_sphere(cloud)
    cameras = auto_cameras(cloud, views=_VIEWS, size=_SIZE)
    return {
        "cameras": [camera.to_json() for camera in cameras],
        "center": center.tolist(),
        "up": world_axes(cloud.coordinate_system)[1].tolist(),
    }
