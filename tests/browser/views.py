"""Cameras of the browser tests."""

from gsplat_tools.reference.camera import Camera


def looking_at_origin(width: int, height: int) -> Camera:
    """Return a camera four units from the origin, a little above it."""
    return Camera.look_at((0.6, -0.8, -4.0), (0.0, 0.0, 0.0), fov_y=45.0, width=width, height=height)
