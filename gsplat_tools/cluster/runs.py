"""One conversion as tasks: its stages and report, what it is known by later, and whether workers and results will do."""

from __future__ import annotations

import hashlib
import json
import platform
import secrets
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_tools.cluster.checking import merged_tally
from gsplat_tools.cluster.engines import Dask, Engine
from gsplat_tools.cluster.outcomes import Outcome
from gsplat_tools.comparison.attributes import AttributeTally
from gsplat_tools.comparison.rendered import ViewReport, summarize_views
from gsplat_tools.convert import ConversionReport
from gsplat_tools.errors import TARGET_EXISTS, CapabilityError, ClusterError, GsplatWarning, TargetExistsError, ValidationError
from gsplat_tools.formats._atomic import check_target
from gsplat_tools.formats._stores import exists, is_url, local_path
from gsplat_tools.formats.saving import find_target
from gsplat_tools.progress import stage
from gsplat_tools.verification import Validation


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterReport(ConversionReport):
    """A conversion report, and what the cluster did."""

    cluster: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the report with the fixed names of the command line's JSON."""
        return {**ConversionReport.to_json(self), "cluster": self.cluster}


class Stages:
    """Runs the tasks of each stage, shows progress, and adds up what they took."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.run_id = secrets.token_hex(8)
        self.outcomes: list[Outcome] = []
        self.spent: dict[str, dict[str, float]] = {}

    def run(self, name: str, label: str, pending: Sequence[Any], sizes: Sequence[int], unit: str = "frames") -> Iterator[Any]:
        """Yield results in order; `sizes` are the frames, or what `unit` says, of each task."""
        start, busy = time.perf_counter(), 0.0
        with stage(label, sum(sizes), unit) as progress:
            for outcome, size in zip(self.engine.results(pending), sizes, strict=True):
                busy += outcome.seconds
                value = outcome.result()
                self.outcomes.append(Outcome(warnings=outcome.warnings))
                progress.advance(size)
                yield value
        self.note(name, tasks=len(pending), seconds=time.perf_counter() - start, task_seconds=busy)

    def note(self, name: str, **numbers: float) -> None:
        """Add to what a stage took."""
        stage_numbers = self.spent.setdefault(name, {})
        for key, number in numbers.items():
            stage_numbers[key] = round(stage_numbers.get(key, 0) + number, 4)


def bundle_target(target: str | Path, to: str | None, what: str, *, overwrite: bool) -> Path:
    """Return the path of a .sog4d bundle that may be written.

    Parameters
    ----------
    target, to, overwrite
        As `convert` takes them.
    what
        What is made of it, for the error about another format.

    Raises
    ------
    CapabilityError
        The target is of another format.
    TargetExistsError
        It is there and `overwrite` is false.
    WriteError
        It could not be written: its folder is missing, or it is no file.
    """
    target = Path(local_path(target))
    record = find_target(target, to)
    if record.id != "sog4d":
        raise CapabilityError(f"{what}, not {record.title}", path=target)
    if not is_url(target):
        check_target(target, overwrite=overwrite)
    elif exists(target) and not overwrite:
        raise TargetExistsError(TARGET_EXISTS, path=target)
    return target


def fingerprint() -> tuple[dict[str, str], str]:
    """Return the versions on which the bytes of a bundle depend, and what the processor can do."""
    import numba
    from PIL import features

    import gsplat_tools

    versions = {
        "gsplat_tools": gsplat_tools.__version__,
        "numpy": np.__version__,
        "numba": numba.__version__,
        "libwebp": features.version("webp") or "missing",
        "python": platform.python_version(),
    }
    able = json.dumps(np.show_config(mode="dicts").get("SIMD Extensions", {}).get("found", []))
    return versions, f"{platform.machine()} {able}"


def key_of(described: dict[str, Any]) -> str:
    """Return a digest of what the bytes of parts follow from, and of the versions and the processor of this machine."""
    versions, able = fingerprint()
    return hashlib.sha256(
        json.dumps({"versions": versions, "processor": able, **described}, sort_keys=True).encode()
    ).hexdigest()


def check_alike(engine: Engine) -> None:
    """Refuse workers whose versions would give other bytes, and warn of unlike processors."""
    if not isinstance(engine, Dask):
        return
    own, _ = fingerprint()
    found = engine.run_everywhere(fingerprint)
    for versions, _ in found:
        unlike = [f"{name} {versions[name]} instead of {own[name]}" for name in own if versions[name] != own[name]]
        if unlike:
            raise ClusterError(f"a worker has {', '.join(unlike)}: install the same versions everywhere")
    if len({able for _, able in found}) > 1:
        message = "the workers have unlike processors, whose roundings may differ: bytes may depend on who encodes what"
        warnings.warn(GsplatWarning(message, code="unlike-workers"), stacklevel=3)


def judge(
    views: list[ViewReport],
    tallies: list[AttributeTally | None],
    validation: Validation | None,
    model: tuple[str, str | None],
) -> dict[str, Any] | None:
    """Return what the checks of all tasks say together.

    Raises
    ------
    ValidationError
        The worst view is below `min_psnr`.
    """
    if validation is None:
        return None
    result: dict[str, Any] = {"psnr_min": None, "psnr_mean": None, "ssim_mean": None, "max_abs": None, "views": 0}
    if views:
        name, variant = model if validation.model is None else (validation.model, None)
        report = summarize_views(views, name if variant is None else f"{name} {variant}", 0)
        result = {each: getattr(report, each) for each in ("psnr_min", "psnr_mean", "ssim_mean", "max_abs", "identical")}
        result |= {"worst_view": report.worst_view, "model": report.model, "views": validation.views}
    level = result["psnr_min"]
    if validation.min_psnr is not None and level is not None and level < validation.min_psnr:
        raise ValidationError(
            f"the worst view has {level:.2f} dB, below --min-psnr {validation.min_psnr:g}; the target is left as it was. "
            "Use --preset best or a lower --min-psnr"
        )
    tally = merged_tally([tally for tally in tallies if tally is not None])
    return {**result, "attributes": tally.to_json(), "passed": True}
