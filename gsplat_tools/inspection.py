"""File to header report, cloud to statistics report; all of gsplat-inspect but its printing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.attributes import activations
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import common_frames, compare, frame_levels, still
from gsplat_tools.constants import VISIBLE_OPACITY
from gsplat_tools.errors import CapabilityError, counts_in_words
from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats.base import FileInfo, Format
from gsplat_tools.formats.loading import inspect_file, load, open_scene
from gsplat_tools.formats.sequences import open_sequence
from gsplat_tools.ops.filtering import locate_invalid
from gsplat_tools.ops.recentering import position_step
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

if TYPE_CHECKING:
    from gsplat_tools.reference.camera import Camera

ANIMATED_TIMES = 31
"""Moments of an animation where none are named."""

PERCENTILES = (0.1, 1, 5, 25, 50, 75, 95, 99, 99.9)
HISTOGRAM_BINS = 32
NEEDLE_ASPECT = 30.0
"""Longest over second longest axis; beyond it 8-bit rotation codes double the visible width (docs/conventions.md)."""


def info(path: str | Path) -> dict[str, Any]:
    """Return the header facts of a file, with the names of `gsplat-inspect info --json`.

    Raises
    ------
    FormatError
        The bytes are at fault.
    """
    record, facts = inspect_file(path)
    return describe(Path(path), record, facts)


def describe(path: Path, record: Format, facts: FileInfo) -> dict[str, Any]:
    """Return header facts as JSON values."""
    values = asdict(facts)
    for name in ("bounds", "motion_bounds"):
        box = values[name]
        values[name] = None if box is None else {"min": list(map(float, box[0])), "max": list(map(float, box[1]))}
    values["origin"] = list(values["origin"])
    return {"format": record.id, "version": values.pop("version"), "bytes": path.stat().st_size, **values}


@dataclass(frozen=True, slots=True)
class Hint:
    """Something that a user may want to know about a scene."""

    code: str
    message: str


def statistics(path: str | Path, *, frame: int = 0) -> dict[str, Any]:
    """Return statistics of every attribute as stored, invalid splats included.

    Parameters
    ----------
    path
        File to read whole.
    frame
        Frame of a sequence.

    Raises
    ------
    FormatError
        The bytes are at fault.
    """
    path = Path(path)
    with open_scene(path, in_chunks=False) as scene:
        cloud = scene.frame(frame) if isinstance(scene, GaussianSequence) else scene
        assert isinstance(cloud, GaussianCloud)
        return {
            "file": str(path),
            "splats": len(cloud),
            "sh_degree": cloud.sh_degree,
            "attributes": {name: describe_values(values) for name, values in _columns(cloud).items()},
            "hints": [asdict(hint) for hint in hints(cloud)],
        }


def _columns(cloud: GaussianCloud) -> Mapping[str, NDArray[Any]]:
    """Return every attribute, and those users think in: opacity after the sigmoid, aspect ratio."""
    columns: dict[str, NDArray[Any]] = dict(cloud.arrays())
    if cloud.sh_degree == 0:
        del columns["shN"]
    columns["opacities"] = activations.sigmoid(cloud.opacity_logits)
    columns["quat_norms"] = np.linalg.norm(cloud.quats.astype(np.float64), axis=1)  # squares overflow float32
    columns["aspect"] = _aspects(cloud)
    columns.update({name: values for name, values in cloud.extra.items() if np.issubdtype(values.dtype, np.number)})
    return columns


def _aspects(cloud: GaussianCloud) -> NDArray[np.float64]:
    """Return longest over second longest axis of every splat, infinite for lines, 1 for points."""
    ordered = np.sort(cloud.log_scales.astype(np.float64), axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.exp(np.where(ordered[:, 2] == ordered[:, 1], 0.0, ordered[:, 2] - ordered[:, 1])))


def describe_values(values: NDArray[Any]) -> dict[str, Any]:
    """Return min, max, mean, std, percentiles and histogram of the finite values, and how many are not finite."""
    flat = np.asarray(values).reshape(-1)
    is_float = np.issubdtype(flat.dtype, np.floating)
    num_nan = int(np.count_nonzero(np.isnan(flat))) if is_float else 0
    num_inf = int(np.count_nonzero(np.isinf(flat))) if is_float else 0
    finite = (flat[np.isfinite(flat)] if num_nan or num_inf else flat).astype(np.float64)
    if finite.size == 0:
        empty = dict.fromkeys(("min", "max", "mean", "std"))
        return {**empty, "percentiles": {}, "nan": num_nan, "inf": num_inf, "histogram": {"edges": [], "counts": []}}
    with np.errstate(over="ignore", invalid="ignore"):
        mean, std, percentiles = float(finite.mean()), float(finite.std()), np.percentile(finite, PERCENTILES)
        try:
            counts, edges = np.histogram(finite, bins=HISTOGRAM_BINS)
        except ValueError:  # bins narrower than float64 can part, or wider than it holds
            counts, edges = np.array([finite.size]), np.array([finite.min(), finite.max()])
    return {
        "min": float(finite.min()),
        "max": float(finite.max()),
        "mean": mean,
        "std": std,
        "percentiles": {f"{p:g}": float(v) for p, v in zip(PERCENTILES, percentiles, strict=True)},
        "nan": num_nan,
        "inf": num_inf,
        "histogram": {"edges": edges.tolist(), "counts": counts.tolist()},
    }


def hints(cloud: GaussianCloud) -> list[Hint]:
    """Return what looks odd or costly about a scene."""
    if len(cloud) == 0:
        return [Hint("empty", "the file holds no splats")]
    found = []
    invalid = locate_invalid(cloud)
    if invalid:
        counts = {cause: count for cause, (count, _) in invalid.items()}
        causes = counts_in_words(counts)
        found.append(Hint("invalid", f"{sum(counts.values())} splats are invalid, converting drops them: {causes}"))
    finite_scales = cloud.log_scales[np.isfinite(cloud.log_scales)]
    if finite_scales.size and finite_scales.min() >= 0:
        found.append(
            Hint("scales-look-linear", "no log scale is negative: the scales may be linear; 3DGS stores their logarithm")
        )
    finite_logits = cloud.opacity_logits[np.isfinite(cloud.opacity_logits)]
    if finite_logits.size and finite_logits.min() >= 0 and finite_logits.max() <= 1:
        found.append(
            Hint("opacities-look-activated", "every opacity lies in 0..1: it may be after the sigmoid; 3DGS stores logits")
        )
    with np.errstate(invalid="ignore"):
        needles = int(np.count_nonzero(_aspects(cloud) > NEEDLE_ASPECT))
    if needles:
        found.append(
            Hint("needles", f"{needles} splats are more than {NEEDLE_ASPECT:g} times as long as wide: use --rotation best")
        )
    hidden = int(np.count_nonzero(activations.sigmoid(cloud.opacity_logits) < VISIBLE_OPACITY))
    if hidden:
        found.append(Hint("invisible", f"{hidden} splats have an opacity below 1/255: --prune-opacity 0.0039 drops them"))
    if cloud.sh_degree and not (cloud.shN != 0).any():
        found.append(Hint("sh-all-zero", f"SH bands 1 to {cloud.sh_degree} are zero everywhere: --sh-degree auto drops them"))
    found += _float16_hint(cloud) + _overdraw_hint(cloud)
    return found


def _float16_hint(cloud: GaussianCloud) -> list[Hint]:
    """Report splats whose float16 position step is above half their own size (docs/conventions.md)."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        size = np.exp(cloud.log_scales.max(axis=1).astype(np.float64))
        reach = np.abs(cloud.means).max(axis=1).astype(np.float64)
        reach = np.where(np.isfinite(reach) & (reach > 0), reach, 1e-8)
        half_step = np.exp2(np.floor(np.log2(reach)) - 11)
        coarse = int(np.count_nonzero(half_step > 0.5 * size))
    if not coarse:
        return []
    step = position_step(float(np.nanmax(np.where(np.isfinite(cloud.means), np.abs(cloud.means), 0))), "f16")
    return [
        Hint(
            "float16-step",
            f"float16 positions move {coarse} of {len(cloud)} splats by over half their size (step up to {step:g}): recenter",
        )
    ]


def _overdraw_hint(cloud: GaussianCloud) -> list[Hint]:
    """Report few large splats that cover most of the drawn area."""
    with np.errstate(invalid="ignore", over="ignore"):
        ordered = np.sort(cloud.log_scales.astype(np.float64), axis=1)
        areas = np.exp(ordered[:, 2] + ordered[:, 1])
    areas = np.sort(np.where(np.isfinite(areas), areas, 0.0))[::-1]
    total = areas.sum()
    top = max(1, len(areas) // 100)
    share = float(areas[:top].sum() / total) if total > 0 else 0.0
    if len(cloud) < 1000 or share < 0.9:
        return []
    return [
        Hint(
            "overdraw", f"the largest 1 % of the splats have {100 * share:.0f} % of the total area: they dominate drawing time"
        )
    ]


def _load_with_model(path: Path, model: str | None) -> tuple[GaussianCloud | GaussianSequence, tuple[str, str | None]]:
    """Return a scene and the model that draws it: the one asked for, or that of its format."""
    if path.is_dir():
        sequence = open_sequence(path)
        return sequence, ("inria", None) if model is None else (model, None)
    record, _ = inspect_file(path)
    return load(path), record.model if model is None else (model, None)


def _cameras(scene: GaussianCloud, camera_file: Path | None, views: int, size: tuple[int, int]) -> Sequence[Camera]:
    """Return the cameras of a file, or automatic ones."""
    from gsplat_tools.reference.auto_cameras import auto_cameras
    from gsplat_tools.reference.camera import load_cameras

    return auto_cameras(scene, views=views, size=size) if camera_file is None else load_cameras(camera_file)


def compare_files(
    reference: Path,
    candidate: Path,
    *,
    views: int,
    size: tuple[int, int],
    camera_file: Path | None = None,
    model: str | None = None,
    t: float | None = None,
    images: Path | None = None,
) -> dict[str, Any]:
    """Compare two files and return what `gsplat-inspect compare --json` prints.

    Parameters
    ----------
    reference, candidate
        Files to compare, or folders of frames.
    views, size, camera_file
        Automatic views and their size, px; or a file of cameras.
    model
        Rendering model; by default that of the candidate's format.
    t
        Normalized time at which sequences and motion are evaluated.
    images
        Folder for one picture a view: reference, candidate, amplified difference.

    Raises
    ------
    FormatError
        The bytes of a file are at fault.
    """
    from gsplat_tools.reference.pictures import contact_sheet, difference_picture

    scene, _ = _load_with_model(reference, model)
    other, (name, variant) = _load_with_model(candidate, model)
    cameras = _cameras(still(scene, t), camera_file, views, size)

    def see(view: str, a: NDArray[Any], b: NDArray[Any]) -> None:
        assert images is not None
        path = images / f"{view.replace(' ', '_')}.png"
        _write_png(contact_sheet([a, b, difference_picture(a, b)], columns=3), path, overwrite=True)

    if images is not None:
        images.mkdir(parents=True, exist_ok=True)
    report = compare(scene, other, cameras=cameras, model=name, variant=variant, t=t, see=None if images is None else see)
    frames = common_frames(scene, other) if t is None else 1
    return {**asdict(report), "frames": frame_levels(report, frames) if frames > 1 else []}


def render_file(
    file: Path,
    target: Path | None,
    *,
    camera: str,
    views: int | None,
    model: str | None,
    variant: str | None,
    size: tuple[int, int],
    t: float | None,
    framebuffer: Any,
    overwrite: bool,
    times: Sequence[float] | None = None,
    animate: Path | None = None,
    fps: float = 15.0,
) -> dict[str, Any]:
    """Draw a file into a PNG, an animated WebP or both, and return what was drawn.

    Parameters
    ----------
    file, target
        Scene and picture; no picture where `target` is None.
    camera
        "auto" or a file of cameras.
    views, size
        Automatic views and their size, px; several views make a contact sheet. By default 8 at one time, 1 over time.
    model, variant
        Rendering model; by default that of the file's format.
    t
        Normalized time at which sequences and motion are evaluated.
    framebuffer
        "float", or "unorm8" to round after every blend.
    overwrite
        Replace a picture that is there.
    times
        Several times: a row of the contact sheet is a view, a column a time. With `animate`, 31 from 0 to 1 by default.
    animate, fps
        Animated WebP of the times, and its pictures a second.

    Raises
    ------
    FormatError
        The bytes of a file are at fault.
    TargetExistsError
        The picture is there and `overwrite` is false.
    CapabilityError
        Both a time and several are given, or there is nothing to write.
    """
    from gsplat_tools.reference.pictures import contact_sheet
    from gsplat_tools.reference.rasterizer import render

    if (t is not None and times is not None) or (target is None and animate is None):
        raise CapabilityError("give one time or several, and a picture or an animation to write")
    scene, (name, default_variant) = _load_with_model(file, model)
    moments: Sequence[float | None] = times or (np.linspace(0, 1, ANIMATED_TIMES).tolist() if animate and t is None else [t])
    shown_views = views or (8 if len(moments) == 1 else 1)
    # One set of cameras for all times, round what is there in the middle.
    middle = still(scene, moments[len(moments) // 2])
    cameras = _cameras(middle, None if camera == "auto" else Path(camera), shown_views, size)
    drawn = []
    with stage("rendering", len(cameras) * len(moments), "views") as progress:
        for moment in moments:
            cloud = still(scene, moment)
            for one in cameras:
                options: dict[str, Any] = {"variant": variant or default_variant, "framebuffer": framebuffer}
                drawn.append(render(cloud, one, model=name, t=moment, **options))
                progress.advance(1)
    pictures = [rendering.image for rendering in drawn]
    by_time = [pictures[start : start + len(cameras)] for start in range(0, len(pictures), len(cameras))]
    if target is not None:
        by_view = [picture for row in zip(*by_time, strict=True) for picture in row]
        columns = len(moments) if len(moments) > 1 else None
        _write_png(contact_sheet(by_view, columns=columns), target, overwrite=overwrite)
    if animate is not None:
        _write_animation([contact_sheet(row) for row in by_time], animate, fps=fps, overwrite=overwrite)
    return {
        "picture": None if target is None else str(target),
        "animation": None if animate is None else str(animate),
        "model": name,
        "variant": variant or default_variant,
        "times": list(moments),
        "views": [asdict(rendering.counts) for rendering in drawn],
    }


def _write_animation(pictures: Sequence[NDArray[np.uint8]], path: Path, *, fps: float, overwrite: bool) -> None:
    """Write 8-bit pictures as an animated WebP that repeats."""
    from PIL import Image

    first, *rest = [Image.fromarray(picture) for picture in pictures]
    with replacing(path, overwrite=overwrite) as stream:
        first.save(
            stream, format="WEBP", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, quality=90, method=4
        )


def _write_png(picture: NDArray[np.uint8], path: Path, *, overwrite: bool) -> None:
    """Write an 8-bit picture."""
    if path.suffix.lower() != ".png":
        raise CapabilityError("pictures are written as PNG; give a name that ends in .png", path=path)
    from PIL import Image

    with replacing(path, overwrite=overwrite) as stream:
        Image.fromarray(picture).save(stream, format="PNG", optimize=True)
