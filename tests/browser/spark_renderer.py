"""Pictures drawn by the real Spark renderer, as arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats.pack.spark import SparkPack
from tests.browser.chromium import Chromium

TEXTURE_WIDTH = 2048
"""PackedSplats takes whole rows of its texture only (SPLAT_TEX_WIDTH of Spark 2.2.0)."""


class PinholeCamera(Protocol):
    """What a camera must have: gsplat_tools.reference.camera.Camera, or anything like it."""

    viewmat: Any
    K: Any
    width: int
    height: int
    near: float
    far: float


def draw_with_spark(
    browser: Chromium,
    camera: PinholeCamera,
    packed: NDArray[np.uint32],
    sh1: NDArray[np.uint32] | None = None,
    sh2: NDArray[np.uint32] | None = None,
    sh3: NDArray[np.uint32] | None = None,
    *,
    encoding: Mapping[str, float] | None = None,
    options: Mapping[str, Any] | None = None,
    background: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
) -> NDArray[np.uint8]:
    """Draw packed splats with SparkRenderer and return the canvas.

    Parameters
    ----------
    browser
        A running browser.
    camera
        Pinhole camera: viewmat (4, 4) world to camera, axes RDF; K (3, 3) in pixels; near and far in world units.
    packed
        (N, 4) u32, the words of Spark's PackedSplats.
    sh1, sh2, sh3
        (N, 2), (N, 4), (N, 4) u32 words of the SH bands.
    encoding
        Spark's `splatEncoding`: rgbMin, rgbMax, lnScaleMin, lnScaleMax, sh1Max, sh2Max, sh3Max. None: Spark's defaults.
    options
        Options of SparkRenderer under their own names (accumExtSplats, sortRadial, blurAmount, ...). LoD is off by default.
    background
        RGBA 0..1, as bytes of the canvas are to hold it.

    Returns
    -------
    image
        (height, width, 4) u8, top row first: the bytes of the canvas, color multiplied by alpha, no color conversion.
    """
    rows = -(-len(packed) // TEXTURE_WIDTH) * TEXTURE_WIDTH
    padded = np.zeros((rows, 4), "<u4")
    padded[: len(packed)] = packed
    bands = {name: words for name, words in (("sh1", sh1), ("sh2", sh2), ("sh3", sh3)) if words is not None}
    settings = {
        **scene_settings(camera, options=options, background=background),
        "numSplats": len(packed),
        "splatEncoding": dict(encoding) if encoding is not None else None,
    }
    _, pixels = browser.call(
        "drawPacked",
        settings,
        packed=padded.tobytes(),
        **{name: words.astype("<u4").tobytes() for name, words in bands.items()},
    )
    return to_image(pixels, camera)


def draw_pack(
    browser: Chromium, camera: PinholeCamera, pack: SparkPack, *, options: Mapping[str, Any] | None = None
) -> NDArray[np.uint8]:
    """Draw what the package encoded, with the ranges that it encoded with."""
    encoding = {name: value for name, value in pack.encoding.to_json().items() if name != "sh4Max"}
    return draw_with_spark(browser, camera, pack.packed, pack.sh1, pack.sh2, pack.sh3, encoding=encoding, options=options)


def scene_settings(
    camera: PinholeCamera,
    *,
    options: Mapping[str, Any] | None = None,
    background: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
) -> dict[str, Any]:
    """Return what every drawing job needs: camera, options of SparkRenderer, background."""
    return {
        "camera": {
            "viewmat": np.asarray(camera.viewmat, np.float64).ravel().tolist(),
            "K": np.asarray(camera.K, np.float64).ravel().tolist(),
            "width": int(camera.width),
            "height": int(camera.height),
            "near": float(camera.near),
            "far": float(camera.far),
        },
        "options": dict(options or {}),
        "background": list(background),
    }


def to_image(pixels: bytes, camera: PinholeCamera) -> NDArray[np.uint8]:
    """Return the pixels of a drawing job as an array with the top row first."""
    return np.frombuffer(pixels, np.uint8).reshape(camera.height, camera.width, 4)[::-1].copy()


def psnr(pixels: NDArray[np.uint8], image: NDArray[Any]) -> float:
    """Return the PSNR in dB of an image (H, W, 3), 0..1, against the bytes of a canvas (H, W, 4)."""
    error = float(np.mean((pixels[..., :3] / 255 - np.clip(image, 0, 1)) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)
