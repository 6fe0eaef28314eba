"""What a conversion would give, from a part of the scene; nothing is written."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsplat_tools.chunks import CloudChunks
from gsplat_tools.errors import GsplatError, GsplatWarning
from gsplat_tools.formats.loading import drop_or_refuse
from gsplat_tools.formats.saving import DEFAULT_PRESET, find_target
from gsplat_tools.formats.sequences import open_sources
from gsplat_tools.ops.coordinates import name_axes
from gsplat_tools.retiming import DEFAULT_MOTION, Motion, retime
from gsplat_tools.sequence import GaussianSequence, Interpolation
from gsplat_tools.tuning.measuring import Setting
from gsplat_tools.tuning.precision import rendered_clip
from gsplat_tools.tuning.prediction import predict
from gsplat_tools.verification import DEFAULT_VALIDATION, VALIDATION_SIZE, Validation


def estimate(
    sources: Sequence[str | Path],
    target: str | Path,
    *,
    to: str | None = None,
    preset: str = DEFAULT_PRESET,
    validation: Validation | None = DEFAULT_VALIDATION,
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
    record = find_target(Path(target), to)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        opening = open_sources(sources, in_chunks=False, read_options=read_options or {}, options=options)
        with opening as (opened, source_format):
            scene, _ = retime(opened, record, motion, time_at, frame, interpolation, options)
            cloud = scene.read() if isinstance(scene, CloudChunks) else scene
            valid = cloud if isinstance(cloud, GaussianSequence) else drop_or_refuse(cloud, strict=False)
            valid = name_axes(valid, options.get("source_coordinates"))
            if options.get("clip") == "rendered":
                options["clip"] = rendered_clip(valid, options)
            try:
                views = 0 if validation is None else validation.views
                found = predict(
                    valid,
                    Setting(format=record.id, preset=preset, options=options),
                    views=views,
                    size=VALIDATION_SIZE if validation is None else validation.size,
                )
            except GsplatError as error:
                error.path = Path(target)  # not the trial in a temporary folder
                raise
    return {
        "source": ", ".join(map(str, sources)),
        "source_format": source_format,
        "target": {"path": str(target), "format": record.id},
        "views": views,
        **found.to_json(),
    }
