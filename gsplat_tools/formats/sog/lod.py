"""lod-meta.json: a tree of boxes that refers, level by level, to rows of bundles in folders beside it."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any, BinaryIO

from gsplat_tools.cloud import GaussianCloud, concatenate
from gsplat_tools.errors import CapabilityError
from gsplat_tools.formats import _json
from gsplat_tools.formats._zip import ZipReader, is_relative_name
from gsplat_tools.formats.sog.bundle import Bundle, Folder, check_count
from gsplat_tools.formats.sog.meta import META_NAME, Fields, parse_json, parse_meta
from gsplat_tools.formats.sog.rules import fault

LOD_NAME = "lod-meta.json"
MAX_LEVELS = 256


@dataclass(frozen=True, slots=True)
class Piece:
    """Rows of one bundle."""

    file: int
    offset: int
    count: int


@dataclass(frozen=True, slots=True)
class LodScene:
    """A streamed scene.

    Parameters
    ----------
    folder
        Where lod-meta.json lies.
    filenames
        meta.json or archive of each bundle, relative.
    levels
        Pieces of each level, by file and row.
    environment
        Bundle that belongs to every level, or None.
    """

    folder: Folder
    filenames: list[str]
    levels: list[list[Piece]]
    environment: str | None

    def pieces(self, level: int) -> list[Piece]:
        """Return the pieces of a level.

        Raises
        ------
        CapabilityError
            There is no such level.
        """
        if not 0 <= level < len(self.levels):
            raise CapabilityError(f"expected a level in 0..{len(self.levels) - 1}, got lod={level}", field=LOD_NAME)
        return self.levels[level]

    def bundles(self, level: int) -> Iterator[tuple[Bundle, list[Piece]]]:
        """Yield each bundle of a level with the rows that belong to it, the environment last."""
        pieces = self.pieces(level)
        for file in sorted({piece.file for piece in pieces}):
            yield self._open(self.filenames[file]), [piece for piece in pieces if piece.file == file]
        if self.environment is not None:
            bundle = self._open(self.environment)
            yield bundle, [Piece(-1, 0, bundle.meta.count)]

    def read(self, level: int, decode: Callable[[Bundle], GaussianCloud]) -> GaussianCloud:
        """Return the splats of a level, in the order of files and rows.

        Raises
        ------
        FormatError
            A bundle is missing or broken.
        CapabilityError
            There is no such level, or its bundles are of several splat models.
        """
        from gsplat_tools.ops.harmonics import with_sh_degree

        clouds: list[GaussianCloud] = []
        for bundle, pieces in self.bundles(level):
            for piece in pieces:
                if piece.offset + piece.count > bundle.meta.count:
                    message = f"rows {piece.offset} to {piece.offset + piece.count} are named, {bundle.meta.count} are there"
                    raise fault("lod-tree", message, bundle.prefix + META_NAME)
            cloud = decode(bundle)
            rows = [cloud.take(slice(piece.offset, piece.offset + piece.count)) for piece in pieces]
            clouds += [cloud] if _covers(pieces, len(cloud)) else rows
        if not clouds:
            raise fault("lod-tree", f"level {level} has no splats", LOD_NAME)
        degree = max(cloud.sh_degree for cloud in clouds)
        models = {cloud.splat_model for cloud in clouds}
        if len(models) > 1:
            raise CapabilityError(
                f"the bundles are of several splat models ({', '.join(sorted(models))}); read them one by one"
            )
        return concatenate([with_sh_degree(cloud, degree) for cloud in clouds])

    def _open(self, name: str) -> Bundle:
        data = self.folder.read(name)
        if data[:2] == b"PK":
            archive = ZipReader(io.BytesIO(data))
            if META_NAME not in archive:
                raise fault("meta-missing", "expected a meta.json at the root of the archive", name)
            meta = parse_meta(archive.description(META_NAME), f"{name} {META_NAME}", available=archive.length)
            check_count(meta, len(data))
            return Bundle(archive, meta)
        parent = str(PurePosixPath(name).parent)
        bundle = Bundle(self.folder, parse_meta(data, name), "" if parent == "." else parent + "/")
        check_count(bundle.meta, bundle.stored_bytes())
        return bundle


def read_text(stream: BinaryIO) -> bytes:
    """Return the bytes of a lod-meta.json, of one that is too long only as many as `parse_lod` needs to refuse it."""
    return stream.read(_json.longest(0) + 1)


def parse_lod(data: bytes, folder: Folder) -> LodScene:
    """Return what lod-meta.json says.

    Parameters
    ----------
    data
        The file.
    folder
        Where it lies.

    Raises
    ------
    FormatError
        It breaks a rule of docs/formats/sog.md.
    """
    root = Fields(parse_json(data, LOD_NAME), LOD_NAME)
    version = root.value.get("version", 1)  # older files do not say it
    if version != 1:
        raise fault("version", f"expected version 1, found {_json.shown(version)}", root.at("version"))
    filenames = root.value.get("filenames")
    if not isinstance(filenames, list) or not all(isinstance(name, str) for name in filenames):
        raise fault("files", "expected a list of file names", root.at("filenames"))
    num_levels = root.integer("lodLevels")
    if num_levels > MAX_LEVELS:
        raise fault("lod-tree", f"expected at most {MAX_LEVELS} levels, found {num_levels}", root.at("lodLevels"))
    environment = root.value.get("environment")
    for name in [*filenames, *([environment] if environment is not None else [])]:
        if not isinstance(name, str) or not is_relative_name(name):
            raise fault("path", f"expected a relative path, found {_json.shown(name)}", root.at("filenames"))
    levels: dict[int, list[Piece]] = {}
    for level, piece in _pieces(root.child("tree"), len(filenames)):
        if level >= num_levels:
            raise fault("lod-tree", f"expected levels below {num_levels}, found {level}", root.at("tree"))
        levels.setdefault(level, []).append(piece)
    ordered = [sorted(levels.get(i, []), key=lambda p: (p.file, p.offset)) for i in range(max(levels, default=-1) + 1)]
    for pieces in ordered:
        _check_disjoint(pieces, root)
    counts = root.value.get("counts")
    found = [sum(piece.count for piece in pieces) for pieces in ordered]
    if isinstance(counts, list) and counts[: len(found)] != found:
        raise fault("count", f"expected {counts[:8]} splats in the levels, found {found[:8]} in the tree", root.at("counts"))
    return LodScene(folder, filenames, ordered, environment)


def _pieces(tree: Fields, num_files: int) -> Iterator[tuple[int, Piece]]:
    """Yield (level, rows) of every leaf."""
    pending = [tree]
    while pending:
        node = pending.pop()
        children = node.value.get("children") or []
        lods = node.value.get("lods") or {}
        if not isinstance(children, list) or not isinstance(lods, dict) or not all(isinstance(c, dict) for c in children):
            raise fault("lod-tree", "expected children as a list of objects and lods as an object", tree.at("children"))
        pending += [Fields(child, node.at("children")) for child in reversed(children)]
        for key, reference in lods.items():
            where = node.at(f"lods.{key[:20]}")
            if not (key.isascii() and key.isdigit() and len(key) < 9 and isinstance(reference, dict)):
                raise fault("lod-tree", f"expected a level and an object, found {key[:20]!r}", where)
            fields = Fields(reference, where)
            piece = Piece(*(fields.integer(name) for name in ("file", "offset", "count")))
            if piece.file >= num_files:
                raise fault("lod-tree", f"expected a file below {num_files}, found {piece.file}", fields.at("file"))
            yield int(key), piece


def _check_disjoint(pieces: list[Piece], root: Fields) -> None:
    """Refuse rows that are named twice in a level: few bytes would become many splats."""
    for one, other in pairwise(piece for piece in pieces if piece.count):
        if one.file == other.file and other.offset < one.offset + one.count:
            message = f"rows {other.offset} to {one.offset + one.count} of file {one.file} are named twice in a level"
            raise fault("lod-tree", message, root.at("tree"))


def _covers(pieces: list[Piece], count: int) -> bool:
    """Whether ascending pieces are all rows in order."""
    position = 0
    for piece in pieces:
        if piece.offset != position:
            return False
        position += piece.count
    return position == count


def facts(scene: LodScene) -> dict[str, Any]:
    """Return what inspect shows of a streamed scene."""
    return {
        "levels": [sum(piece.count for piece in pieces) for pieces in scene.levels],
        "files": len(scene.filenames),
        "environment": scene.environment,
    }
