"""Codes of some splats of a still scene that stand in no file yet, asked for as a bundle is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.formats._issues import raise_errors
from gsplat_tools.formats._webp import Image
from gsplat_tools.formats.sog4d.bundle import centroids_of
from gsplat_tools.formats.sog4d.labels import Labels
from gsplat_tools.formats.sog4d.meta import Meta, PaletteMeta
from gsplat_tools.formats.sog4d.meta_reader import parse_meta
from gsplat_tools.formats.sog4d.rules import RULES
from gsplat_tools.formats.sog4d.textures import indices_of, rgba_image


def meta_in(entries: Mapping[str, bytes]) -> Meta:
    """Return what meta.json will say to readers."""
    meta, issues = parse_meta(entries["meta.json"])
    raise_errors(issues, RULES)
    assert meta is not None
    return meta


class Piece:
    """What `Bundle` gives, for splats whose images are not made: decoding and bounds take either.

    Parameters
    ----------
    meta
        What `meta_in` returns for the entries.
    entries
        meta.json and the palettes as they will stand in the archive.
    columns
        `FramePlanes.columns` of the splats.
    """

    def __init__(self, meta: Meta, entries: Mapping[str, bytes], columns: Mapping[str, NDArray[np.uint8]]) -> None:
        count = len(columns["rotation"])
        self.meta = replace(meta, splat_count=count, width=count, height=1)
        self._entries, self._columns = entries, columns

    def image(self, path: str, _frame: int | None = None) -> Image:
        """Return the pixels of the splats as an image of one row."""
        return rgba_image(self._columns[PurePosixPath(path).stem], self.meta.width, 1)

    def labels(self, palette: PaletteMeta, _frame: int) -> Labels:
        """Return the label of every splat."""
        return indices_of(self.image(f"{palette.name}_labels"), self.meta.splat_count)

    def centroids(self, palette: PaletteMeta) -> NDArray[np.float32]:
        """Return the entries of a palette, (K, C, 3)."""
        return centroids_of(palette, self._entries[palette.centroids_path])
