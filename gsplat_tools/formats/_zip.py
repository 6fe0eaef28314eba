"""ZIP archives: read after checks of every claim, written so that the same entries give the same bytes."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import BinaryIO, Literal

from gsplat_tools.errors import CorruptDataError, LimitExceededError, ReadError
from gsplat_tools.formats import _json
from gsplat_tools.formats._issues import Issue, Rule, raise_errors, refuse
from gsplat_tools.formats._limits import MAX_EXPANSION, max_memory
from gsplat_tools.formats._stream import stream_size

Compression = Literal["stored", "deflated"]

MAX_ENTRIES = 1 << 22
"""More entries than any bundle of 100,000 frames needs."""

_FIXED_TIME = (1980, 1, 1, 0, 0, 0)
_SLACK_BYTES = 1 << 16
_LOCAL_HEADER = 30

RULES: dict[str, Rule] = {
    "zip-invalid": Rule(severity="error", meaning="The file is a ZIP archive that can be opened."),
    "zip-too-many-entries": Rule(
        severity="error", meaning=f"The archive has at most {MAX_ENTRIES} entries.", error=LimitExceededError
    ),
    "zip-bad-name": Rule(severity="error", meaning="Entry names are relative, with / between parts, without . or .."),
    "zip-duplicate": Rule(severity="error", meaning="Entry names are unique: readers would take different ones for the file."),
    "zip-repeated": Rule(
        severity="warning",
        meaning="meta.json occurs once; other tools add a second one when they repair it, and the last counts.",
    ),
    "zip-encrypted": Rule(severity="error", meaning="Entries are not encrypted."),
    "zip-method": Rule(severity="error", meaning="Entries are stored or deflated."),
    "zip-ratio": Rule(
        severity="error",
        meaning=f"No entry claims more than {MAX_EXPANSION} times its compressed size, or --max-memory.",
        error=LimitExceededError,
    ),
    "zip-entry-size": Rule(
        severity="error", meaning="No entry is larger than what it holds can need.", error=LimitExceededError
    ),
    "zip-overlap": Rule(severity="error", meaning="No two entries share bytes of the archive."),
    "zip-entry-corrupt": Rule(severity="error", meaning="Every entry that is read decompresses and matches its CRC."),
}


class ZipReader:
    """A ZIP archive whose directory has been checked.

    Parameters
    ----------
    stream
        Can seek; stays open as long as entries are read. Reads from several threads are safe.
    refuses
        Whether to raise the first error of the directory; else `issues` holds them all.
    repeatable
        Names that may occur again; the last entry counts.

    Attributes
    ----------
    length
        Bytes of the archive.

    Raises
    ------
    CorruptDataError, LimitExceededError
        The stream is no archive, or breaks a rule of `RULES`.
    """

    def __init__(self, stream: BinaryIO, *, refuses: bool = True, repeatable: Collection[str] = ()) -> None:
        self.length = stream_size(stream)
        stream.seek(0)
        try:
            self._archive = zipfile.ZipFile(stream)
        except (zipfile.BadZipFile, NotImplementedError, ValueError, OSError, OverflowError, struct.error) as error:
            raise_read_error(error)
            message = f"expected a ZIP archive, found none that can be opened ({error}); copy or download the file again"
            raise refuse(Issue(code="zip-invalid", message=message, field="archive", offset=0), RULES) from error
        issues = list(check_directory(self._archive.infolist(), self._archive.start_dir, repeatable))
        self.issues = raise_errors(issues, RULES) if refuses else issues
        self._last = {info.filename: info for info in self._archive.infolist()}
        starts = sorted({info.header_offset for info in self._archive.infolist()} | {self._archive.start_dir})
        self._next_start = dict(pairwise(starts))
        self._stream = stream

    @property
    def names(self) -> list[str]:
        """Distinct entry names, in the order of the archive."""
        return list(self._last)

    def __contains__(self, name: str) -> bool:
        return name in self._last

    def size(self, name: str) -> int:
        """Return the length of an entry as its directory record claims."""
        return self._last[name].file_size

    def stored_size(self, name: str) -> int:
        """Return the bytes that an entry takes in the archive."""
        return self._last[name].compress_size

    def method(self, name: str) -> str:
        """Return how an entry is compressed."""
        return "stored" if self._last[name].compress_type == zipfile.ZIP_STORED else "deflated"

    def description(self, name: str) -> bytes:
        """Return the bytes of a JSON entry, for `_json.parse` with the `length` of the archive.

        Raises
        ------
        CorruptDataError, LimitExceededError
            As `read`; it claims more than what may describe an archive of this length.
        """
        longest = _json.longest(self.length)
        if name in self and self.size(name) > longest:
            message = (
                f"expected at most {longest} bytes that describe the others, the entry claims {self.size(name)}; "
                "if you trust the file, allow them with --max-memory (library: use_max_memory)"
            )
            raise refuse(Issue(code="zip-entry-size", message=message, field=name), RULES)
        return self.read(name)

    def read(self, name: str, *, frame: int | None = None, at_most: int | None = None) -> bytes:
        """Return the bytes of the last entry of that name.

        Parameters
        ----------
        name, frame
            The entry, and the frame that errors name.
        at_most
            Bytes that what it holds can need; entries that claim more are not read.

        Raises
        ------
        CorruptDataError
            There is no such entry, or it does not decompress to what its record says.
        LimitExceededError
            It claims more than `at_most` bytes.
        """
        info = self._last.get(name)
        if info is None:
            raise CorruptDataError("the archive has no such entry", field=name, frame=frame)
        if at_most is not None and info.file_size > at_most:
            message = f"expected at most {at_most} bytes, the entry claims {info.file_size}"
            raise refuse(Issue(code="zip-entry-size", message=message, field=name, frame=frame), RULES)
        try:
            self._check_place(info, frame)
            # Never more than the record says, whatever the compressed bytes hold; the end is where the CRC is checked.
            with self._archive.open(info) as entry:
                data = entry.read(info.file_size)
                entry.read(1)
        except CorruptDataError:
            raise
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, OSError, RuntimeError) as error:
            raise_read_error(error)
            issue = Issue(code="zip-entry-corrupt", message=f"the entry does not decompress ({error})", field=name, frame=frame)
            raise refuse(issue, RULES) from error
        if len(data) != info.file_size:
            message = f"the entry holds {len(data)} bytes, its record says {info.file_size}"
            raise refuse(Issue(code="zip-entry-corrupt", message=message, field=name, frame=frame), RULES)
        return data

    def _check_place(self, info: zipfile.ZipInfo, frame: int | None) -> None:
        """Refuse an entry whose local header moves its data into what follows; zipfile looks at that from 3.12 on.

        The header lies before the data: looking at those of all entries at once would go through the whole file.
        """
        with self._archive._lock:  # type: ignore[attr-defined]  # entries that are read in other threads seek too
            self._stream.seek(info.header_offset)
            header = self._stream.read(_LOCAL_HEADER)
        if len(header) < _LOCAL_HEADER:
            return  # zipfile says that it is cut off
        end = info.header_offset + _LOCAL_HEADER + sum(struct.unpack_from("<HH", header, 26)) + info.compress_size
        limit = self._next_start.get(info.header_offset, self._archive.start_dir)
        if end > limit:
            message = f"the entry shares bytes with what follows: it ends at {end}, the next one starts at {limit}"
            issue = Issue(code="zip-overlap", message=message, field=info.filename, frame=frame, offset=info.header_offset)
            raise refuse(issue, RULES)


def raise_read_error(error: BaseException) -> None:
    """Raise what the disk was at fault for, which zipfile takes for a fault of the archive."""
    for cause in (error, error.__context__):
        if isinstance(cause, ReadError):
            raise cause


def check_directory(entries: list[zipfile.ZipInfo], directory_offset: int, repeatable: Collection[str] = ()) -> Iterator[Issue]:
    """Yield what is wrong with the directory of an archive.

    Parameters
    ----------
    entries
        Its records.
    directory_offset
        Where it starts, which is where the last entry has to end.
    repeatable
        Names that may occur again.
    """
    if len(entries) > MAX_ENTRIES:
        yield Issue(
            code="zip-too-many-entries",
            message=f"expected at most {MAX_ENTRIES} entries, found {len(entries)}",
            value=len(entries),
        )
        return
    seen: set[str] = set()
    for info in entries:
        name = info.filename
        whole = info.orig_filename  # zipfile cuts names at a NUL
        if not is_relative_name(whole.removesuffix("/")):
            yield Issue(code="zip-bad-name", message=f"expected a relative name, found {whole!r}"[:200], field=name)
        if name in seen:
            code = "zip-repeated" if name in repeatable else "zip-duplicate"
            yield Issue(code=code, message="the name occurs again; the last entry counts", field=name)
        seen.add(name)
        if info.flag_bits & 0x41:
            yield Issue(code="zip-encrypted", message="the entry is encrypted; decrypt the archive first", field=name)
        if info.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            yield Issue(
                code="zip-method",
                message=f"expected a stored or deflated entry, found method {info.compress_type}",
                field=name,
                value=info.compress_type,
            )
        if info.file_size > max(info.compress_size * MAX_EXPANSION + _SLACK_BYTES, max_memory() or 0):
            yield Issue(
                code="zip-ratio",
                message=f"the entry claims {info.file_size} bytes from {info.compress_size}, more than is allowed; "
                "if you trust the file, allow it with --max-memory (library: use_max_memory)",
                field=name,
                value=info.file_size,
            )
    ordered = sorted(entries, key=lambda info: (info.header_offset, info.compress_size))
    places = [(info.header_offset, repr(info.filename)) for info in ordered] + [(directory_offset, "the directory")]
    for before, (start, name) in zip(ordered, places[1:], strict=True):
        # The local header may be longer than this by its extra field, which is looked at when the entry is read.
        if before.header_offset + _LOCAL_HEADER + before.compress_size > start:
            yield Issue(
                code="zip-overlap",
                message=f"the entry shares bytes with {name}"[:200],
                field=before.filename,
                offset=max(before.header_offset, 0),
            )


def is_relative_name(name: str) -> bool:
    """Whether a path is relative, with / as its only separator and no empty, . or .. part."""
    return bool(name) and not any(c in name for c in ":\\\0") and not {"", ".", ".."} & set(name.split("/"))


class _UnfinishedArchive(zipfile.ZipFile):
    """An archive that is left as it is when writing fails, instead of being ended by the garbage collector."""

    def __del__(self) -> None:
        pass


def _record(name: str, compression: Compression) -> zipfile.ZipInfo:
    """Return a directory record with what is the same for all entries."""
    info = zipfile.ZipInfo(name, _FIXED_TIME)
    info.create_system = 3  # else it differs by operating system
    info.external_attr = 0o644 << 16
    info.compress_type = zipfile.ZIP_STORED if compression == "stored" else zipfile.ZIP_DEFLATED
    return info


@dataclass(frozen=True, slots=True)
class Entry:
    """An entry that lies finished somewhere: what its directory record needs, and where it starts there."""

    name: str
    compression: Compression
    checksum: int
    stored_size: int
    size: int
    offset: int


class ZipWriter:
    """Writes entries one after another with fixed times and modes, so that equal entries give equal bytes.

    Parameters
    ----------
    stream
        Open for writing from its current position.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._archive = _UnfinishedArchive(stream, "w", allowZip64=True)

    def add(self, name: str, data: bytes, compression: Compression) -> None:
        """Append one entry."""
        self._archive.writestr(_record(name, compression), data, compresslevel=9)

    @property
    def size(self) -> int:
        """Bytes of the entries so far."""
        return self._archive.start_dir

    @property
    def entries(self) -> list[Entry]:
        """The entries so far, for `graft`."""
        return [
            Entry(
                info.filename,
                "stored" if info.compress_type == zipfile.ZIP_STORED else "deflated",
                info.CRC,
                info.compress_size,
                info.file_size,
                info.header_offset,
            )
            for info in self._archive.infolist()
        ]

    def graft(self, entries: Sequence[Entry], data: Iterable[bytes], *, start: int = 0) -> None:
        """Append entries that another writer made, without looking into them; the stream need not seek.

        Parameters
        ----------
        entries
            Their records, in order.
        data
            The bytes of that writer from `start` on, up to the end of the last entry.
        start
            Where the data begins in the other writer's bytes.
        """
        archive, stream = self._archive, self._stream
        base = archive.start_dir
        if stream.seekable():
            stream.seek(base)
        end = base
        for part in data:
            stream.write(part)
            end += len(part)
        for entry in entries:
            info = _record(entry.name, entry.compression)
            info.CRC, info.compress_size, info.file_size = entry.checksum, entry.stored_size, entry.size
            info.header_offset = base + entry.offset - start
            archive.filelist.append(info)
            archive.NameToInfo[info.filename] = info
        archive.start_dir = end

    def close(self) -> None:
        """Write the directory."""
        self._archive.close()

    def __enter__(self) -> ZipWriter:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()
