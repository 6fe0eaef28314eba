"""Where the files of a SOG scene lie, a ZIP archive or the folder of its meta.json, and its images."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from gsplat_tools.cloud import REST_COEFFICIENTS
from gsplat_tools.formats import _json, _webp
from gsplat_tools.formats._issues import naming_rules
from gsplat_tools.formats._limits import splat_bytes, too_much
from gsplat_tools.formats._stream import stream_size
from gsplat_tools.formats._zip import ZipReader, is_relative_name
from gsplat_tools.formats.sog.meta import META_NAME, Meta, parse_meta
from gsplat_tools.formats.sog.rules import MAX_PALETTE, PALETTE_COLUMNS, fault

Codes = NDArray[np.uint8]

_LOOSE_FIT, _ANY_LAYOUT = 4, 1 << 16
"""Images may be this many times as large as the splats need, and any image may have 65,536 pixels."""

_PALETTE_PIXELS = MAX_PALETTE * REST_COEFFICIENTS[3]
"""Pixels of the largest SH palette."""


class Files(Protocol):
    """Files by relative name."""

    def read(self, name: str, *, at_most: int | None = None) -> bytes:
        """Return the bytes of a file, or raise FormatError where it is not there or larger than what it can need."""
        ...

    def __contains__(self, name: str) -> bool: ...


class Folder:
    """The files beside a meta.json; nothing outside its folder is read, not even through links.

    Parameters
    ----------
    root
        The folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()

    def __contains__(self, name: str) -> bool:
        try:
            return is_relative_name(name) and self._inside(name).is_file()
        except (OSError, UnicodeEncodeError):  # longer than the file system allows, or not in its alphabet
            return False

    def read(self, name: str, *, at_most: int | None = None) -> bytes:
        """Return the bytes of a file.

        Parameters
        ----------
        name
            Relative to the folder.
        at_most
            Bytes that what it holds can need.

        Raises
        ------
        CorruptDataError
            There is no such file inside the folder.
        LimitExceededError
            It has more than `at_most` bytes.
        """
        if not is_relative_name(name):
            raise fault("path", f"expected a relative path, found {name!r}", name)
        try:
            path = self._inside(name)
            size = path.stat().st_size
            if at_most is not None and size > at_most:
                raise fault("zip-entry-size", f"expected at most {at_most} bytes, the file has {size}", name)
            return path.read_bytes()
        except OSError as error:
            raise fault("file-missing", f"the file is not in the folder {self.root} ({error.strerror})", name) from error
        except UnicodeEncodeError as error:
            raise fault("path", f"the name is not in the alphabet of file names ({error.reason})", name) from error

    def _inside(self, name: str) -> Path:
        path = (self.root / name).resolve()
        if not path.is_relative_to(self.root):
            raise fault("path", f"the path leads out of the folder {self.root}", name)
        return path


@dataclass(frozen=True, slots=True)
class Bundle:
    """The files of one scene, their meta.json read.

    Parameters
    ----------
    files
        Where they lie.
    meta
        What meta.json says.
    prefix
        Folder of meta.json inside `files`, with a slash at its end, or empty.
    """

    files: Files
    meta: Meta
    prefix: str = ""

    def codes(self, stream: str) -> Codes:
        """Return the bytes of every splat in an image, (N, 4); its size is checked before it is decoded.

        Raises
        ------
        FormatError
            It is not a still lossless WebP image with a pixel for every splat.
        """
        data, header = self._header(stream, _LOOSE_FIT * self.meta.count + _ANY_LAYOUT)
        if header.width * header.height < self.meta.count:
            raise fault(
                "image-size",
                f"expected a pixel for each of {self.meta.count} splats, found {header.width} x {header.height}",
                self.path(stream),
            )
        return self._decode(stream, data, header).reshape(-1, 4)[: self.meta.count]

    def sh_degree(self) -> int:
        """Return the highest SH band; version 1 says it by the width of the image of centroids.

        Raises
        ------
        FormatError
            That image is missing or has another width.
        """
        if self.meta.bands is not None:
            return self.meta.bands
        width = self._header("shN_centroids", _PALETTE_PIXELS)[1].width
        for degree in (1, 2, 3):
            if width == PALETTE_COLUMNS * REST_COEFFICIENTS[degree]:
                return degree
        raise fault("palette-size", f"expected a width of 192, 512 or 960, found {width}", self.path("shN_centroids"))

    def palette(self) -> NDArray[np.float32]:
        """Return the entries of the SH palette, (K, C, 3).

        Raises
        ------
        FormatError
            The image is no such palette, or an index lies outside the codebook.
        """
        path = self.path("shN_centroids")
        coefficients = REST_COEFFICIENTS[self.sh_degree()]
        data, header = self._header("shN_centroids", _PALETTE_PIXELS)
        count = self.meta.palette_count
        if count is None:
            count = PALETTE_COLUMNS * header.height
        if header.width != PALETTE_COLUMNS * coefficients or header.height * PALETTE_COLUMNS < count:
            raise fault(
                "palette-size",
                f"expected {PALETTE_COLUMNS * coefficients} x {-(-count // PALETTE_COLUMNS)} pixels for {count} entries, found "
                f"{header.width} x {header.height}",
                path,
            )
        image = self._decode("shN_centroids", data, header)
        indices = image.reshape(-1, coefficients, 4)[:count, :, :3]
        check_indices(indices, len(self.meta.shn), path)
        return self.meta.shn[indices]

    def stored_bytes(self) -> int:
        """Return the bytes of the images in a folder; those that are missing have none."""
        root = self.files.root if isinstance(self.files, Folder) else Path()
        paths = {self.path(stream) for stream in self.meta.files}
        return sum((root / path).stat().st_size for path in paths if path in self.files)

    def path(self, stream: str) -> str:
        """Return the name of an image's file."""
        return self.prefix + self.meta.files[stream]

    def _header(self, stream: str, most_pixels: int) -> tuple[bytes, _webp.WebpHeader]:
        """Return the file of an image and its size, held against what the scene can need."""
        path = self.path(stream)
        if path not in self.files:
            raise fault("file-missing", "the file that meta.json names is not there", path)
        data = self.files.read(path, at_most=_webp.most_bytes(most_pixels, 1))
        with naming_rules({path: "image-format"}):
            header = _webp.parse_header(data, field=path)
        if header.width * header.height > most_pixels:
            message = f"expected at most {most_pixels} pixels, found {header.width} x {header.height}: far more than are used"
            raise fault("image-limit", message, path)
        return data, header

    def _decode(self, stream: str, data: bytes, header: _webp.WebpHeader) -> _webp.Image:
        path = self.path(stream)
        with naming_rules({path: "image-format"}):
            return _webp.decode_rgba(data, header.width, header.height, field=path)


_JSON_SPACE = b"\xef\xbb\xbf \t\r\n"
_JSON_STARTS = frozenset(bytes([byte]) for byte in b'{["-0123456789tfnNI')
"""What a JSON text starts with, objects and all else."""


def open_bundle(stream: BinaryIO) -> tuple[Bundle | None, Folder | None]:
    """Return the scene of a .sog archive or of a folder's meta.json; (None, its folder) for a lod-meta.json.

    Raises
    ------
    FormatError
        The archive or meta.json breaks a rule.
    """
    head = stream.read(64)
    stream.seek(0)
    if head[:2] == b"PK":
        archive = ZipReader(stream)
        prefix = _prefix(archive)
        if prefix + META_NAME not in archive:
            message = f"expected a meta.json at the root of the archive, found {len(archive.names)} other entries"
            raise fault("meta-missing", message, META_NAME)
        bundle = Bundle(archive, parse_meta(archive.description(prefix + META_NAME), available=archive.length), prefix)
        check_count(bundle.meta, stream_size(stream))
        return bundle, None
    if head.lstrip(_JSON_SPACE)[:1] not in _JSON_STARTS:
        found = f"one that starts with {head[:16]!r}" if head else "an empty one"
        message = f"expected a ZIP archive or a meta.json, found {found}; copy or download the file again"
        raise fault("zip-invalid", message, "archive")
    folder = folder_of(stream)
    data = stream.read(_json.longest(0) + 1)
    stream.seek(0)
    if is_lod(data):
        return None, folder
    bundle = Bundle(folder, parse_meta(data))
    check_count(bundle.meta, bundle.stored_bytes())
    return bundle, None


def check_count(meta: Meta, available: int) -> None:
    """Refuse more splats than the files can hold.

    Parameters
    ----------
    meta
        What is claimed.
    available
        Bytes of the archive, or of the images.

    Raises
    ------
    LimitExceededError
        There are.
    """
    message = too_much(meta.count * splat_bytes(3 if meta.bands is None else meta.bands), available)
    if message is not None:
        raise fault("image-limit", message, f"{META_NAME} count")


def folder_of(stream: BinaryIO) -> Folder:
    """Return the folder of an open file.

    Raises
    ------
    CorruptDataError
        The stream is not a file by name, so that nothing can be found beside it.
    """
    name = getattr(stream, "name", None)
    if not isinstance(name, str | os.PathLike):
        raise fault("file-missing", "a meta.json needs the images beside it: give its path, or a .sog archive", META_NAME)
    return Folder(Path(name).parent)


def is_lod(data: bytes) -> bool:
    """Whether a JSON file is a lod-meta.json."""
    return b'"lodLevels"' in data or (b'"filenames"' in data and b'"tree"' in data)


def check_indices(indices: Codes, size: int, path: str) -> None:
    """Refuse indices beyond a codebook.

    Raises
    ------
    CorruptDataError
        One is not below `size`.
    """
    if indices.size and int(indices.max()) >= size:
        count = int(np.count_nonzero(indices >= size))
        raise fault("codebook-index", f"expected indices below {size}, found {count} of {int(indices.max())} at most", path)


def _prefix(archive: ZipReader) -> str:
    """Return the one folder that holds everything, for archives that were made by packing a folder."""
    if META_NAME in archive:
        return ""
    found = [name for name in archive.names if name.endswith("/" + META_NAME)]
    return found[0].removesuffix(META_NAME) if len(found) == 1 else ""
