"""Camera: a pinhole camera, and reading lists of cameras from JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_tools.errors import CorruptDataError

_ORTHOGONALITY_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera with axes RDF: x right, y down, z forward.

    Parameters
    ----------
    viewmat
        (4, 4) float64, world to camera: rotation (a reflection is allowed, for left-handed worlds) and translation.
    K
        (3, 3) float64 intrinsics in pixels: fx, fy on the diagonal, cx, cy in the last column, no skew. The center of
        pixel (i, j) lies at (i + 0.5, j + 0.5).
    width, height
        Size of the image in pixels.
    near, far
        Distances of the clipping planes along z, world units; each rendering model says what they do.

    Raises
    ------
    ValueError
        A shape, a size, the rotation or the order of the planes is wrong.
    """

    viewmat: NDArray[np.float64]
    K: NDArray[np.float64]
    width: int
    height: int
    near: float = 0.01
    far: float = 1000.0

    def __post_init__(self) -> None:
        for name, shape in (("viewmat", (4, 4)), ("K", (3, 3))):
            values = np.array(getattr(self, name), np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(f"{name} must hold {shape} finite numbers, got shape {values.shape}")
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        rotation = self.viewmat[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHOGONALITY_TOLERANCE:
            raise ValueError("the upper 3x3 of viewmat must be a rotation, its rows are not orthonormal")
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError(f"focal lengths must be positive, got {self.K[0, 0]} and {self.K[1, 1]}")
        if self.K[0, 1] != 0:
            raise ValueError(f"skew is not supported, got K[0, 1] = {self.K[0, 1]}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"the image must have at least one pixel, got {self.width}x{self.height}")
        if not 0 < self.near < self.far:
            raise ValueError(f"expected 0 < near < far, got {self.near} and {self.far}")

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        up: ArrayLike = (0.0, -1.0, 0.0),
        *,
        fov_y: float,
        width: int,
        height: int,
        near: float = 0.01,
        far: float = 1000.0,
    ) -> Camera:
        """Return the camera at `eye` that looks at `target`.

        Parameters
        ----------
        eye, target
            (3,) world units.
        up
            (3,) direction that points up in the picture. Where it is parallel to the view, another axis is taken.
        fov_y
            Vertical field of view, degrees; pixels are square.
        width, height
            Size of the image in pixels.
        near, far
            Distances of the clipping planes, world units.

        Raises
        ------
        ValueError
            Eye and target coincide, or the field of view is not between 0 and 180 degrees.
        """
        if not 0 < fov_y < 180:
            raise ValueError(f"fov_y must lie between 0 and 180 degrees, got {fov_y}")
        eye = np.asarray(eye, np.float64)
        forward = np.asarray(target, np.float64) - eye
        length = np.linalg.norm(forward)
        if not length > 0:
            raise ValueError(f"eye and target must differ, both are {eye}")
        forward = forward / length
        right = np.cross(forward, np.asarray(up, np.float64))
        if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(up):
            # Looking along `up`: the axis least aligned with the view serves instead.
            right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ eye
        focal = 0.5 * height / math.tan(math.radians(fov_y) / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return cls(viewmat, K, int(width), int(height), float(near), float(far))

    @property
    def position(self) -> NDArray[np.float64]:
        """Place of the camera in the world, (3,)."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        position: NDArray[np.float64] = -rotation.T @ translation
        return position

    def resize(self, width: int, height: int) -> Camera:
        """Return this camera with another image size; the horizontal field of view changes with the aspect."""
        scale = height / self.height
        K = self.K.copy()
        K[:2, :2] *= scale
        K[0, 2] = self.K[0, 2] / self.width * width
        K[1, 2] = self.K[1, 2] * scale
        return Camera(self.viewmat, K, width, height, self.near, self.far)

    def to_json(self) -> dict[str, Any]:
        """Return the camera as an object that `parse_cameras` reads."""
        return {
            "viewmat": self.viewmat.tolist(),
            "K": self.K.tolist(),
            "width": self.width,
            "height": self.height,
            "near": self.near,
            "far": self.far,
        }


def load_cameras(path: str | Path) -> list[Camera]:
    """Read a JSON list of cameras.

    Raises
    ------
    CorruptDataError
        The file is not JSON, or not a list of cameras; see `parse_cameras`.
    """
    path = Path(path)
    try:
        return parse_cameras(json.loads(path.read_bytes()))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CorruptDataError(f"expected JSON: {error}", path=path) from error
    except CorruptDataError as error:
        error.path = path
        raise


def parse_cameras(document: Any) -> list[Camera]:
    """Return the cameras of a JSON document.

    Parameters
    ----------
    document
        One camera, a list of cameras, or an object with a list under "cameras". A camera is either our own form
        {viewmat, K, width, height[, near, far]}, a view {eye, target[, up], fov_y, width, height[, near, far]}, or an
        entry of the cameras.json that 3DGS training writes {position, rotation, fx, fy, width, height}.

    Raises
    ------
    CorruptDataError
        An entry is none of these, or its values make no camera; the field names the entry.

    Source
    ------
    cameras.json: `camera_to_JSON` of graphdeco-inria/gaussian-splatting; `rotation` holds camera-to-world rows, so
    that its columns are the axes of the camera (right, down, forward) in the world.
    """
    if isinstance(document, Mapping) and "cameras" in document:
        document = document["cameras"]
    entries = document if isinstance(document, Sequence) and not isinstance(document, str) else [document]
    return [_parse_camera(entry, f"cameras[{index}]") for index, entry in enumerate(entries)]


def _parse_camera(entry: Any, field: str) -> Camera:
    """Return one camera of a JSON document."""
    if not isinstance(entry, Mapping):
        raise CorruptDataError(f"expected an object, found {type(entry).__name__}", field=field)
    try:
        size: dict[str, Any] = {"width": int(entry["width"]), "height": int(entry["height"])}
        planes: dict[str, Any] = {name: float(entry[name]) for name in ("near", "far") if name in entry}
        if "viewmat" in entry:
            return Camera(np.array(entry["viewmat"], np.float64), np.array(entry["K"], np.float64), **size, **planes)
        if "eye" in entry:
            up = entry.get("up", (0.0, -1.0, 0.0))
            return Camera.look_at(entry["eye"], entry["target"], up, fov_y=float(entry["fov_y"]), **size, **planes)
        if "rotation" in entry:
            viewmat = np.eye(4)
            viewmat[:3, :3] = np.array(entry["rotation"], np.float64).reshape(3, 3).T
            viewmat[:3, 3] = -viewmat[:3, :3] @ np.array(entry["position"], np.float64).reshape(3)
            fx, fy = float(entry["fx"]), float(entry["fy"])
            K = np.array([[fx, 0, size["width"] / 2], [0, fy, size["height"] / 2], [0, 0, 1]])
            return Camera(viewmat, K, **size, **planes)
    except KeyError as error:
        raise CorruptDataError(f"needs {error.args[0]!r}, found {', '.join(sorted(entry))}", field=field) from error
    except (TypeError, ValueError) as error:
        raise CorruptDataError(str(error), field=field) from error
    raise CorruptDataError(f"needs viewmat, eye or rotation, found {', '.join(sorted(map(str, entry)))}", field=field)
