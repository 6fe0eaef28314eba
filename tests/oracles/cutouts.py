"""Cutouts and the order over several scenes, one splat at a time."""

import numpy as np


def survivors(means, cutouts):
    """Return indices of the means that no (matrix, kind, invert) cuts: outside without invert, inside with it."""
    kept = []
    for i, mean in enumerate(means):
        is_cut = False
        for matrix, kind, invert in cutouts:
            if kind == "none":
                continue
            x, y, z = (np.asarray(matrix) @ [*mean, 1.0])[:3]
            is_inside = x * x + y * y + z * z <= 1 if kind == "ellipsoid" else max(abs(x), abs(y), abs(z)) <= 1
            is_cut |= is_inside if invert else not is_inside
        if not is_cut:
            kept.append(i)
    return np.array(kept, np.int64)


def merged_order(scenes, matrices, camera):
    """Return (scene, splat) pairs, far first; ties by scene, then by splat."""
    entries = []
    for scene_id, (means, matrix) in enumerate(zip(scenes, matrices, strict=True)):
        for splat_id, mean in enumerate(means):
            world = (np.asarray(matrix) @ [*mean, 1.0])[:3]
            depth = camera.rotation[2] @ world + camera.viewmat[2, 3]
            entries.append((-float(np.float32(depth)), scene_id, splat_id))
    return [(scene_id, splat_id) for _, scene_id, splat_id in sorted(entries)]
