"""Visionary's preprocess pass, one splat at a time with matrices, in float64; and its quads over a picture.

Camera space is x right, y down, z forward; the projection negates y, so that everything after it has y up.
"""

import numpy as np

from tests.oracles import oracle_sh
from tests.oracles.oracle_projection import rotation_matrix

CUTOFF = 2.3539888583335364


def projection_matrix(camera):
    """Return the projection as a matrix that columns are multiplied by, depths to 0..1, y up."""
    w, h, near, far = camera.width, camera.height, camera.near, camera.far
    return np.array(
        [
            [2 * camera.fx / w, 0, 2 * camera.cx / w - 1, 0],
            [0, -2 * camera.fy / h, -(2 * camera.cy / h - 1), 0],
            [0, 0, far / (far - near), -far * near / (far - near)],
            [0, 0, 1, 0],
        ]
    )


def _stored(values, precision):
    """Return numbers as a buffer of the precision gives them back."""
    with np.errstate(over="ignore"):
        return np.asarray(values).astype(np.float16 if precision == "f16" else np.float32).astype(np.float64)


def _normal(sigma):
    """Return the smallest eigenvector by power iteration on the inverse by cofactors."""
    adjugate = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            minor = np.delete(np.delete(sigma, row, 0), column, 1)
            adjugate[column, row] = (-1) ** (row + column) * (minor[0, 0] * minor[1, 1] - minor[0, 1] * minor[1, 0])
    det = sigma[0] @ adjugate[:, 0]
    inverse = adjugate / (1e-12 if abs(det) < 1e-12 else det)
    vector = inverse.sum(axis=1)
    for _ in range(4):
        length = np.linalg.norm(vector)
        if not length > 0:
            return np.array([0.0, 0.0, 1.0])
        vector = vector / length
        vector, last = inverse @ vector, vector
    return last if last[np.argmax(np.abs(last))] >= 0 else -last


def _distance(value, threshold):
    """Return how far a number is from a threshold, relative to it."""
    return abs(value - threshold) / abs(threshold)


def preprocess(
    scene,
    camera,
    *,
    kernel_size=0.1,
    sh_degree=3,
    raw_color=False,
    precision="f32",
    max_world_trace=None,
    gaussian_scaling=1.0,
    opacity_scale=1.0,
    cutoff_scale=1.0,
    render_mode="color",
    mip=True,
    model_matrix=None,
):
    """Return one dict a record, unrounded, with the index of its splat; and the indices that are close to a threshold.

    Distances to thresholds are relative; the caller says which are too close.
    """
    model = np.eye(4) if model_matrix is None else np.asarray(model_matrix, np.float64)
    linear = model[:3, :3]
    view, projection = np.asarray(camera.viewmat, np.float64), projection_matrix(camera)
    rotation, size = view[:3, :3], np.array([camera.width, camera.height])
    z_far = -projection[2, 3] / (projection[2, 2] - 1)
    records, margins = [], np.full(len(scene["means"]), np.inf)
    for index in range(len(scene["means"])):
        scales = np.exp(scene["log_scales"][index].astype(np.float64))
        factor = rotation_matrix(scene["quats"][index]) * scales
        stored = _stored(factor @ factor.T, precision)
        mean = _stored(scene["means"][index], precision)
        with np.errstate(over="ignore"):
            opacity = 1 / (1 + np.exp(-np.float64(scene["opacity_logits"][index])))
        opacity = _stored(opacity, precision) * opacity_scale
        world = model @ [*mean, 1.0]
        x, y, z, _ = view @ world
        clip = projection @ [x, y, z, 1.0]
        if z == 0:
            continue
        ndc = clip[:3] / clip[3]
        sigma = linear @ (stored * gaussian_scaling**2) @ linear.T
        limits = [(z, camera.near), (z, camera.far), (abs(ndc[0]), 1.2), (abs(ndc[1]), 1.2), (opacity, 0.02)]
        if max_world_trace is not None:
            limits.append((np.trace(sigma), max_world_trace))
        margins[index] = min(_distance(value, threshold) for value, threshold in limits)
        if ndc[2] <= 0 or ndc[2] >= 1 or abs(clip[0]) > 1.2 * clip[3] or abs(clip[1]) > 1.2 * clip[3] or opacity < 0.02:
            continue
        if max_world_trace is not None and np.trace(sigma) > max_world_trace:
            continue
        jacobian = np.array([[camera.fx / z, 0, -camera.fx * x / z**2], [0, -camera.fy / z, camera.fy * y / z**2]])
        cov = jacobian @ rotation @ sigma @ rotation.T @ jacobian.T
        det = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
        blurred = cov + kernel_size * np.eye(2)
        det_blurred = blurred[0, 0] * blurred[1, 1] - cov[0, 1] ** 2
        coef = 1.0
        if mip:
            d0, d1 = max(1e-6, det), max(1e-6, det_blurred)
            coef = 0.0 if d0 <= 1e-6 or d1 <= 1e-6 else np.sqrt(d0 / (d1 + 1e-6) + 1e-6)
            margins[index] = min(margins[index], _distance(det, 1e-6))
        (_, lambda1), vectors = np.linalg.eigh(blurred)
        gap = np.hypot((blurred[0, 0] - blurred[1, 1]) / 2, blurred[0, 1])
        lambda2 = max((blurred[0, 0] + blurred[1, 1]) / 2 - gap, 0.1)
        axis = vectors[:, 1] if vectors[1, 1] >= 0 else -vectors[:, 1]
        has_axis = not (blurred[0, 1] == 0 and blurred[0, 0] >= blurred[1, 1])
        if not has_axis:
            axis = np.array([1.0, 0.0])
        eye = linear.T @ (camera.position - model[:3, 3]) / max(1e-12, np.mean(np.sum(linear**2, axis=0)))
        if render_mode == "normal":
            color = 0.5 * (_normal(sigma) + 1)
        elif render_mode == "depth":
            color = np.full(3, 1 - np.clip(ndc[2], 0, 1))
        elif raw_color:
            color = np.maximum(0, _stored(np.float64(scene["sh0"][index]) * 0.28209479177387814 + 0.5, precision))
        else:
            degree = min(sh_degree, int(np.sqrt(scene["shN"].shape[1] + 1)) - 1)
            sh0, shN = _stored(scene["sh0"][index], precision), _stored(scene["shN"][index], precision)
            color = np.maximum(0, oracle_sh.color(sh0, shN, mean - eye, degree))
        records.append(
            {
                "splat": index,
                "v_0": np.sqrt(2 * lambda1) * axis * cutoff_scale / size,
                "v_1": np.sqrt(2 * lambda2) * np.array([axis[1], -axis[0]]) * cutoff_scale / size,
                "pos": ndc[:2],
                "posz": ndc[2],
                "color": color,
                "opacity": opacity * coef,
                "key": z_far - clip[2],
                "cov": cov,
                "gap": gap / lambda1,
                "det_ratio_scale": (cov[0, 0] * cov[1, 1] + cov[0, 1] ** 2) / det_blurred,
                "coef": coef,
                "full_opacity": opacity,
                "has_axis": has_axis,
            }
        )
    return records, margins


def draw(records, order, width, height):
    """Return the picture and its alphas of records in drawing order: instanced quads, "over", no 8-bit rounding."""
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([2 * columns / width - 1, 1 - 2 * rows / height], axis=-1)
    image, alphas = np.zeros((height, width, 3)), np.zeros((height, width))
    for index in order:
        record = records[index]
        quad = 2 * np.stack([record["v_0"], record["v_1"]], axis=1).astype(np.float64)
        p = (pixels - record["pos"].astype(np.float64)) @ np.linalg.inv(quad).T
        q = np.sum(p * p, axis=-1)
        inside = (q <= 2 * CUTOFF) & (np.abs(p) <= CUTOFF).all(axis=-1)
        alpha = np.where(inside, np.minimum(0.99, np.exp(-q) * np.float64(record["color_1"][1])), 0.0)
        color = np.array([*record["color_0"], record["color_1"][0]], np.float64)
        image = image * (1 - alpha[..., None]) + alpha[..., None] * color
        alphas = alphas * (1 - alpha) + alpha
    return image, alphas
