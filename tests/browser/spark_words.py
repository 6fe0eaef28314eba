"""Words of the Spark layout to plain numbers, from specs and the renderer's source, sharing nothing with the package."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

BANDS = {"sh1": (9, 7), "sh2": (15, 8), "sh3": (21, 6)}
"""Number of values and bits of each in the words of a band."""


def unpack_splats(
    packed: NDArray[np.uint32], sh: dict[str, NDArray[np.uint32]], encoding: dict[str, float]
) -> dict[str, NDArray[Any]]:
    """Return the splats as tests/oracles takes them: stored values, so logarithms, logits and SH coefficients."""
    rows = np.ascontiguousarray(packed, "<u4").view(np.uint8).reshape(-1, 16)
    rgb = rows[:, 0:3] / 255 * (encoding["rgbMax"] - encoding["rgbMin"]) + encoding["rgbMin"]
    alphas = rows[:, 3] / 255
    step = (encoding["lnScaleMax"] - encoding["lnScaleMin"]) / 254
    with np.errstate(divide="ignore"):
        logits = np.log(alphas) - np.log1p(-alphas)
    log_scales = np.where(rows[:, 12:15] == 0, -np.inf, encoding["lnScaleMin"] + (rows[:, 12:15] - 1.0) * step)
    bands = [unpack_band(words, *BANDS[name]) * encoding[f"{name}Max"] for name, words in sh.items()]
    coefficients = np.concatenate(bands, 1) if bands else np.zeros((len(rows), 0))
    return {
        "means": np.ascontiguousarray(rows[:, 4:10]).view("<f2").astype(np.float64),
        "log_scales": log_scales,
        "quats": unpack_rotations(rows[:, 10], rows[:, 11], rows[:, 15]),
        "opacity_logits": logits,
        "sh0": (rgb - 0.5) / 0.28209479177387814,
        "shN": coefficients.reshape(len(rows), -1, 3),
    }


def unpack_rotations(u: NDArray[np.uint8], v: NDArray[np.uint8], angle: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return quaternions wxyz of an octahedral axis and an angle in 255ths of half a turn."""
    x, y = 2 * (u / 255) - 1, 2 * (v / 255) - 1
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0)
    axis = np.stack([x - np.where(x >= 0, fold, -fold), y - np.where(y >= 0, fold, -fold), z], 1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = np.pi / 2 * angle / 255
    return np.concatenate([np.cos(half)[:, None], axis * np.sin(half)[:, None]], 1)


def unpack_band(words: NDArray[np.uint32], num_values: int, num_bits: int) -> NDArray[np.float64]:
    """Return the signed values of a band as parts of its range: value i lies in bits i num_bits and up, least first."""
    bits = np.unpackbits(np.ascontiguousarray(words, "<u4").view(np.uint8).reshape(len(words), -1), axis=1, bitorder="little")
    digits = bits[:, : num_values * num_bits].reshape(len(words), num_values, num_bits)
    weights = 2.0 ** np.arange(num_bits)
    weights[-1] *= -1
    return digits @ weights / (2 ** (num_bits - 1) - 1)
