"""meta.json: what it says, and its text.

Fields keep the spelling of the format; see docs/formats/sog4d.md for the table.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.ops.visibility import Tolerance

Float32 = NDArray[np.float32]

FRAME_TOKEN = "{frame}"
AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Segment:
    """Frames whose labels are an image and the changes after it."""

    start_frame: int
    frame_count: int
    base_labels_path: str
    delta_path: str

    def __contains__(self, frame: int) -> bool:
        return self.start_frame <= frame < self.start_frame + self.frame_count


@dataclass(frozen=True, slots=True, kw_only=True)
class PaletteMeta:
    """One SH palette: `name` "shN" over all bands (version 1), or "sh1", "sh2", "sh3" (version 2)."""

    name: str
    coefficients: int
    count: int
    centroids_type: Literal["f16", "f32"]
    centroids_path: str
    labels_path: str | None
    segments: tuple[Segment, ...] = ()

    @property
    def centroids_dtype(self) -> np.dtype[Any]:
        """Little-endian type of the numbers in the centroid file."""
        return np.dtype("<f2" if self.centroids_type == "f16" else "<f4")


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta:
    """What meta.json says, in our spelling; `frame_times` is None for the uniform mapping."""

    version: int
    splat_count: int
    frame_count: int
    frame_times: NDArray[np.float64] | None
    width: int
    height: int
    range_min: Float32
    range_max: Float32
    position_hi_path: str
    position_lo_path: str
    scale_codebook: Float32
    scale_indices_path: str
    rotation_path: str
    bands: int
    sh0_path: str
    sh0_codebook: Float32
    palettes: tuple[PaletteMeta, ...] = ()
    generator: str | None = None
    tolerance: Tolerance | None = None

    def stream_paths(self) -> dict[str, str]:
        """Return the path template of every stream that has an image in every frame, by stream name."""
        paths = {
            "position_hi": self.position_hi_path,
            "position_lo": self.position_lo_path,
            "scale_indices": self.scale_indices_path,
            "rotation": self.rotation_path,
            "sh0": self.sh0_path,
        }
        return paths | {f"{p.name}_labels": p.labels_path for p in self.palettes if p.labels_path is not None}


def frame_path(template: str, frame: int) -> str:
    """Return the path of one frame: the index in decimal, at least five digits."""
    return template.replace(FRAME_TOKEN, f"{frame:05d}")


def meta_text(meta: Meta) -> bytes:
    """Return meta.json: no spaces, float32 numbers in their shortest form, vectors as objects, nothing null."""
    streams: dict[str, Any] = {
        "position": {
            "rangeMin": _vectors(meta.range_min),
            "rangeMax": _vectors(meta.range_max),
            "hiPath": meta.position_hi_path,
            "loPath": meta.position_lo_path,
        },
        "scale": {"codebook": _vectors(meta.scale_codebook), "indicesPath": meta.scale_indices_path},
        "rotation": {"path": meta.rotation_path},
        "sh": {"bands": meta.bands, "sh0Path": meta.sh0_path, "sh0Codebook": list(meta.sh0_codebook)},
    }
    for palette in meta.palettes:
        if meta.version == 1:
            fields = _palette_fields(palette)
            streams["sh"] |= {"shN" + name[0].upper() + name[1:]: value for name, value in fields.items()}
        else:
            streams["sh"][palette.name] = _palette_fields(palette)
    times = meta.frame_times
    root = {
        "format": "sog4d",
        "version": meta.version,
        "generator": meta.generator or "",
        "splatCount": meta.splat_count,
        "frameCount": meta.frame_count,
        "timeMapping": {"type": "uniform"} if times is None else {"type": "explicit", "frameTimesNormalized": list(times)},
        "layout": {"type": "row-major", "width": meta.width, "height": meta.height},
        "streams": streams,
    }
    if meta.tolerance is not None:  # a field of ours, which readers ignore
        root["visualTolerance"] = meta.tolerance.to_json()
    return _text(root).encode()


def _palette_fields(palette: PaletteMeta) -> dict[str, Any]:
    """Return the fields of one palette, without the prefix of version 1."""
    fields: dict[str, Any] = {
        "count": palette.count,
        "centroidsType": palette.centroids_type,
        "centroidsPath": palette.centroids_path,
    }
    if palette.labels_path is not None:
        return fields | {"labelsEncoding": "full", "labelsPath": palette.labels_path}
    segments = [
        {
            "startFrame": segment.start_frame,
            "frameCount": segment.frame_count,
            "baseLabelsPath": segment.base_labels_path,
            "deltaPath": segment.delta_path,
        }
        for segment in palette.segments
    ]
    return fields | {"labelsEncoding": "delta-v1", "deltaSegments": segments}


def _vectors(values: Float32) -> list[dict[str, np.float32]]:
    return [dict(zip(AXES, row, strict=True)) for row in values]


def _text(value: Any) -> str:
    """Return a JSON value without spaces; numpy numbers in the shortest form that reads back to the same bits."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{json.dumps(name)}:{_text(part)}" for name, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_text, value)) + "]"
    if isinstance(value, np.floating):
        return str(value).removesuffix(".0")
    return json.dumps(value)
