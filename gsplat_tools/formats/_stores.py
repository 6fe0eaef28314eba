"""Objects in stores as sources and targets, through fsspec: read by range, written by parts, published last.

A URL such as s3://bucket/key goes through the package as a path, which writes it s3:/bucket/key; what is here takes both.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

from gsplat_tools.errors import GsplatError, MissingDependencyError, ReadError, TargetExistsError, WriteError

BLOCK_BYTES = 8 << 20
"""Bytes of a range that is read, and of a part that is written: a store takes 10,000 parts, and none below 5 MiB."""

LARGE_BLOCK_BYTES = 64 << 20
"""The same for targets whose size is not known: up to 640 GB."""

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/{1,2}(?=[^/]|$)(.*)", re.DOTALL)
_EXTRAS = {"s3": "s3fs (pip install 'gsplat_tools[s3]')", "gs": "gcsfs (pip install 'gsplat_tools[gs]')"}

# s3fs tries again by itself, for half a minute; the SDK below it, for connections that are refused or time out.
_TIMEOUTS = {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 5, "mode": "standard"}}


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


def file_system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it.

    Raises
    ------
    MissingDependencyError
        fsspec, or what it needs for this store, is not installed.
    """
    scheme = url.partition(":")[0]
    try:
        import fsspec
    except ImportError as error:
        raise MissingDependencyError(
            f"{scheme}:// needs fsspec; install it with pip install 'gsplat_tools[cluster]'"
        ) from error
    options: dict[str, Any] = {}
    if scheme in ("s3", "s3a"):
        options = {"config_kwargs": _TIMEOUTS, "default_block_size": BLOCK_BYTES}
    try:
        found = fsspec.core.url_to_fs(url, **options)
    except ImportError as error:
        raise MissingDependencyError(f"{scheme}:// needs {_EXTRAS.get(scheme, 'its fsspec package')}: {error}") from error
    except ValueError as error:
        raise ReadError(f"no store is known for {scheme}://; {error}", path=url) from error
    return cast("tuple[Any, str]", found)


@contextmanager
def _explained(url: str, kind: type[ReadError] | type[WriteError]) -> Iterator[None]:
    """Turn whatever a store or its library raises into an error that names the object."""
    try:
        yield
    except (GsplatError, FileNotFoundError):
        raise
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        verb = "read from" if kind is ReadError else "write to"
        raise kind(f"cannot {verb} the store: {said}; try again, or check its address and credentials", path=url) from error


class _Object(io.RawIOBase):
    """An object open for reading, by ranges; errors name it."""

    def __init__(self, url: str, stream: Any) -> None:
        self.name = url
        self._stream = stream

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return int(self._stream.seek(offset, whence))

    def tell(self) -> int:
        return int(self._stream.tell())

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer).cast("B")
        with _explained(self.name, ReadError):
            data = self._stream.read(len(view))
        view[: len(data)] = data
        return len(data)

    def close(self) -> None:
        if not self.closed:
            self._stream.close()
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
        try:
            stream = system.open(name, "rb", block_size=BLOCK_BYTES, cache_type="readahead")
        except FileNotFoundError as error:
            raise FileNotFoundError(2, "there is no such object", url) from error
    return io.BufferedReader(_Object(url, stream), 1 << 18)


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
        info = system.info(name)
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
        return bool(system.exists(name))


def matching(pattern: str | Path) -> list[str]:
    """Return the URLs of objects that match a pattern, or that lie below a prefix that ends with a slash."""
    url = url_of(pattern)
    with _explained(url, ReadError):
        system, name = file_system(url)
        system.invalidate_cache()
        found = system.glob(f"{name.rstrip('/')}/*" if url.endswith("/") else name, detail=True)
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
            if not overwrite and exists(self.name):
                raise TargetExistsError("the target appeared while it was being made; it is left as it is", path=self.name)
            self._stream.commit()
            self._system.invalidate_cache(self._path.rpartition("/")[0])
            size = self._system.info(self._path)["size"]
        if size != self.written:
            raise WriteError(f"{self.written} bytes were sent and the store holds {size}; convert again", path=self.name)
        super().close()

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
        raise TargetExistsError("the target exists; use --overwrite (library: overwrite=True) to replace it", path=url_of(path))
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
            system.rm(name, recursive=True)
