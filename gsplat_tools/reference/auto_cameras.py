"""Cameras that show a scene without being told where it is: a ring around it and a few views from close by."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.reference.camera import Camera

_FOV_Y = 50.0
_MAX_SAMPLES = 100_000
_RING_ELEVATIONS = (12.0, 30.0, -6.0)
"""Degrees above the horizon, taken in turn around the ring."""
_CLOSE_SHARE = 0.25
"""Share of the views that are taken from close by."""
_CLOSE_DISTANCE = 0.45
"""Distance of a close view relative to the ring's."""
_MIN_CLEARANCE = 0.25
"""Distance kept from the bulk of the scene, world units: the 3DGS rasterizer draws nothing nearer than 0.2."""
_EDGE_SHARE = 0.04
"""Share of the opacity that may lie beyond each side of the box."""


def auto_cameras(cloud: GaussianCloud, *, views: int = 8, size: tuple[int, int] = (640, 360)) -> list[Camera]:
    """Return cameras around a scene: the same for the same scene.

    Parameters
    ----------
    cloud
        The scene; its coordinate system gives the direction up, (0, -1, 0) where it is unknown.
    views
        Number of cameras: three quarters on a ring that shows the whole scene, the rest closer.
    size
        (width, height) of the pictures, pixels.

    Returns
    -------
    list of Camera
        In world coordinates (origin + means). Left-handed systems get cameras with a reflection, so that the pictures
        are not mirrored.

    Raises
    ------
    ValueError
        `views` is below 1.

    Notes
    -----
    Center: the middle of the box that holds all but 4 % of the opacity on each side. Radius: the opacity-weighted 95th
    percentile of the distance from it, so that a few far splats change nothing. Splats that are not finite are left out.
    The field of view is 50 degrees, or less for scenes so small that a camera would come closer than 0.25 units.
    """
    if views < 1:
        raise ValueError(f"views must be at least 1, got {views}")
    center, radius = robust_sphere(cloud)
    axes = world_axes(cloud.coordinate_system)
    width, height = size
    # The sphere fits the narrower side of the picture.
    half_fov = math.atan(math.tan(math.radians(_FOV_Y) / 2) * min(1.0, width / height))
    num_close = int(views * _CLOSE_SHARE)
    num_ring = views - num_close
    ring = radius / math.sin(half_fov)
    directions = [(2 * math.pi * i / num_ring, _RING_ELEVATIONS[i % 3], ring) for i in range(num_ring)]
    directions += [
        (2 * math.pi * (i + 0.5) / num_close, _RING_ELEVATIONS[i % 2], _CLOSE_DISTANCE * ring) for i in range(num_close)
    ]
    cameras = []
    for azimuth, elevation, wanted in directions:
        distance = max(wanted, _MIN_CLEARANCE + radius) if radius < _MIN_CLEARANCE else wanted
        # Farther away than wanted, the view narrows to keep the scene as large.
        fov_y = 2 * math.degrees(math.atan(math.tan(math.radians(_FOV_Y) / 2) * wanted / distance))
        eye = center + distance * _outward(axes, azimuth, math.radians(elevation))
        planes = {"near": 0.01 * radius, "far": 1000.0 * max(radius, distance)}
        camera = Camera.look_at(eye, center, axes[1], fov_y=fov_y, width=width, height=height, **planes)
        cameras.append(_mirrored(camera) if np.linalg.det(axes) < 0 else camera)
    return cameras


def _outward(axes: NDArray[np.float64], azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Return the unit vector from the center to a camera; angles in radians."""
    right, up, back = axes
    level = math.sin(azimuth) * right + math.cos(azimuth) * back
    outward: NDArray[np.float64] = math.cos(elevation) * level + math.sin(elevation) * up
    return outward


def _mirrored(camera: Camera) -> Camera:
    """Return the camera with its x axis reversed."""
    viewmat = camera.viewmat.copy()
    viewmat[0] = -viewmat[0]
    return Camera(viewmat, camera.K, camera.width, camera.height, camera.near, camera.far)


def robust_sphere(cloud: GaussianCloud) -> tuple[NDArray[np.float64], float]:
    """Return center and radius of the visible bulk of a scene, in world coordinates."""
    step = max(1, -(-len(cloud) // _MAX_SAMPLES))
    means = cloud.means[::step].astype(np.float64)
    logits = cloud.opacity_logits[::step].astype(np.float64)
    keeps = np.isfinite(means).all(axis=1) & ~np.isnan(logits)
    means, logits = means[keeps], logits[keeps]
    weights = 1.0 / (1.0 + np.exp(-np.clip(logits, -700, 700)))
    if not weights.sum() > 0:
        weights = np.ones(len(means))
    if len(means) == 0:
        return cloud.origin.copy(), 1.0
    low, high = (
        np.array([_weighted_quantile(means[:, axis], weights, share) for axis in range(3)])
        for share in (_EDGE_SHARE, 1 - _EDGE_SHARE)
    )
    center = (low + high) / 2
    radius = _weighted_quantile(np.linalg.norm(means - center, axis=1), weights, 0.95)
    if radius <= 0:
        # One splat, or all in one place: its size is what there is to see.
        sizes = cloud.log_scales[np.isfinite(cloud.log_scales).all(axis=1)]
        radius = float(3 * np.exp(np.clip(np.median(sizes), -20, 20))) if len(sizes) else 1.0
    return cloud.origin + center, radius


def _weighted_quantile(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    """Return the smallest value below or at which `share` of the weight lies."""
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(cumulative, share * cumulative[-1])]])


def world_axes(coordinate_system: str) -> NDArray[np.float64]:
    """Return the directions right, up and back in the world of an axis-letter system; RDF where it is unknown."""
    rows = {"R": (0, 1), "L": (0, -1), "U": (1, 1), "D": (1, -1), "B": (2, 1), "F": (2, -1)}
    letters = coordinate_system if {rows.get(c, (9, 0))[0] for c in coordinate_system} == {0, 1, 2} else "RDF"
    axes = np.zeros((3, 3))
    for column, letter in enumerate(letters):
        row, sign = rows[letter]
        axes[row, column] = sign
    return axes
