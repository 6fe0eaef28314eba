"""One conversion from path to path: load, prepare, write, read back, hold against bounds, render, publish."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

from gsplat_tools.errors import CapabilityError, GsplatError, GsplatWarning
from gsplat_tools.formats._stores import local_path, url_of
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.preparing import Prepared
from gsplat_tools.formats.saving import DEFAULT_PRESET, find_target, save
from gsplat_tools.formats.sequences import open_sources
from gsplat_tools.retiming import DEFAULT_MOTION, Motion, retime
from gsplat_tools.sequence import Interpolation
from gsplat_tools.tuning.auto import Tuned, tune, zero_bands
from gsplat_tools.tuning.precision import rendered_clip
from gsplat_tools.tuning.search import TARGET_SIZE, TARGET_VIEWS, Budget
from gsplat_tools.verification import DEFAULT_VALIDATION, VALIDATION_VIEWS, Validation, verify

EXACT_PRESET = "exact"


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
    validation: Validation | None = DEFAULT_VALIDATION,
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
        screen shows. Does nothing with a budget, which does as much, and with "exact", which keeps bits and warns.
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
    CapabilityError
        A budget with the preset "exact", which keeps what a budget gives up.
    ValidationError
        The written file leaves its bounds, renders below `min_psnr`, or nothing holds the budget; the target is left as
        it was.
    """
    sources, target = [local_path(each) for each in sources], local_path(target)
    record = find_target(Path(target), to)
    if budget is not None and preset == EXACT_PRESET:
        raise CapabilityError('the preset "exact" keeps all that a format can hold, and a budget gives up some; choose one')
    outcome: dict[str, Any] = {}
    seconds = {"read": 0.0, "encode": 0.0, "write": 0.0, "validate": 0.0}

    def check(stream: BinaryIO, prepared: Prepared, written: Format) -> None:
        assert validation is not None
        start = time.perf_counter()
        try:
            outcome["validation"] = verify(Path(stream.name), prepared.scene, written, validation, outcome.get("bench"))
        except GsplatError as error:
            if error.path is None or Path(error.path) == Path(stream.name):  # otherwise the source, which is read once more
                error.path = Path(target)
            raise
        seconds["validate"] = time.perf_counter() - start

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GsplatWarning)
        if auto and preset == EXACT_PRESET:
            warnings.warn(GsplatWarning("--auto leaves out nothing with the preset exact", code="auto-off"), stacklevel=2)
        start = time.perf_counter()
        in_chunks = record.streams and (options.get("order") or record.order) == "none"
        opening = open_sources(sources, in_chunks=in_chunks, read_options=read_options or {}, options=options)
        with opening as (opened, source_format):
            scene, retimed = retime(opened, record, motion, time_at, frame, interpolation, options)
            source_degree = scene.sh_degree
            if options.get("clip") == "rendered":
                options["clip"] = rendered_clip(scene, options)
            if budget is not None or (auto and preset != EXACT_PRESET):
                how = _demanding(validation, budget)
                validation = None if validation is None else how
                tuned = _tune(scene, record, budget, preset, options, how)
                scene, options = tuned.scene, {**options, **tuned.options}
                outcome |= {"bench": tuned.bench, "decisions": tuned.decisions, "search": tuned.found and tuned.found.to_json()}
            seconds["read"] = time.perf_counter() - start
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
        warnings=unique_warnings(caught),
        seconds=seconds,
        validation=outcome.get("validation"),
        options={**saved.options, **retimed.facts},
        decisions=decisions,
        search=outcome.get("search"),
    )


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


def unique_warnings(caught: Sequence[warnings.WarningMessage]) -> list[dict[str, str]]:
    """Return our warnings as code and message, each once; pass everyone else's on."""
    messages: dict[tuple[str, str], dict[str, str]] = {}
    for warning in caught:
        if isinstance(warning.message, GsplatWarning):
            entry = {"code": warning.message.code, "message": str(warning.message)}
            messages.setdefault((entry["code"], entry["message"]), entry)
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return list(messages.values())
