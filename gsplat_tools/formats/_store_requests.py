"""Requests to stores that come to an end: a time for each, a number of tries, and nothing tried by libraries on top.

s3fs tries five times what botocore tries five times; neither ends a request whose body nobody takes, nor one that is
answered a byte at a time. Here a request has a time, from its start to the last byte of its answer, and one count of tries.
"""

from __future__ import annotations

import asyncio
import errno
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, cast

from gsplat_tools.errors import CapabilityError, GsplatError, MissingDependencyError, ReadError

DEFAULT_STORE_TIMEOUT = 30.0
"""Seconds that a store may take to answer a request."""

TRIES = 4
"""Times that a request is made before it is given up."""

SLOWEST = 256 << 10
"""Bytes a second: a request may take a second more for as many bytes that it moves."""

_PATIENCE = 10
"""Times the time of a request, for those that stores take long for: joining parts, listing, removing."""

_FIRST_PAUSE = 0.3
"""Seconds before the second try; three times as many before the next."""

_ABORT_SECONDS = 5.0
"""Most seconds to spend on dropping the parts of an upload that has failed."""

_CONNECT_SECONDS = 60.0
"""Seconds to load what botocore knows of S3, and to find credentials, besides what a request takes."""

_VARIABLE = "GSPLAT_STORE_TIMEOUT"
_EXTRAS = {"s3": "s3fs (pip install 'gsplat_tools[s3]')", "gs": "gcsfs (pip install 'gsplat_tools[gs]')"}
_FINAL = (FileNotFoundError, FileExistsError, PermissionError, IsADirectoryError, NotADirectoryError)
_FINAL_NUMBERS = (errno.EINVAL, errno.EPERM, errno.ENOSYS, errno.EMSGSIZE, errno.ENAMETOOLONG)
_PASSING_KINDS = {
    ("botocore", "HTTPClientError"), ("botocore", "ConnectionError"), ("botocore", "ResponseParserError"),
    ("aiohttp", "ClientError"), ("urllib3", "HTTPError"), ("gcsfs", "ChecksumError"),
}  # fmt: skip
"""(package, class) of errors of connections, which are no OSError; the packages need not be installed."""

_timeout: float | None = None
# Not a context variable: frames of a sequence are read in threads, which do not inherit those.


@contextmanager
def use_store_timeout(seconds: float | None) -> Iterator[None]:
    """Let stores take `seconds` to answer a request inside the block, in all threads.

    Parameters
    ----------
    seconds
        None goes back to the environment variable GSPLAT_STORE_TIMEOUT, or DEFAULT_STORE_TIMEOUT.
    """
    if seconds is not None and not 0 < seconds < math.inf:
        raise ValueError(f"seconds must be positive and finite, got {seconds}")
    global _timeout  # noqa: PLW0603
    before, _timeout = _timeout, seconds
    try:
        yield
    finally:
        _timeout = before


def store_timeout() -> float:
    """Return the seconds that a store may take to answer a request.

    Raises
    ------
    CapabilityError
        The environment variable is no number of seconds.
    """
    if _timeout is not None:
        return _timeout
    said = os.environ.get(_VARIABLE, "")
    try:
        seconds = float(said) if said else DEFAULT_STORE_TIMEOUT
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < math.inf:
        raise CapabilityError(f"{_VARIABLE} is {said!r}; expected a number of seconds above 0")
    return seconds


def file_system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it.

    Raises
    ------
    MissingDependencyError
        fsspec, or what it needs for this store, is not installed.
    ReadError
        No store goes by this name.
    """
    scheme = url.partition(":")[0]
    try:
        import fsspec
    except ImportError as error:
        raise MissingDependencyError(
            f"{scheme}:// needs fsspec; install it with pip install 'gsplat_tools[cluster]'"
        ) from error
    seconds = store_timeout()
    try:
        if scheme in ("s3", "s3a"):
            retries = {"total_max_attempts": 1, "mode": "standard"}
            config = {"connect_timeout": min(seconds, 10.0), "read_timeout": seconds, "retries": retries}
            kind, options = _s3(), {"config_kwargs": config}
        elif scheme in ("gs", "gcs"):
            kind, options = _gs(), {"requests_timeout": _gs_timeout(seconds)}
        else:
            return cast("tuple[Any, str]", fsspec.core.url_to_fs(url))
        system, path = kind(**options, **kind._get_kwargs_from_urls(url)), kind._strip_protocol(url)
    except ImportError as error:
        raise MissingDependencyError(f"{scheme}:// needs {_EXTRAS.get(scheme, 'its fsspec package')}: {error}") from error
    except ValueError as error:
        raise ReadError(f"no store is known for {scheme}://; {error}", path=url) from error
    if hasattr(system, "call_s3"):
        # Or loading what botocore knows of S3 would count as a store that is slow.
        system.connect(timeout=_CONNECT_SECONDS + seconds)
    return system, path


@cache
def _s3() -> Any:
    """Return S3 whose open files keep to the time and the tries of this module."""
    import s3fs

    class S3(s3fs.S3FileSystem):  # type: ignore[misc] # s3fs has no types
        retries = 1

        def call_s3(self, method: str, *arguments: Any, **named: Any) -> Any:
            """Make a request of an open file, which is what s3fs sends parts by."""
            if method == "abort_multipart_upload":  # of older versions, which have no `abort_mpu`
                return super().call_s3(method, *arguments, timeout=min(_ABORT_SECONDS, store_timeout()), **named)
            patience = _PATIENCE if method == "complete_multipart_upload" else 1
            size = len(named.get("Body") or b"")
            return _tried(super().call_s3, method, *arguments, seconds=_allowed(size, patience), **named)

        def abort_mpu(self, *arguments: Any, **named: Any) -> Any:
            """Drop the parts of an upload, in one try: this is what a run does that has failed or is interrupted."""
            return super().abort_mpu(*arguments, timeout=min(_ABORT_SECONDS, store_timeout()), **named)

    return S3


@cache
def _gs() -> Any:
    """Return Google Cloud Storage whose open files keep to the time and the tries of this module."""
    import gcsfs

    class Gs(gcsfs.GCSFileSystem):  # type: ignore[misc] # gcsfs has no types
        # Without the decorator that tries six times, for half a minute.
        _request = getattr(gcsfs.GCSFileSystem._request, "__wrapped__", gcsfs.GCSFileSystem._request)

        def call(self, method: str, *arguments: Any, **named: Any) -> Any:
            """Make a request of an open file, which is what gcsfs sends parts by."""
            if method == "DELETE":
                return super().call(method, *arguments, timeout=min(_ABORT_SECONDS, store_timeout()), **named)
            size = len(named.get("data") or b"")
            return _tried(super().call, method, *arguments, seconds=_allowed(size), **named)

    return Gs


def _gs_timeout(seconds: float) -> Any:
    import aiohttp

    return aiohttp.ClientTimeout(sock_connect=min(seconds, 10.0), sock_read=seconds)


def ask(
    system: Any, method: str, *arguments: Any, size: int = 0, is_slow: bool = False, tries: int | None = None, **named: Any
) -> Any:
    """Call a method of a file system, which ends after the tries and the time of this module.

    Parameters
    ----------
    system, method, arguments, named
        What to call.
    size
        Bytes that it moves.
    is_slow
        Whether stores take long for it.
    tries
        Times that it is made before it is given up; TRIES by default.
    """
    function = getattr(system, method)
    if not getattr(system, "async_impl", False):
        return function(*arguments, **named)
    return _tried(function, *arguments, seconds=_allowed(size, _PATIENCE if is_slow else 1), tries=tries, **named)


def fetch(system: Any, path: str, start: int, end: int, info: dict[str, Any]) -> bytes:
    """Return bytes of an object; of S3 only while it is the one that `info` is about."""
    from fsspec.asyn import sync

    def once(*, timeout: float) -> bytes:
        if hasattr(system, "call_s3"):
            data = sync(system.loop, _fetch_s3, system, path, start, end, info, timeout=timeout)
        else:
            data = ask(system, "cat_file", path, start=start, end=end, size=end - start, tries=1)
        if len(data) != end - start:
            raise ConnectionError(f"{len(data)} of {end - start} bytes came")
        return cast("bytes", data)

    return cast("bytes", _tried(once, seconds=_allowed(end - start)))


async def _fetch_s3(system: Any, path: str, start: int, end: int, info: dict[str, Any]) -> bytes:
    bucket, key, version = system.split_path(path)
    same = {"IfMatch": info["ETag"]} if info.get("ETag") else {}
    if version is not None:
        same["VersionId"] = version
    try:
        answer = await system._call_s3("get_object", Bucket=bucket, Key=key, Range=f"bytes={start}-{end - 1}", **same)
    except OSError as error:
        if error.errno == errno.EINVAL and "condition" in str(error):
            raise ReadError("the object was replaced while it was read; convert again", path=f"s3://{path}") from error
        raise
    try:
        return cast("bytes", await answer["Body"].read())
    finally:
        answer["Body"].close()


def _allowed(size: int, patience: int = 1) -> float:
    """Return the seconds of one try."""
    return store_timeout() * patience + size / SLOWEST


def _tried(function: Callable[..., Any], *arguments: Any, seconds: float, tries: int | None = None, **named: Any) -> Any:
    """Call what takes a timeout, again after errors that may pass."""
    tries = tries or TRIES
    for attempt in range(tries):
        try:
            return function(*arguments, timeout=seconds, **named)
        except Exception as error:
            if attempt + 1 == tries or not may_pass(error):
                raise
        time.sleep(_FIRST_PAUSE * 3**attempt)
    raise AssertionError("the last try returns or raises")


def may_pass(error: Exception) -> bool:
    """Whether the same request may succeed when it is made again: no answer, a busy store, a connection that broke."""
    if isinstance(error, (GsplatError, *_FINAL)):
        return False
    if isinstance(error, OSError):
        return error.errno not in _FINAL_NUMBERS
    code = str(getattr(error, "code", ""))  # of gcsfs, which asks for a new token after 401
    if code in ("401", "408", "429") or (len(code) == 3 and code.startswith("5")):
        return True
    return isinstance(error, asyncio.TimeoutError) or any(
        (kind.__module__.partition(".")[0], kind.__name__) in _PASSING_KINDS for kind in type(error).__mro__
    )


def in_words(error: Exception) -> str:
    """Return what a store or its library said, and what can be done."""
    said = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, TimeoutError | asyncio.TimeoutError) or "imeout" in type(error).__name__:
        return (
            f"no whole answer within {store_timeout():g} s ({TRIES} tries); try again, or give it more time with "
            f"--store-timeout or {_VARIABLE}"
        )
    return f"{said}; try again, or check its address and credentials"
