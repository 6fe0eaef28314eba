"""meta.json of both versions, as tables from a byte to a value; version 1 has ranges where version 2 has codebooks."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import SplatModel
from gsplat_tools.formats import _json
from gsplat_tools.formats._issues import Issue
from gsplat_tools.formats._zip import is_relative_name
from gsplat_tools.formats.sog.rules import CODEBOOK_SIZE, MAX_PALETTE, fault
from gsplat_tools.ops.visibility import Tolerance, tolerance_from_json

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

META_NAME = "meta.json"

_FILES = {
    "means": ("means_l", "means_u"),
    "scales": ("scales",),
    "quats": ("quats",),
    "sh0": ("sh0",),
    "shN": ("shN_centroids", "shN_labels"),
}
_MAX_LOG = 88.73  # exp of more does not fit float32


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta:
    """What meta.json says.

    Parameters
    ----------
    version
        1 or 2.
    count
        Splats.
    means_low, means_high
        (3,) range of sign(x) ln(1 + |x|).
    scales
        (3, E) log scale of each byte, per axis.
    sh0
        (3, E) coefficient of each byte, per channel.
    opacities
        (256,) logit of each byte.
    shn
        (E,) coefficient of each byte; empty without SH.
    bands
        SH bands; None in version 1, where the width of the image tells.
    palette_count
        Entries of the SH palette; None in version 1, where the height of the image bounds them.
    files
        Names of the images by stream name, as `_FILES` has them.
    splat_model
        As `GaussianCloud` has it.
    generator
        Who wrote the file, or empty.
    tolerance
        What it was written with, where a writer of ours says so.
    issues
        What is less than an error.
    """

    version: int
    count: int
    means_low: Float64
    means_high: Float64
    scales: Float32
    sh0: Float32
    opacities: Float32
    shn: Float32 = field(default_factory=lambda: np.zeros(0, np.float32))
    bands: int | None = 0
    palette_count: int | None = 0
    files: dict[str, str]
    splat_model: SplatModel = "default"
    generator: str = ""
    tolerance: Tolerance | None = None
    issues: list[Issue] = field(default_factory=list)

    @property
    def has_rest(self) -> bool:
        """Whether there is an SH palette."""
        return self.bands != 0


def parse_json(data: bytes, name: str, available: int = 0) -> dict[str, Any]:
    """Return a JSON object; `available` bytes of what it describes bound the memory that it may take.

    Raises
    ------
    CorruptDataError
        The bytes are something else.
    """
    try:
        root = _json.parse(data, available=available)
    except ValueError as error:
        raise fault("meta-json", f"expected a JSON object ({error})", name) from error
    if not isinstance(root, dict):
        raise fault("meta-json", f"expected a JSON object, found {type(root).__name__}", name)
    return root


def parse_meta(data: bytes, name: str = META_NAME, *, available: int = 0) -> Meta:
    """Return what meta.json says.

    Parameters
    ----------
    data
        The file.
    name
        What errors call it.
    available
        Bytes of its archive, which bound the memory that it may take.

    Raises
    ------
    CorruptDataError
        It breaks a rule of docs/formats/sog.md.
    UnsupportedVersionError
        It is of another version.
    """
    root = Fields(parse_json(data, name, available), name)
    version = root.value.get("version")
    if version is None and "version" not in root.value:
        return _version_1(root)
    if version != 2 or isinstance(version, bool):
        raise fault("version", f"expected version 2, or none for version 1, found {_json.shown(version)}", root.at("version"))
    return _version_2(root)


def _version_2(root: Fields) -> Meta:
    parts = {key: root.child(key) for key in ("means", "scales", "quats", "sh0")}
    shn = root.child("shN") if root.value.get("shN") is not None else None
    bands = 0 if shn is None else shn.integer("bands")
    if not 0 <= bands <= 3:
        raise fault("bands", f"expected 0 to 3 SH bands, found {bands}", root.at("shN.bands"))
    has_rest = shn is not None and bands > 0
    palette_count = shn.integer("count") if shn is not None and has_rest else 0
    if has_rest and not 1 <= palette_count <= MAX_PALETTE:
        message = f"expected 1 to {MAX_PALETTE} palette entries, found {palette_count}"
        raise fault("palette-count", message, root.at("shN.count"))
    low, high = _means_range(parts["means"])
    issues: list[Issue] = []
    with np.errstate(divide="ignore"):
        opacities = np.clip(np.arange(256) / 255, 1e-6, 1 - 1e-6)
    return Meta(
        version=2,
        count=root.integer("count"),
        means_low=low,
        means_high=high,
        scales=np.broadcast_to(parts["scales"].codebook(), (3, len(parts["scales"].codebook()))),
        sh0=np.broadcast_to(parts["sh0"].codebook(), (3, len(parts["sh0"].codebook()))),
        opacities=(np.log(opacities) - np.log1p(-opacities)).astype(np.float32),
        shn=shn.codebook() if shn is not None and has_rest else np.zeros(0, np.float32),
        bands=bands,
        palette_count=palette_count,
        files=_files({**parts, **({"shN": shn} if shn is not None and has_rest else {})}),
        splat_model=_splat_model(root.value, issues),
        generator=_generator(root.value),
        tolerance=tolerance_from_json(root.value.get("visualTolerance")),
        issues=issues,
    )


def _version_1(root: Fields) -> Meta:
    parts = {key: root.child(key) for key in ("means", "scales", "quats", "sh0")}
    if root.value.get("shN") is not None:
        parts["shN"] = root.child("shN")
    shape = parts["means"].value.get("shape")
    count = shape[0] if isinstance(shape, list) and shape else None
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise fault("count", f"expected a shape that starts with a count, found {_json.shown(shape)}", root.at("means.shape"))
    encoding = parts["quats"].value.get("encoding", "quaternion_packed")
    if encoding != "quaternion_packed":
        raise fault("quats-encoding", f'expected "quaternion_packed", found {_json.shown(encoding)}', root.at("quats.encoding"))
    low, high = _means_range(parts["means"])
    colors = parts["sh0"].ramps(4)
    issues: list[Issue] = []
    return Meta(
        version=1,
        count=count,
        means_low=low,
        means_high=high,
        scales=parts["scales"].ramps(3),
        sh0=colors[:3],
        opacities=colors[3],
        shn=parts["shN"].ramps(None)[0] if "shN" in parts else np.zeros(0, np.float32),
        bands=None if "shN" in parts else 0,
        palette_count=None if "shN" in parts else 0,
        files=_files(parts),
        splat_model=_splat_model(root.value, issues),
        generator=_generator(root.value),
        issues=issues,
    )


def _means_range(means: Fields) -> tuple[Float64, Float64]:
    low, high = means.numbers("mins", 3), means.numbers("maxs", 3)
    if (low > high).any() or max(np.abs(low).max(), np.abs(high).max()) > _MAX_LOG:
        message = f"expected min <= max within +-{_MAX_LOG}, found {low.tolist()} and {high.tolist()}"
        raise fault("range", message, means.at("mins"))
    return low, high


def _files(parts: dict[str, Fields]) -> dict[str, str]:
    """Return the names of the images by stream."""
    files: dict[str, str] = {}
    for key, part in parts.items():
        names = part.value.get("files")
        streams = _FILES[key]
        if not isinstance(names, list) or len(names) < len(streams) or not all(isinstance(n, str) for n in names):
            raise fault("files", f"expected {len(streams)} file names, found {_json.shown(names)}", part.at("files"))
        for stream, name in zip(streams, names, strict=False):
            if not is_relative_name(name):
                raise fault("path", f"expected a relative path, found {_json.shown(name)}", part.at("files"))
            files[stream] = name
    return files


def _splat_model(root: dict[str, Any], issues: list[Issue]) -> SplatModel:
    """Return the model that `model` or `antialias` names; writers know the first, the specification the second."""
    model, antialias = root.get("model"), root.get("antialias")
    from_flag: SplatModel = "antialiased" if antialias is True else "default"
    if model is None:
        return from_flag
    if model not in get_args(SplatModel):
        message = f"the splat model {_json.shown(model)} is not known and read as {from_flag!r}"
        issues.append(Issue(code="unknown-model", message=message, field=f"{META_NAME} model"))
        return from_flag
    if isinstance(antialias, bool) and antialias != (model == "antialiased"):
        message = f"model is {model!r} but antialias is {json.dumps(antialias)}; the model is taken"
        issues.append(Issue(code="model-conflict", message=message, field=f"{META_NAME} model"))
    return cast("SplatModel", model)


def _generator(root: dict[str, Any]) -> str:
    asset = root.get("asset")
    name = asset.get("generator") if isinstance(asset, dict) else None
    return name if isinstance(name, str) else ""


class Fields:
    """An object in a JSON file, whose fields are taken out with their types checked.

    Parameters
    ----------
    value
        The object.
    path
        What errors call it.
    """

    def __init__(self, value: dict[str, Any], path: str) -> None:
        self.value = value
        self._path = path

    def at(self, name: str) -> str:
        """Return the path of a field."""
        return f"{self._path} {name}" if self._path.endswith(".json") else f"{self._path}.{name}"

    def child(self, name: str) -> Fields:
        """Return a field that is an object."""
        return Fields(self._get(name, dict, "an object"), self.at(name))

    def integer(self, name: str) -> int:
        """Return a field that is a whole number, not negative."""
        number = self._get(name, (int, float), "a whole number")
        if not (0 <= number <= 1 << 53 and number == int(number)):
            raise fault("count", f"expected a whole number, found {_json.shown(number)}", self.at(name))
        return int(number)

    def numbers(self, name: str, size: int) -> Float64:
        """Return a field that is a list of finite numbers."""
        values = self._get(name, list, f"a list of {size} numbers")
        if len(values) != size:
            raise fault("wrong-type", f"expected {size} numbers, found {len(values)}", self.at(name))
        return np.array([self._finite(value, name) for value in values], np.float64)

    def codebook(self) -> Float32:
        """Return the codebook."""
        values = self._get("codebook", list, "a list of numbers")
        if not 1 <= len(values) <= CODEBOOK_SIZE:
            message = f"expected 1 to {CODEBOOK_SIZE} entries, found {len(values)}"
            raise fault("codebook-length", message, self.at("codebook"))
        return self.narrow([self._finite(value, "codebook") for value in values], "codebook")

    def ramps(self, channels: int | None) -> Float32:
        """Return the value of each byte between `mins` and `maxs`, (channels, 256); None for a single pair of numbers."""
        if channels is None:
            ends = [[self._finite(self._get(name, (int, float), "a number"), name)] for name in ("mins", "maxs")]
        else:
            ends = [self.numbers(name, channels).tolist() for name in ("mins", "maxs")]
        low, high = np.array(ends, np.float64)[..., None]
        return self.narrow(low + (high - low) * (np.arange(256) / 255), "mins")

    def narrow(self, values: Any, name: str) -> Float32:
        """Return numbers as float32, which must hold them."""
        with np.errstate(over="ignore"):
            narrow: Float32 = np.asarray(values, np.float64).astype(np.float32)
        if not np.isfinite(narrow).all():
            raise fault("number", "expected numbers that float32 holds", self.at(name))
        return narrow

    def _get(self, name: str, kind: type | tuple[type, ...], what: str) -> Any:
        value = self.value.get(name)
        if value is None:
            raise fault("missing-field", f"expected {what}, found nothing", self.at(name))
        if not isinstance(value, kind) or isinstance(value, bool):
            raise fault("wrong-type", f"expected {what}, found {type(value).__name__}", self.at(name))
        return value

    def _finite(self, value: Any, name: str) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise fault("number", f"expected a number, found {_json.shown(value)}", self.at(name))
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise fault("number", f"expected a finite number, found {_json.shown(value)}", self.at(name))
        return number
