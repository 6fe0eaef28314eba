import numpy as np
import pytest

from gsplat_tools.kernels import rotation_frames

pytestmark = pytest.mark.uncompiled


def matrices(quats):
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)


def test_frame_quats__are_the_24_rotations_of_a_cube():
    found = {tuple(matrix.round().astype(int).ravel()) for matrix in matrices(rotation_frames.FRAME_QUATS)}

    assert len(found) == 24
    for flat in found:
        matrix = np.array(flat).reshape(3, 3)
        assert np.linalg.det(matrix) == 1
        assert (np.abs(matrix).sum(axis=0) == 1).all()
        assert (np.abs(matrix).sum(axis=1) == 1).all()
    np.testing.assert_array_equal(rotation_frames.FRAME_QUATS[0], [1, 0, 0, 0])
    np.testing.assert_array_equal(rotation_frames.FRAME_AXES[0], [0, 1, 2])


def test_apply_frames__leaves_covariances_as_they_are():
    rng = np.random.default_rng(0)
    quats = np.repeat(rng.normal(size=(20, 4)), 24, axis=0).astype(np.float32)
    log_scales = np.repeat(rng.normal(size=(20, 3)), 24, axis=0).astype(np.float32)
    frames = np.tile(np.arange(24, dtype=np.uint8), 20)
    new_quats, new_log_scales = quats.copy(), log_scales.copy()

    rotation_frames.apply_frames(new_quats, new_log_scales, frames, new_quats, new_log_scales)

    before, after = (
        matrices(q.astype(np.float64)) * np.exp(s.astype(np.float64))[:, None, :]
        for q, s in ((quats, log_scales), (new_quats, new_log_scales))
    )
    np.testing.assert_allclose(after @ after.transpose(0, 2, 1), before @ before.transpose(0, 2, 1), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(new_quats, axis=1), np.linalg.norm(quats, axis=1), rtol=1e-6)


def test_frames_of_largest_w__finds_the_smallest_turn():
    quats = np.random.default_rng(1).normal(size=(1000, 4)).astype(np.float32)
    frames = np.empty(1000, np.uint8)

    rotation_frames.frames_of_largest_w(quats, frames)

    # The product's real part is the scalar product with the conjugate.
    products = np.abs(quats.astype(np.float64) @ (rotation_frames.FRAME_QUATS * [1, -1, -1, -1]).T)
    np.testing.assert_allclose(products[np.arange(1000), frames], products.max(axis=1), rtol=2e-6)


def test_frames_of_largest_w__keeps_the_first_frame_on_ties():
    quats = np.array([[1, 1, 1, 1], [1, 1, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]], np.float32)
    frames = np.empty(4, np.uint8)

    rotation_frames.frames_of_largest_w(quats, frames)

    assert rotation_frames.FRAME_QUATS[frames[2]].tolist() == [0, 0, 0, 1]
    assert frames[3] == 0
    products = np.abs(quats.astype(np.float64) @ (rotation_frames.FRAME_QUATS * [1, -1, -1, -1]).T)
    firsts = [int(np.flatnonzero(row >= row.max() * (1 - 1e-7))[0]) for row in products]
    assert frames.tolist() == firsts
