"""How much a picture loses when splats are drawn in the order of an earlier camera.

Run: python benchmarks/bench_stale_order.py [FILE] [--size WxH]

gsplat-unity sorts every Nth frame: until then the order is that of a camera that stood elsewhere. Here the camera turns,
or moves by a share of its distance from the scene, and the picture in the old order is compared with that in the right one
(PSNR in dB, worst and mean of the automatic views). Sorted by depth along the view (model unity) only turning matters;
sorted by distance (model spark) only moving does.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial

import numpy as np
from bench_render import random_scene
from machine import describe_machine
from numpy.typing import NDArray

import gsplat_tools
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.reference.auto_cameras import auto_cameras
from gsplat_tools.reference.camera import Camera
from gsplat_tools.reference.image_metrics import psnr
from gsplat_tools.reference.rasterizer import render
from gsplat_tools.reference.sorting import Metric, sort_by_depth


def turned_about(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Rotation by an angle about a unit axis."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def turned(camera: Camera, degrees: float) -> Camera:
    """Turn the camera to the right about itself."""
    viewmat = camera.viewmat.copy()
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ turned_about(camera.viewmat[1, :3], degrees).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ camera.position
    return Camera(viewmat, camera.K, camera.width, camera.height, camera.near, camera.far)


def moved(camera: Camera, right: float) -> Camera:
    """Move the camera to the right, world units."""
    viewmat = camera.viewmat.copy()
    viewmat[0, 3] -= right
    return Camera(viewmat, camera.K, camera.width, camera.height, camera.near, camera.far)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?")
    parser.add_argument("--size", default="640x360")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    cloud = random_scene(100_000) if arguments.file is None else gsplat_tools.load(arguments.file)
    assert isinstance(cloud, GaussianCloud)
    cameras = auto_cameras(cloud, size=(width, height))
    # All automatic cameras look at the center: where two lines of sight cross.
    distance = crossing(cameras[0], cameras[1])
    print(describe_machine())
    print(f"{len(cloud):,} splats, {width}x{height}, {len(cameras)} views from a distance of {distance:.2f} units\n")
    print(f"{'':<28} {'unity, by depth':>19} {'spark, by distance':>19}")
    print(f"{'the camera has':<28} {'worst':>9} {'mean':>9} {'worst':>9} {'mean':>9}")
    moves: list[tuple[str, Callable[[Camera], Camera]]] = [
        *((f"turned by {d} degrees", partial(turned, degrees=-d)) for d in (0.25, 0.5, 1, 2, 5, 10, 20, 45)),
        *(
            (f"moved by {p} %, {p / 100 * distance:.3f} units", partial(moved, right=-p / 100 * distance))
            for p in (0.5, 1, 2, 5, 10, 20)
        ),
    ]
    for name, earlier in moves:
        losses = [*loss(cloud, cameras, earlier, "unity", "depth"), *loss(cloud, cameras, earlier, "spark", "radial")]
        print(f"{name:<28} " + " ".join(f"{value:>9.1f}" for value in losses))


def loss(
    cloud: GaussianCloud, cameras: list[Camera], earlier: Callable[[Camera], Camera], model: str, metric: Metric
) -> tuple[float, float]:
    """Return worst and mean PSNR of pictures in the order of an earlier camera; infinite where nothing differs."""
    values = []
    for camera in cameras:
        right = render(cloud, camera, model=model, order=sort_by_depth(cloud, camera, metric=metric)).image
        stale = render(cloud, camera, model=model, order=sort_by_depth(cloud, earlier(camera), metric=metric)).image
        value = psnr(right, stale)
        values.append(math.inf if value is None else value)
    return min(values), float(np.mean(values))


def crossing(a: Camera, b: Camera) -> float:
    """Distance along the view of `a` to the point nearest the view of `b`."""
    u, v, between = a.viewmat[2, :3], b.viewmat[2, :3], b.position - a.position
    along = float(u @ v)
    return float((between @ u - along * (between @ v)) / (1 - along * along))


if __name__ == "__main__":
    main()
