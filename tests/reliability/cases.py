"""What is written where: a small scene for every writer, and ways to look at what stands there afterwards."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import GsplatWarning
from gsplat_tools.formats import load, save
from gsplat_tools.formats.base import Format, Scene
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.sequence import GaussianSequence
from tests.clouds import random_cloud


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A writer and a scene for it.

    Parameters
    ----------
    id, record
        Name of the case; the format.
    name
        Name of the target.
    scene
        Function from a number of splats and a seed to a scene.
    in_parts
        Whether the target is several files, so that it is looked at through its reader.
    """

    id: str
    record: Format
    name: str
    scene: Callable[[int, int], Scene]
    in_parts: bool = False

    def write(self, path: Path, splats: int = 12, seed: int = 0, *, overwrite: bool = True) -> None:
        """Save the scene."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GsplatWarning)
            save(self.scene(splats, seed), path, to=self.record.id, overwrite=overwrite)

    def content(self, path: Path) -> str | None:
        """Return a digest of what stands at a path, or None for nothing; a target in parts has to be readable."""
        if not path.exists():
            return None
        if not self.in_parts:
            return hashlib.sha256(path.read_bytes()).hexdigest()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GsplatWarning)
            scene = load(path)
        cloud = scene.frame(0) if isinstance(scene, GaussianSequence) else scene
        return hashlib.sha256(b"".join(values.tobytes() for values in cloud.arrays().values())).hexdigest()


def moving(splats: int, seed: int, frames: int = 3) -> GaussianSequence:
    """Return a sequence whose splats drift."""
    first = random_cloud(splats, sh_degree=1, seed=seed)
    step = np.random.default_rng(seed).normal(0, 0.01, (splats, 3)).astype(np.float32)

    def frame(number: int) -> GaussianCloud:
        return first.replace(means=first.means + np.float32(number) * step)

    return GaussianSequence(frame, num_splats=splats, sh_degree=1, num_frames=frames)


def still(splats: int, seed: int) -> GaussianCloud:
    """Return a cloud."""
    return random_cloud(splats, sh_degree=1, seed=seed)


@lru_cache(maxsize=1)
def cases() -> tuple[Case, ...]:
    """Return a case for every writer, for sequences where they can be written, and for targets that are folders."""
    found = []
    for record in FORMATS.values():
        if record.write is None:
            continue
        name = f"scene{record.extensions[0]}"
        found.append(Case(id=record.id, record=record, name=name, scene=still, in_parts=record.claims is not None))
        if record.holds_sequences:
            found.append(Case(id=f"{record.id}-sequence", record=record, name=name, scene=moving))
        if record.folder is not None:
            found.append(Case(id=f"{record.id}-folder", record=record, name=record.folder.index, scene=still, in_parts=True))
    return tuple(found)
