"""Small scenes for comparing renderers, as dicts of float32 arrays, each with what makes it hard."""

import numpy as np

from tests.oracles.oracle_projection import Camera

WIDTH, HEIGHT = 64, 48


def camera(*, fx=60.0, fy=60.0, near=0.05, far=100.0, width=WIDTH, height=HEIGHT):
    """Return a camera 4 units from the scene that is turned about all three axes."""
    angle, tilt = 0.4, 0.3
    yaw = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pitch = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = pitch @ yaw
    viewmat[:3, 3] = [0.1, -0.2, 4.0]
    return Camera(viewmat, fx, fy, width / 2, height / 2, width, height, near, far)


def _base(rng, count, degree=3):
    return {
        "means": rng.normal(size=(count, 3)) * [1.2, 0.9, 1.0],
        "log_scales": rng.uniform(np.log(0.02), np.log(0.3), (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        # Below 254.5/255: how Spark stretches an opacity of 1 is a rule of its own.
        "opacity_logits": rng.uniform(-4, 4, count),
        "sh0": rng.normal(size=(count, 3)),
        "shN": rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)) * 0.15,
    }


def mixed(seed):
    """Everything moderate."""
    return _base(np.random.default_rng(seed), 120)


def needles(seed):
    """One axis long, two well below a pixel."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 80)
    scene["log_scales"] = np.stack([rng.uniform(-2, 0, 80), np.full(80, -5.0), rng.uniform(-5, -3.5, 80)], axis=1)
    return scene


def discs(seed):
    """One flat axis, some without any extent."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 80)
    scene["log_scales"][:, 1] = np.where(rng.uniform(size=80) < 0.5, -np.inf, -9.0)
    return scene


def isotropic(seed):
    """Three equal scales."""
    scene = _base(np.random.default_rng(seed), 100)
    scene["log_scales"][:] = scene["log_scales"][:, :1]
    return scene


def tiny(seed):
    """From a thousandth of a pixel to a pixel: the low-pass filter decides."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 150)
    scene["log_scales"] = rng.uniform(np.log(1e-4), np.log(0.05), (150, 3))
    scene["opacity_logits"] = rng.uniform(-1, 5, 150)
    return scene


def huge(seed):
    """Sigmas up to 1e3 px: far wider than the picture."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 15)
    scene["log_scales"] = rng.uniform(np.log(0.5), np.log(40.0), (15, 3))
    scene["opacity_logits"] = rng.uniform(-3, 1, 15)
    return scene


def edges(seed):
    """Around the camera: behind it, close before it, at the edges of the frustum, beyond the far plane."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 150)
    view = rng.uniform([-1.5, -1.2, -0.3], [1.5, 1.2, 1.0], (150, 3))
    depth = np.where(rng.uniform(size=150) < 0.2, rng.uniform(80, 120, 150), rng.uniform(0.0, 6.0, 150))
    view = np.stack([view[:, 0] * depth, view[:, 1] * depth, np.where(view[:, 2] < 0, -depth, depth)], axis=1)
    cam = camera()
    scene["means"] = (view - cam.viewmat[:3, 3]) @ cam.rotation
    scene["log_scales"] = np.log(np.abs(view[:, 2:]) + 1e-3) + rng.uniform(-5, -2, (150, 3))
    return scene


def extremes(seed):
    """Opacities from nothing to nearly one, colors far out of range, all of degree 4."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 120, degree=4)
    scene["opacity_logits"] = rng.choice([-9.0, -6.3, -5.0, -3.95, -3.8, 0.0, 4.0, 5.5, -np.inf], 120)
    scene["sh0"] *= 4
    scene["shN"] *= 4
    return scene


def unnormalized(seed):
    """Quaternions of any length."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 60, degree=1)
    scene["quats"] *= np.exp(rng.uniform(-10, 10, (60, 1)))
    return scene


def moving(seed):
    """Motion with windows of time."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 100, degree=0)
    scene["velocities"] = rng.normal(size=(100, 3))
    scene["times"] = rng.uniform(0, 0.8, 100)
    scene["durations"] = rng.uniform(0.05, 0.5, 100)
    return scene


def aligned(seed):
    """Axes along those of `straight_camera`, splats on the optical axis: their eigenvectors are undefined."""
    rng = np.random.default_rng(seed)
    scene = _base(rng, 12)
    scene["means"] = np.stack([np.zeros(12), np.zeros(12), np.linspace(2, 6, 12)], axis=1)
    scene["quats"] = np.tile([1.0, 0, 0, 0], (12, 1))
    scene["log_scales"][:6] = scene["log_scales"][:6, :1]
    return scene


def straight_camera():
    """Return a camera at the origin that looks along +z."""
    return Camera(np.eye(4), 60.0, 60.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, 0.05, 100.0)


SCENES = {
    function.__name__: function for function in (mixed, needles, discs, isotropic, tiny, huge, edges, extremes, unnormalized)
}


def as_float32(scene):
    """Return the arrays as a cloud would hold them."""
    return {name: np.asarray(values, np.float32) for name, values in scene.items()}
