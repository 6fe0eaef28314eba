"""A bundle as the files of a folder: the images beside a meta.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, BinaryIO

from gsplat_tools.formats._zip import ZipReader
from gsplat_tools.formats.base import FolderLayout
from gsplat_tools.formats.sog.encode import meta_text
from gsplat_tools.formats.sog.meta import META_NAME, parse_meta


def unpack(stream: BinaryIO, take: Callable[[str, bytes], str]) -> bytes:
    """Hand every image of a bundle over; return the meta.json that names them as they were taken."""
    archive = ZipReader(stream)
    meta: dict[str, Any] = json.loads(archive.read(META_NAME))
    for part in meta.values():
        if isinstance(part, dict) and "files" in part:
            part["files"] = [take(name, archive.read(name)) for name in part["files"]]
    return meta_text(meta)


def named_files(data: bytes) -> list[str]:
    """Return the images that a meta.json names.

    Raises
    ------
    FormatError
        It cannot be read.
    """
    return list(parse_meta(data).files.values())


FOLDER = FolderLayout(index=META_NAME, unpack=unpack, named_files=named_files)
