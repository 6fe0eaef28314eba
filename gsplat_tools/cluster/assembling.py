"""Finished segments to one bundle: parts joined in the order of frames, without a place that holds it all."""

from __future__ import annotations

import hashlib
import io
import warnings
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from gsplat_tools.cluster import tasks
from gsplat_tools.cluster.parts import Hashed, Part, part_bytes
from gsplat_tools.errors import GsplatWarning, WriteError
from gsplat_tools.formats._atomic import replacing
from gsplat_tools.formats._stores import LARGE_BLOCK_BYTES, is_url, local_path, remove, replacing_object, url_of
from gsplat_tools.formats._zip import ZipWriter
from gsplat_tools.formats.saving import check_header
from gsplat_tools.formats.sog4d.codebooks import Shared
from gsplat_tools.formats.sog4d.segments import data_compression
from gsplat_tools.progress import stage
from gsplat_tools.sequence import GaussianSequence

PARTS_SUFFIX = ".gsplat-parts"
"""Added to the target's name, with a dot before it: the folder of finished segments."""


def assemble(target: Path, found: list[Part], entries: dict[str, bytes], shared: Shared, *, overwrite: bool) -> tuple[int, str]:
    """Write the bundle from its parts, in the order of frames, and publish it; return its size and SHA-256."""
    with stage("writing", len(found), "parts") as progress, _opened(target, overwrite=overwrite) as stream:
        hashed = Hashed(stream)
        archive = ZipWriter(hashed)  # type: ignore[arg-type] # all that is needed of a stream
        for part in found:
            images = [entry for entry in part.entries if entry.name.startswith("frames/")]
            archive.graft(images, part_bytes(part.path, 0, part.images))
            progress.advance(1)
        deltas = {name: part for part in found for name in part.deltas}
        for name in sorted([*entries, *deltas]):
            if name in entries:
                _add(archive, name, entries[name], shared)
            else:
                part = deltas[name]
                offset, size = part.deltas[name]
                own = [entry for entry in part.entries if entry.name == name]
                archive.graft(own, part_bytes(part.path, offset, size), start=offset)
        archive.close()
        size = hashed.size
    return size, hashed.digest.hexdigest()


def _add(archive: ZipWriter, name: str, data: bytes, shared: Shared) -> None:
    """Append an entry without seeking: made in memory, then moved."""
    alone = io.BytesIO()
    writer = ZipWriter(alone)
    writer.add(name, data, data_compression(shared.options))
    archive.graft(writer.entries, [alone.getvalue()[: writer.size]])


def _opened(target: Path, *, overwrite: bool) -> AbstractContextManager[Any]:
    """Open what takes the place of the target when it is whole."""
    if is_url(target):
        return replacing_object(target, overwrite=overwrite, block_bytes=LARGE_BLOCK_BYTES)
    return replacing(target, overwrite=overwrite)


def check_published(target: Path, num_splats: int, num_frames: int, bands: int) -> None:
    """Hold the header of the bundle against what it was made from."""
    expected = GaussianSequence(_no_frame, num_splats=num_splats, sh_degree=bands, num_frames=num_frames)
    with target.open("rb") as stream:
        check_header(stream, tasks.FORMAT, expected)


def _no_frame(_frame_id: int) -> Any:
    raise AssertionError("a header needs no frame")


def folder_of_parts(target: Path, parts: str | None) -> str:
    """Return a folder that holds the parts of this target and nothing else."""
    whole = url_of(target) if is_url(target) else str(target.absolute())
    place, _, name = whole.replace("\\", "/").rpartition("/")
    if parts is None:
        return f"{place}/.{name}{PARTS_SUFFIX}"
    own = f"{name}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}{PARTS_SUFFIX}"
    return f"{url_of(parts).rstrip('/') if is_url(parts) else Path(local_path(parts)).absolute()}/{own}"


def remove_parts(folder: str) -> None:
    """Remove parts that are no longer needed; what cannot be removed only takes room."""
    try:
        if is_url(folder):
            remove(folder)
            return
        for path in Path(folder).iterdir():
            if path.suffix in (".part", ".gsplat-tmp"):
                path.unlink(missing_ok=True)
        with suppress(OSError):
            Path(folder).rmdir()
    except (OSError, WriteError) as error:
        warnings.warn(GsplatWarning(f"finished segments could not be removed: {error}", code="parts-left"), stacklevel=3)
