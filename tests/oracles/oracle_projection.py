"""One Gaussian to the image plane, in float64."""

import numpy as np


class Camera:
    """A pinhole camera: viewmat takes world to x right, y down, z forward; everything else is in pixels."""

    def __init__(self, viewmat, fx, fy, cx, cy, width, height, near=0.01, far=1000.0):
        self.viewmat = np.asarray(viewmat, np.float64)
        self.fx, self.fy, self.cx, self.cy = float(fx), float(fy), float(cx), float(cy)
        self.width, self.height, self.near, self.far = int(width), int(height), float(near), float(far)

    @property
    def rotation(self):
        return self.viewmat[:3, :3]

    @property
    def position(self):
        return -self.rotation.T @ self.viewmat[:3, 3]


class Projected:
    """Center, covariance and eigenframe of one splat in pixels, before and after the low-pass filter."""

    def __init__(self, camera, view, scales, quat, low_pass, *, tangent_limit=None, shared_focal=False):
        x, y, z = (float(value) for value in view)
        self.z = z
        self.center = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        self.ndc = 2 * self.center / [camera.width, camera.height] - 1
        if tangent_limit is not None:
            limit_x = tangent_limit * camera.width / (2 * camera.fx)
            limit_y = tangent_limit * camera.height / (2 * camera.fy)
            x, y = np.clip(x / z, -limit_x, limit_x) * z, np.clip(y / z, -limit_y, limit_y) * z
        fx, fy = camera.fx, camera.fx if shared_focal else camera.fy
        jacobian = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        # Rows of J W R S: the covariance is their Gram matrix, its determinant the squared area they span.
        m1, m2 = jacobian @ camera.rotation @ rotation_matrix(quat) * scales
        self.det_raw = float(np.sum(np.cross(m1, m2) ** 2))
        trace = float(m1 @ m1 + m2 @ m2)
        self.a, self.b, self.c = float(m1 @ m1) + low_pass, float(m1 @ m2), float(m2 @ m2) + low_pass
        self.det = self.det_raw + low_pass * trace + low_pass**2
        self.mid = (self.a + self.c) / 2
        self.half_gap = float(np.hypot((self.a - self.c) / 2, self.b))
        self.lambda1 = self.mid + self.half_gap
        self.lambda2 = self.det / self.lambda1

    def mahalanobis(self, dx, dy):
        """Return the squared distance in sigmas of pixel offsets from the center."""
        return (self.c * dx * dx - 2 * self.b * dx * dy + self.a * dy * dy) / self.det

    def major_axis(self):
        """Return the unit vector along (b, lambda1 - a) and whether a GPU can know it; (1, 0) where it cannot."""
        if self.b == 0 and self.a >= self.c:
            return np.array([1.0, 0.0]), False
        # lambda1 - a without cancellation.
        half = (self.c - self.a) / 2
        rise = half + self.half_gap if half >= 0 else self.b**2 / (self.half_gap - half)
        vector = np.array([self.b, rise])
        return vector / np.linalg.norm(vector), True


def rotation_matrix(quat):
    """Return the rotation matrix of a quaternion wxyz of any length; zero is the identity."""
    quat = np.asarray(quat, np.float64)
    length = np.linalg.norm(quat)
    w, x, y, z = quat / length if length > 0 else (1.0, 0.0, 0.0, 0.0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
