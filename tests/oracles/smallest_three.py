"""Rotation codes of .spz and compressed.ply, one quaternion at a time, as their descriptions read."""

from __future__ import annotations

import numpy as np

SQRT_HALF = np.sqrt(0.5)


def pack_signed(quat: np.ndarray) -> int:
    """SPZ 3: two bits of the index in x y z w, then sign and nine bits of each other component."""
    x, y, z, w = quat[1], quat[2], quat[3], quat[0]
    q = np.array([x, y, z, w], np.float64) / np.linalg.norm(quat.astype(np.float64))
    largest = int(np.argmax(np.abs(q)))
    if q[largest] < 0:
        q = -q
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | (512 if q[i] < 0 else 0) | int(511 * abs(q[i]) / SQRT_HALF + 0.5)
    return word


def unpack_signed(word: int) -> np.ndarray:
    """Return wxyz."""
    largest = word >> 30
    fields = [word >> 20 & 1023, word >> 10 & 1023, word & 1023]
    others = [(-1 if field & 512 else 1) * (field & 511) / 511 * SQRT_HALF for field in fields]
    made = np.sqrt(max(0.0, 1 - sum(value * value for value in others)))
    xyzw = [*others[:largest], made, *others[largest:]]
    quat = np.array([xyzw[3], *xyzw[:3]])
    return quat / np.linalg.norm(quat)


def pack_unsigned(quat: np.ndarray) -> int:
    """compressed.ply: two bits of the index in w x y z, then ten bits of each other component."""
    q = quat.astype(np.float64) / np.linalg.norm(quat.astype(np.float64))
    largest = int(np.argmax(np.abs(q)))
    if q[largest] < 0:
        q = -q
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | int(np.floor((q[i] * SQRT_HALF + 0.5) * 1023 + 0.5))
    return word


def unpack_unsigned(word: int) -> np.ndarray:
    """Return wxyz."""
    largest = word >> 30
    fields = [word >> 20 & 1023, word >> 10 & 1023, word & 1023]
    others = [(field / 1023 - 0.5) * np.sqrt(2) for field in fields]
    made = np.sqrt(max(0.0, 1 - sum(value * value for value in others)))
    quat = np.array([*others[:largest], made, *others[largest:]])
    return quat / np.linalg.norm(quat)


def pack_first_three(quat: np.ndarray) -> tuple[int, int, int]:
    """SPZ 1 and 2: x y z, w not negative."""
    q = quat.astype(np.float64) / np.linalg.norm(quat.astype(np.float64))
    q = -q if q[0] < 0 else q
    x, y, z = (int(np.floor(127.5 * value + 127.5 + 0.5)) for value in q[1:])
    return x, y, z


def unpack_first_three(codes: np.ndarray) -> np.ndarray:
    """Return wxyz."""
    xyz = codes.astype(np.float64) / 127.5 - 1
    quat = np.array([np.sqrt(max(0.0, 1 - (xyz * xyz).sum())), *xyz])
    return quat / np.linalg.norm(quat)


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """(3, 3) of a quaternion wxyz of any length."""
    w, x, y, z = quat.astype(np.float64) / np.linalg.norm(quat.astype(np.float64))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def covariance(quat: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """(3, 3) of a Gaussian."""
    axes = rotation_matrix(quat) * np.exp(log_scales.astype(np.float64))
    return axes @ axes.T
