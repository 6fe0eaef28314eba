"""One conversion from path to path: load, prepare, write, read back, hold against bounds, render, publish."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.comparison import AttributeTally, compare_rendered, paired, sample
from gsplat_tools.comparison.rendered import MAX_RENDERED
from gsplat_tools.errors import CapabilityError, GsplatError, GsplatWarning, ValidationError
from gsplat_tools.formats._stores import local_path, url_of
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.loading import drop_or_refuse, inspect_file, is_single, open_as, open_scene
from gsplat_tools.formats.preparing import Prepared
from gsplat_tools.formats.saving import DEFAULT_PRESET, find_target, save
from gsplat_tools.progress import stage
from gsplat_tools.retiming import DEFAULT_MOTION, Motion, retime
from gsplat_tools.sequence import GaussianSequence, Interpolation
from gsplat_tools.tuning.auto import Tuned, tune, zero_bands
from gsplat_tools.tuning.measuring import Workbench
from gsplat_tools.tuning.search import TARGET_SIZE, TARGET_VIEWS, Budget

EXACT_PRESET = "exact"
VALIDATION_VIEWS = 2
VALIDATION_SIZE = (320, 180)
VALIDATED_FRAMES = 3
"""Frames of a sequence that are rendered: the first, the middle and the last; the bounds hold for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """How a written file is checked before it replaces its target.

    Parameters
    ----------
    views, size
        Automatic views and their width and height, px.
    model
        Rendering model; by default the one that stands for the target.
    min_psnr
        Lowest acceptable PSNR of the worst view, dB.
    """

    views: int = VALIDATION_VIEWS
    size: tuple[int, int] = VALIDATION_SIZE
    model: str | None = None
    min_psnr: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ConversionReport:
    """What one conversion did; `to_json` is what `gsplat-convert --json` prints."""

    source: str
    source_format: str
    path: Path
    format: str
    bytes: int
    splats: int
    sh_degree: int
    frames: int
    dropped: dict[str, int]
    warnings: list[dict[str, str]]
    seconds: dict[str, float]
    validation: dict[str, Any] | None
    options: dict[str, Any] = field(default_factory=dict)
    decisions: list[dict[str, Any]] = field(default_factory=list)
    search: dict[str, Any] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the report with the fixed names of the command line's JSON."""
        return {
            "source": self.source,
            "source_format": self.source_format,
            "target": {"path": url_of(self.path), "format": self.format, "bytes": self.bytes},
            "splats": self.splats,
            "sh_degree": self.sh_degree,
            "frames": self.frames,
            "dropped": self.dropped,
            "warnings": self.warnings,
            "seconds": {name: round(value, 4) for name, value in self.seconds.items()},
            "validation": self.validation,
            "options": {
                name: value if isinstance(value, int | float | str | None) else str(value)
                for name, value in self.options.items()
            },
            "decisions": self.decisions,
            "search": self.search,
        }


def convert(
    sources: Sequence[str | Path],
    target: str | Path,
    *,
    to: str | None = None,
    overwrite: bool = False,
    preset: str = DEFAULT_PRESET,
    budget: Budget | None = None,
    auto: bool = False,
    validation: Validation | None = Validation(),
    time_at: float | None = None,
    frame: int | None = None,
    interpolation: Interpolation = "linear",
    motion: Motion = DEFAULT_MOTION,
    read_options: dict[str, Any] | None = None,
    **options: Any,
) -> ConversionReport:
    """Convert a file, or several files as the frames of a sequence, to one target.

    Parameters
    ----------
    sources
        One file, or frames: several files, a folder, or a glob.
    target
        File to write.
    to
        Format id; by default from the target's extension.
    overwrite
        Replace a target that is there.
    preset
        "fast", "balanced", "best", or "exact" for all that the format can hold.
    budget
        Search the options that were not given for the cheapest result that holds it; see `tuning.search`.
    auto
        Spend no more than the scene requires: search for fewer bytes than the preset's at pictures as good, as far as a
        screen shows. Does nothing with a budget, which does as much, and with "exact", which keeps bits.
    validation
        How to check the written file; None checks nothing. What is searched for is judged by as many views as `compare`
        draws, or more.
    time_at, frame, interpolation
        Take one moment or one stored frame of a sequence, or one moment of a 4D asset.
    motion
        How a 4D asset becomes keyframes, or a sequence a 4D asset.
    read_options
        Read options of the source's format.
    **options
        Choices of `SaveChoices` and write options of the target's format.

    Returns
    -------
    ConversionReport
        Counts, bytes, seconds, warnings and the validation.

    Raises
    ------
    GsplatError
        See `load` and `save`.
    ValidationError
        The written file leaves its bounds, renders below `min_psnr`, or nothing holds the budget; the target is left as
        it was.
    """
    sources, target = [local_path(each) for each in sources], local_path(target)
    record = find_target(Path(target), to)
    outcome: dict[str, Any] = {}
    seconds = {"read": 0.0, "encode": 0.0, "write": 0.0, "validate": 0.0}

    def check(stream: BinaryIO, prepared: Prepared, written: Format) -> None:
        assert validation is not None
        start = time.perf_counter()
        try:
            outcome["validation"] = _validate(Path(stream.name), prepared.scene, written, validation, outcome.get("bench"))
        except GsplatError as error:
            error.path = Path(target)  # not the temporary file that was read back
            raise
        seconds["validate"] = time.perf_counter() - start

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        start = time.perf_counter()
        in_chunks = record.streams and (options.get("order") or record.order) == "none"
        with _open(sources, in_chunks, read_options or {}, options) as (opened, source_format):
            scene, retimed = retime(opened, record, motion, time_at, frame, interpolation, options)
            source_degree = scene.sh_degree
            if budget is not None or (auto and preset != EXACT_PRESET):
                how = _demanding(validation, budget)
                validation = None if validation is None else how
                tuned = _tune(scene, record, budget, preset, options, how)
                scene, options = tuned.scene, {**options, **tuned.options}
                outcome |= {"bench": tuned.bench, "decisions": tuned.decisions, "search": tuned.found and tuned.found.to_json()}
            seconds["read"] = time.perf_counter() - start
            if options.get("clip") == "rendered":
                options["clip"] = _rendered_clip(scene, options)
            saved = save(
                scene,
                target,
                to=record.id,
                overwrite=overwrite,
                preset=preset,
                check=None if validation is None else check,
                **options,
            )
    for name, spent in saved.seconds.items():
        seconds[name] += spent
    decisions = outcome.get("decisions", [])
    if saved.sh_degree < source_degree and options.get("sh_degree") in (None, "auto") and record.max_sh_degree >= source_degree:
        decisions = [zero_bands(source_degree, saved.sh_degree), *decisions]
    return ConversionReport(
        source=", ".join(map(url_of, sources)),
        source_format=source_format,
        path=saved.path,
        format=saved.format,
        bytes=saved.bytes,
        splats=saved.splats,
        sh_degree=saved.sh_degree,
        frames=saved.frames,
        dropped=dict(Counter(retimed.dropped) + Counter(saved.dropped)),
        warnings=_unique_warnings(caught),
        seconds=seconds,
        validation=outcome.get("validation"),
        options={**saved.options, **retimed.facts},
        decisions=decisions,
        search=outcome.get("search"),
    )


def estimate(
    sources: Sequence[str | Path],
    target: str | Path,
    *,
    to: str | None = None,
    preset: str = DEFAULT_PRESET,
    validation: Validation | None = Validation(),
    time_at: float | None = None,
    frame: int | None = None,
    interpolation: Interpolation = "linear",
    motion: Motion = DEFAULT_MOTION,
    read_options: dict[str, Any] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Estimate what a conversion would give, from a part of the scene; nothing is written.

    Parameters
    ----------
    sources, target, to, preset, time_at, frame, interpolation, motion, read_options
        As `convert` takes them.
    validation
        Its views and their size are those that PSNR is estimated for; None estimates none.
    **options
        Choices of `SaveChoices` and write options of the target's format.

    Returns
    -------
    dict
        source, target, and the fields of `Prediction`.

    Raises
    ------
    GsplatError
        See `load` and `save`.
    """
    from gsplat_tools.tuning.measuring import Setting
    from gsplat_tools.tuning.prediction import predict

    record = find_target(Path(target), to)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        with _open(sources, False, read_options or {}, options) as (opened, source_format):
            scene, _ = retime(opened, record, motion, time_at, frame, interpolation, options)
            cloud = scene.read() if isinstance(scene, CloudChunks) else scene
            valid = cloud if isinstance(cloud, GaussianSequence) else drop_or_refuse(cloud, strict=False)
            found = predict(
                valid,
                Setting(format=record.id, preset=preset, options=options),
                views=0 if validation is None else validation.views,
                size=VALIDATION_SIZE if validation is None else validation.size,
            )
    return {
        "source": ", ".join(map(str, sources)),
        "source_format": source_format,
        "target": {"path": str(target), "format": record.id},
        **found.to_json(),
    }


def _rendered_clip(scene: Scene, options: dict[str, Any]) -> Any:
    """Return the int8 ranges that render best."""
    from gsplat_tools.tuning.precision import choose_clip

    if isinstance(scene, GaussianSequence):
        return "auto"  # refused by the writer
    cloud = drop_or_refuse(sample(scene), strict=False)
    return choose_clip(cloud, **{name: value for name, value in options.items() if name == "position_bits"}).clip


def _demanding(how: Validation | None, budget: Budget | None) -> Validation:
    """Return a validation with the views that a search is judged by, and the PSNR that it has to hold."""
    how = how or Validation()
    floors = [each for each in (how.min_psnr, None if budget is None else budget.min_psnr) if each is not None]
    views = how.views if how.views != VALIDATION_VIEWS else TARGET_VIEWS
    return replace(how, views=views, size=max(how.size, TARGET_SIZE), min_psnr=max(floors, default=None))


def _tune(scene: Scene, record: Format, budget: Budget | None, preset: str, options: dict[str, Any], how: Validation) -> Tuned:
    """Choose options by measurement."""
    model = None if how.model is None else (how.model, None)
    return tune(scene, record, preset=preset, options=options, budget=budget, views=how.views, size=how.size, model=model)


@contextmanager
def _open(
    sources: Sequence[str | Path], in_chunks: bool, read_options: dict[str, Any], options: dict[str, Any]
) -> Iterator[tuple[Scene, str]]:
    """Open one file, or several, a folder or a glob as a sequence; yield it and the id of its format."""
    found: list[Format] = []
    if len(sources) == 1 and is_single(Path(sources[0])):
        with open_scene(Path(sources[0]), in_chunks=in_chunks, on_format=found.append, **read_options) as scene:
            yield scene, found[0].id
        return
    from gsplat_tools.formats.sequences import frame_files, open_sequence

    scene = open_sequence(sources, frame_times=options.pop("frame_times", None))
    yield scene, inspect_file(frame_files(sources)[0])[0].id


def _validate(
    path: Path,
    source: GaussianCloud | CloudChunks | GaussianSequence,
    target: Format,
    how: Validation,
    bench: Workbench | None = None,
) -> dict[str, Any]:
    """Read the file back, hold every value against its bound, render both sides, and judge.

    Pictures are compared with those of what was given to the writer, or of the source where a bench has it.

    Raises
    ------
    ValidationError
        A bound is exceeded, or the worst view is below `min_psnr`.
    """
    from gsplat_tools.reference.auto_cameras import auto_cameras

    if target.read is None:
        raise CapabilityError(f"{target.title} cannot be read back; use --no-validate")
    tally = AttributeTally()
    pairs: list[tuple[str, GaussianCloud, GaussianCloud]] = []
    in_chunks = not isinstance(source, GaussianSequence)
    with open_scene(path, in_chunks=in_chunks, as_format=target.id) as decoded, open_as(path, target) as header:
        if isinstance(source, GaussianSequence) != isinstance(decoded, GaussianSequence):
            if isinstance(decoded, GaussianSequence) and not isinstance(source, GaussianSequence):
                source = still_sequence(source)
            else:
                raise ValidationError("a sequence was written but a single frame was read back")
        if isinstance(source, GaussianSequence) and isinstance(decoded, GaussianSequence):
            rendered = set(np.linspace(0, len(source) - 1, VALIDATED_FRAMES).round().astype(int).tolist())
            with stage("checking", len(source), "frames") as progress:
                for frame_id in range(len(source)):
                    a, b = source.frame(frame_id), decoded.frame(frame_id)
                    tally.add(a, b, None if target.bounds is None else target.bounds(a, header, frame_id))
                    if frame_id in rendered:
                        pairs.append((f"frame {frame_id} " if len(source) > 1 else "", a, b))
                    progress.advance(1)
        elif not isinstance(source, GaussianSequence) and not isinstance(decoded, GaussianSequence):
            if len(source) != len(decoded):
                raise ValidationError(f"{len(source)} splats were written but {len(decoded)} read back")
            with stage("checking", len(source)) as progress:
                for a, b in paired(source, decoded):
                    tally.add(a, b, None if target.bounds is None else target.bounds(a, header, 0))
                    progress.advance(len(a))
            limit = MAX_RENDERED if bench is None else max(1, len(source))
            pairs.append(("", sample(source, limit), sample(decoded, limit)))
    if bench is not None and pairs:
        frames = bench.source_frames(pairs[0][1].coordinate_system)
        pairs = [(label, frame, after) for frame, (label, _, after) in zip(frames, pairs, strict=True)]
    model = (how.model, None) if how.model is not None else target.model
    result: dict[str, Any] = {"psnr_min": None, "psnr_mean": None, "ssim_mean": None, "max_abs": None}
    pairs = [pair for pair in pairs if len(pair[1])]
    if pairs and how.views > 0:
        cameras = auto_cameras(pairs[0][1], views=how.views, size=how.size)
        report = compare_rendered(pairs, cameras, model, num_pairs=len(pairs))
        result = {name: getattr(report, name) for name in ("psnr_min", "psnr_mean", "ssim_mean", "max_abs", "identical")}
        result |= {"worst_view": report.worst_view, "model": report.model, "rendered_splats": report.rendered_splats}
    exceeded = tally.exceeded()
    psnr_min = result["psnr_min"]
    too_low = how.min_psnr is not None and psnr_min is not None and psnr_min < how.min_psnr
    if exceeded:
        raise ValidationError(f"what was written leaves its derived bounds: {'; '.join(exceeded)}")
    if too_low:
        raise ValidationError(
            f"the worst view has {psnr_min:.2f} dB, below --min-psnr {how.min_psnr:g}; the target is left as it was. "
            "Use --preset best or a lower --min-psnr"
        )
    return {**result, "attributes": tally.to_json(), "passed": True}


def still_sequence(scene: GaussianCloud | CloudChunks) -> GaussianSequence:
    """Return a still scene as a sequence of one frame."""
    cloud = scene.read() if isinstance(scene, CloudChunks) else scene
    return GaussianSequence(lambda _frame: cloud, num_splats=len(cloud), sh_degree=cloud.sh_degree, num_frames=1)


def _unique_warnings(caught: Sequence[warnings.WarningMessage]) -> list[dict[str, str]]:
    """Return our warnings as code and message, each once; pass everyone else's on."""
    messages: dict[tuple[str, str], dict[str, str]] = {}
    for warning in caught:
        if isinstance(warning.message, GsplatWarning):
            entry = {"code": warning.message.code, "message": str(warning.message)}
            messages.setdefault((entry["code"], entry["message"]), entry)
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return list(messages.values())
