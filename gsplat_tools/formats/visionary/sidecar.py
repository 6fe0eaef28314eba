"""The JSON object beside a .vis: which buffers it holds, and the values of Visionary's ModelParams for it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import source_format_of
from gsplat_tools.codecs.visionary_buffers import MAX_SH_DEGREE, ShLayout
from gsplat_tools.errors import CapabilityError, CorruptDataError, GsplatWarning

RenderMode = Literal["color", "normal", "depth"]

IDS = {"f32": "visionary-f32", "f16": "visionary-f16", "i8": "visionary-i8"}
_DATA_TYPES = {"f32": 0, "f16": 1, "i8": 2}
_RENDER_MODES = {"color": 0, "normal": 1, "depth": 2}


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelOptions:
    """Values of Visionary's ModelParams that stand in the sidecar; they change no stored byte.

    Parameters
    ----------
    kernel_size
        Low-pass filter, px^2.
    gaussian_scaling, opacity_scale
        Factors of scales and opacities that the preprocess pass applies.
    cutoff_scale
        Factor of the projected axes, at least 0.1.
    render_mode
        "color", "normal" or "depth".
    base_offset
        Splats of the models before this one, where several share the global buffers.
    """

    kernel_size: float = 0.1
    gaussian_scaling: float = 1.0
    opacity_scale: float = 1.0
    cutoff_scale: float = 1.0
    render_mode: RenderMode = "color"
    base_offset: int = 0

    def __post_init__(self) -> None:
        for name, least in (("kernel_size", 0.0), ("gaussian_scaling", 0.0), ("opacity_scale", 0.0), ("cutoff_scale", 0.1)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise CapabilityError(f"{name} must be finite and at least {least:g}, got {value}")
        if self.render_mode not in get_args(RenderMode):
            raise CapabilityError(f"render_mode must be one of {', '.join(get_args(RenderMode))}, got {self.render_mode!r}")
        if not 0 <= self.base_offset < 1 << 32:
            raise CapabilityError(f"base_offset must be 0 to 2^32 - 1, got {self.base_offset}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sidecar:
    """What the sidecar of a file says about its buffers.

    Parameters
    ----------
    precision
        "f32", "f16" or "i8".
    splats
        Splats, or None where the size of the file has to tell.
    sh_degree
        Highest SH band.
    sh_layout
        "interleaved" or "channel-major".
    raw_color
        Whether the color buffer holds RGB without SH.
    origin
        World position of the means' zero: the translation of the model matrix.
    source_format
        Lossy format that the values went through, or empty.
    params
        ModelParams as they are spelled there.
    """

    precision: str
    splats: int | None = None
    sh_degree: int = MAX_SH_DEGREE
    sh_layout: ShLayout = "interleaved"
    raw_color: bool = False
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    source_format: str = ""
    params: Mapping[str, Any] = field(default_factory=dict)


def compose(
    precision: str,
    splats: int,
    sh_degree: int,
    origin: NDArray[np.float64],
    options: ModelOptions,
    buffers: list[tuple[str, int, int]],
    *,
    sh_layout: ShLayout = "interleaved",
    raw_color: bool = False,
    source_format: str = "",
) -> dict[str, Any]:
    """Return the sidecar of a file that is being written.

    Parameters
    ----------
    precision
        "f32", "f16" or "i8".
    splats, sh_degree
        What the file holds.
    origin
        (3,) world position of the means' zero.
    options
        Values of ModelParams.
    buffers
        Name, offset and bytes a splat of every buffer in the file.
    sh_layout, raw_color
        What the color buffer holds.
    source_format
        Lossy format that the values went through, or empty.
    """
    matrix = np.eye(4)
    matrix[:3, 3] = origin
    return {
        "format": IDS[precision],
        "splats": splats,
        "shDegree": sh_degree,
        "color": "raw" if raw_color else "sh",
        "shLayout": sh_layout,
        **({"sourceFormat": source_format} if source_format else {}),
        "buffers": [{"name": name, "offset": offset, "stride": stride} for name, offset, stride in buffers],
        "modelParams": {
            "model": matrix.T.ravel().tolist(),  # column-major, as in the uniform
            "baseOffset": options.base_offset,
            "num_points": splats,
            "gaussianScaling": options.gaussian_scaling,
            "maxShDeg": sh_degree,
            "kernelSize": options.kernel_size,
            "opacityScale": options.opacity_scale,
            "cutoffScale": options.cutoff_scale,
            "rendermode": _RENDER_MODES[options.render_mode],
            "gaussDataType": _DATA_TYPES[precision],
            "colorDataType": _DATA_TYPES[precision],
            "gaussScale": 1.0,
            "gaussZeroPoint": 0.0,
            "colorScale": 1.0,
            "colorZeroPoint": 0.0,
        },
    }


def parse(companion: Mapping[str, Any], precision: str) -> Sidecar:
    """Return what a sidecar says.

    Raises
    ------
    CorruptDataError
        It is of another format, or a value is not what it must be.

    Warns
    -----
    GsplatWarning
        It holds settings that a scene cannot express.
    """
    if companion.get("format") != IDS[precision]:
        raise CorruptDataError(
            f"the sidecar is of format {companion.get('format')!r}, expected {IDS[precision]!r}", field="format"
        )
    params = companion.get("modelParams", {})
    if not isinstance(params, Mapping):
        raise CorruptDataError("expected an object", field="modelParams")
    splats = companion.get("splats")
    if splats is not None and (type(splats) is not int or splats < 0):
        raise CorruptDataError(f"expected a number of splats, found {splats!r}", field="splats")
    degree = companion.get("shDegree", params.get("maxShDeg", MAX_SH_DEGREE))
    if type(degree) is not int or not 0 <= degree <= MAX_SH_DEGREE:
        raise CorruptDataError(f"expected an SH degree of 0 to {MAX_SH_DEGREE}, found {degree!r}", field="shDegree")
    layout = companion.get("shLayout", "interleaved")
    if layout not in get_args(ShLayout):
        raise CorruptDataError(f"expected one of {', '.join(get_args(ShLayout))}, found {layout!r}", field="shLayout")
    color = companion.get("color", "sh")
    if color not in ("sh", "raw"):
        raise CorruptDataError(f"expected 'sh' or 'raw', found {color!r}", field="color")
    matrix = _matrix(params.get("model", np.eye(4).ravel().tolist()))
    _warn_of_settings(params, matrix)
    return Sidecar(
        precision=precision,
        splats=splats,
        sh_degree=0 if color == "raw" else degree,
        sh_layout=layout,
        raw_color=color == "raw",
        origin=matrix[:3, 3],
        source_format=source_format_of(companion.get("sourceFormat")),
        params=params,
    )


def _matrix(values: Any) -> NDArray[np.float64]:
    """Return the model matrix."""
    try:
        matrix = np.array(values, np.float64).reshape(4, 4).T
    except (TypeError, ValueError, OverflowError) as error:
        raise CorruptDataError("expected 16 numbers, column by column", field="modelParams.model") from error
    if not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise CorruptDataError("expected finite numbers with the last row 0 0 0 1", field="modelParams.model")
    return matrix


def _warn_of_settings(params: Mapping[str, Any], matrix: NDArray[np.float64]) -> None:
    """Warn of settings that change how splats look and that are not applied to what is read."""
    ignored = [
        f"{name} {params[name]}" for name in ("gaussianScaling", "opacityScale", "cutoffScale") if params.get(name, 1) != 1
    ]
    if not np.array_equal(matrix[:3, :3], np.eye(3)):
        ignored.append("the rotation or scale of the model matrix")
    if ignored:
        message = f"splats are read as stored, without {', '.join(ignored)} of the sidecar"
        warnings.warn(GsplatWarning(message, code="model-params"), stacklevel=4)
