"""Objects in stores as sources and targets, through fsspec: read by range, written by parts, published last.

A URL such as s3://bucket/key goes through the package as a path, which writes it s3:/bucket/key; what is here takes both.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from gsplat_tools.errors import TARGET_EXISTS, GsplatError, ReadError, TargetExistsError, WriteError
from gsplat_tools.formats._store_requests import ask, fetch, file_system, in_words

BLOCK_BYTES = 8 << 20
"""Bytes of a range that is read, and of a part that is written: a store takes 10,000 parts, and none below 5 MiB."""

LARGE_BLOCK_BYTES = 64 << 20
"""The same for targets whose size is not known: up to 640 GB."""

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/{1,2}(?=[^/]|$)(.*)", re.DOTALL)


def is_url(path: str | Path) -> bool:
    """Whether a path names an object in a store; file:// is none, see `local_path`."""
    match = _URL.fullmatch(_text(path))
    return match is not None and match[1] != "file"


def url_of(path: str | Path) -> str:
    """Return a URL with the two slashes that a path loses; other paths as they are."""
    match = _URL.fullmatch(_text(path))
    return str(path) if match is None or match[1] == "file" else f"{match[1]}://{match[2]}"


def local_path(path: str | Path) -> str | Path:
    """Return file:///folder/name as /folder/name, and everything else as it is."""
    match = re.fullmatch(r"file:/+(.*)", _text(path), re.DOTALL)
    return path if match is None else Path(f"/{match[1]}")


def _text(path: str | Path) -> str:
    return path if isinstance(path, str) else path.as_posix()


@contextmanager
def _explained(url: str, kind: type[ReadError] | type[WriteError]) -> Iterator[None]:
    """Turn whatever a store or its library raises into an error that names the object."""
    try:
        yield
    except GsplatError:
        raise
    except Exception as error:
        if isinstance(error, FileNotFoundError) and kind is ReadError:
            raise
        verb = "read from" if kind is ReadError else "write to"
        raise kind(f"cannot {verb} the store: {in_words(error)}", path=url) from error


class _Object(io.RawIOBase):
    """An object open for reading, by ranges; errors name it."""

    def __init__(self, url: str, system: Any, path: str) -> None:
        self.name = url
        self._system, self._path = system, path
        self._info = ask(system, "info", path)
        self._size = int(self._info["size"])
        self._position = self._start = 0
        self._block = b""

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        self._position = max(0, start + offset)
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer).cast("B")
        if not len(view) or self._position >= self._size:
            return 0
        offset = self._position - self._start
        if not 0 <= offset < len(self._block):
            end = min(self._position + BLOCK_BYTES, self._size)
            with _explained(self.name, ReadError):
                self._block = fetch(self._system, self._path, self._position, end, self._info)
            self._start, offset = self._position, 0
        data = self._block[offset : offset + len(view)]
        view[: len(data)] = data
        self._position += len(data)
        return len(data)

    def close(self) -> None:
        self._block = b""
        super().close()


def open_object(path: str | Path) -> BinaryIO:
    """Open an object for reading by ranges.

    Raises
    ------
    FileNotFoundError
        There is none.
    ReadError
        By this and by every read that the store fails.
    """
    url = url_of(path)
    with _explained(url, ReadError):
        system, name = file_system(url)
        system.invalidate_cache(name.rpartition("/")[0])
        try:
            stream = _Object(url, system, name)
        except FileNotFoundError as error:
            raise FileNotFoundError(2, "there is no such object", url) from error
    return io.BufferedReader(stream, 1 << 18)


def identity(path: str | Path) -> str:
    """Return what changes when a file or an object is written again: its size with its time, or the store's tag.

    Raises
    ------
    FileNotFoundError
        There is none.
    ReadError
        The store cannot tell.
    """
    if not is_url(path):
        status = Path(local_path(path)).stat()
        return f"{status.st_size} {status.st_mtime_ns}"
    url = url_of(path)
    with _explained(url, ReadError):
        system, name = file_system(url)
        system.invalidate_cache(name.rpartition("/")[0])
        info = ask(system, "info", name)
    tag = next((info[key] for key in ("ETag", "etag", "mtime", "LastModified", "created") if info.get(key)), "")
    return f"{info['size']} {tag}"


def exists(path: str | Path) -> bool:
    """Whether a file or an object is there."""
    if not is_url(path):
        return Path(local_path(path)).exists()
    url = url_of(path)
    with _explained(url, ReadError):
        system, name = file_system(url)
        system.invalidate_cache(name.rpartition("/")[0])
        with suppress(FileNotFoundError):
            ask(system, "info", name)
            return True
    return False


def matching(pattern: str | Path) -> list[str]:
    """Return the URLs of objects that match a pattern, or that lie below a prefix that ends with a slash."""
    url = url_of(pattern)
    with _explained(url, ReadError):
        system, name = file_system(url)
        system.invalidate_cache()
        found = ask(system, "glob", f"{name.rstrip('/')}/*" if url.endswith("/") else name, detail=True, is_slow=True)
    return [str(system.unstrip_protocol(each)) for each, info in found.items() if info["type"] == "file"]


class ObjectWriter(io.RawIOBase):
    """A new object, sent by parts; nobody sees it before `publish`."""

    def __init__(self, path: str | Path, *, block_bytes: int = BLOCK_BYTES) -> None:
        self.name = url_of(path)
        self.written = 0
        with _explained(self.name, WriteError):
            self._system, self._path = file_system(self.name)
            self._stream = _open_unpublished(self._system, self._path, block_bytes)

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self.written

    def write(self, data: Any, /) -> int:
        view = memoryview(data).cast("B")
        with _explained(self.name, WriteError):
            self._stream.write(view)
        self.written += len(view)
        return len(view)

    def publish(self, *, overwrite: bool) -> None:
        """Send what is left and let the object appear.

        Raises
        ------
        TargetExistsError
            It is there, and may not be replaced.
        WriteError
            The store refuses, or does not hold as many bytes as were sent.
        """
        with _explained(self.name, WriteError):
            self._stream.close()
            before = self._published()
            if before is not None and not overwrite:
                raise TargetExistsError("the target appeared while it was being made; it is left as it is", path=self.name)
            try:
                self._stream.commit()
            except Exception:
                # The answer may have been lost on its way after the store had done it all.
                with suppress(Exception):
                    found = self._published(tries=1)
                    if found is not None and found != before and found["size"] == self.written:
                        super().close()
                        return
                raise
            found = self._published() or {"size": 0}
        if found["size"] != self.written:
            raise WriteError(
                f"{self.written} bytes were sent and the store holds {found['size']}; convert again", path=self.name
            )
        super().close()

    def _published(self, tries: int | None = None) -> dict[str, Any] | None:
        """Return what the store says about the object, None where there is none."""
        self._system.invalidate_cache(self._path.rpartition("/")[0])
        with suppress(FileNotFoundError):
            return dict(ask(self._system, "info", self._path, tries=tries))
        return None

    def discard(self) -> None:
        """Give up: the parts that were sent are dropped, as far as the store can be reached."""
        with suppress(Exception):
            self._stream.discard()
        with suppress(Exception):
            self._stream.closed = True  # or the collector would send what is left
        super().close()

    def close(self) -> None:
        """Do nothing: a writer ends by `publish` or `discard`."""


class _Kept(io.BytesIO):
    """An object of a store without parts, kept until it is published."""

    def __init__(self, system: Any, path: str) -> None:
        super().__init__()
        self._system, self._path = system, path
        self._data = b""

    def close(self) -> None:
        if not self.closed:
            self._data = self.getvalue()
        super().close()

    def commit(self) -> None:
        self._system.pipe_file(self._path, self._data)

    def discard(self) -> None:
        self._data = b""


def _open_unpublished(system: Any, path: str, block_bytes: int) -> Any:
    """Return a file with `commit` and `discard`; memory:// shows what is opened at once."""
    if "memory" in system.protocol:
        return _Kept(system, path)
    return system.open(path, "wb", block_size=block_bytes, autocommit=False)


@contextmanager
def replacing_object(path: str | Path, *, overwrite: bool, block_bytes: int = BLOCK_BYTES) -> Iterator[ObjectWriter]:
    """Open a new object that appears, whole, when the block ends without an exception.

    Raises
    ------
    TargetExistsError
        The target is there and `overwrite` is false.
    WriteError
        The store refuses to take it.
    """
    if not overwrite and exists(path):
        raise TargetExistsError(TARGET_EXISTS, path=url_of(path))
    writer = ObjectWriter(path, block_bytes=block_bytes)
    try:
        yield writer
        writer.publish(overwrite=overwrite)
    except BaseException:
        writer.discard()
        raise


def remove(path: str | Path) -> None:
    """Remove an object or everything below a prefix, if it is there."""
    url = url_of(path)
    with _explained(url, WriteError):
        system, name = file_system(url)
        system.invalidate_cache()
        with suppress(FileNotFoundError):
            ask(system, "rm", name, recursive=True, is_slow=True)
