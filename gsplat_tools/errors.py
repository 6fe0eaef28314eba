"""Everything this package raises or warns with.

::

    GsplatError
    ├── FormatError (ValueError)          the bytes are at fault; path, offset, field, frame
    │   ├── UnknownFormatError            no registered format claims them
    │   ├── UnsupportedVersionError       recognized, but a version we do not read or write
    │   ├── TruncatedDataError            fewer bytes than the header promises
    │   ├── CorruptDataError              bytes contradict themselves, or do not decompress
    │   └── LimitExceededError            the header claims more than a safety limit allows
    ├── CapabilityError (ValueError)      the target cannot hold this cloud, or has no reader or writer
    ├── CloudError (ValueError)           arrays break a GaussianCloud invariant
    ├── TargetExistsError (FileExistsError)  the target is there and may not be overwritten
    ├── ReadError (OSError)             the operating system could not read a source
    ├── WriteError (OSError)            it could not write a target, or the bytes did not come back as they were written
    ├── ValidationError (ValueError)      what was written does not hold its bounds, or --min-psnr
    ├── ClusterError (RuntimeError)       workers or the connection to them were lost; what is finished is kept
    └── MissingDependencyError (ImportError)  optional package absent; says what to install
    GsplatWarning (UserWarning)
    ├── LossyConversionWarning            what was dropped or clamped, and how many
    └── NonFiniteWarning                  which array, how many values

Messages say what was expected, what was found, and what to do; where it was is held by attributes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

_MAX_MESSAGE, _MAX_FIELD = 1000, 200
"""Characters of a message and of a field that are kept: both may hold names from a hostile file."""


class GsplatError(Exception):
    """Base of every error that this package raises about data.

    Parameters
    ----------
    message
        What was expected, what was found, what to do.
    path
        File at fault. `load` and `save` add it when a stream reader could not know it.
    offset
        Byte offset in the file.
    field
        Name of the field, property, stream or entry at fault, in the spelling of the format's specification.
    frame
        Index of the frame at fault, in sequences.
    """

    def __init__(
        self,
        message: str,
        *,
        path: str | Path | None = None,
        offset: int | None = None,
        field: str | None = None,
        frame: int | None = None,
    ) -> None:
        message = quoted(message, _MAX_MESSAGE)
        super().__init__(message)
        self.message = message
        self.path = None if path is None else Path(path)
        self.offset = offset
        self.field = None if field is None else quoted(field, _MAX_FIELD)
        self.frame = frame

    def __str__(self) -> str:
        place = [
            *([_shown(self.path)] if self.path is not None else []),
            *([self.field] if self.field is not None else []),
            *([f"frame {self.frame}"] if self.frame is not None else []),
            *([f"byte {self.offset}"] if self.offset is not None else []),
        ]
        return f"{', '.join(place)}: {self.message}" if place else self.message


def _shown(path: Path) -> str:
    """Return a path as text; URLs get the slash back that paths lose."""
    return re.sub(r"^([a-z][a-z0-9+.-]+):/(?=[^/])", r"\1://", str(path))


class FormatError(GsplatError, ValueError):
    """The bytes are at fault."""


class UnknownFormatError(FormatError):
    """No registered format claims these bytes or this extension."""


class UnsupportedVersionError(FormatError):
    """The format is recognized, but this version of it is not read or written."""


class TruncatedDataError(FormatError):
    """There are fewer bytes than the header promises."""


class CorruptDataError(FormatError):
    """The bytes contradict themselves, or do not decompress."""


class LimitExceededError(FormatError):
    """The header claims more than a safety limit allows."""


class CapabilityError(GsplatError, ValueError):
    """The target cannot hold this scene, or has no reader or writer."""


class CloudError(GsplatError, ValueError):
    """The arrays break an invariant of GaussianCloud."""


TARGET_EXISTS = "the target exists; use --overwrite (library: overwrite=True) to replace it"
"""What `TargetExistsError` says wherever a target is refused before anything is written."""


class TargetExistsError(GsplatError, FileExistsError):
    """The target is there and overwriting was not asked for."""

    # OSError's own __str__ would format errno and filename.
    __str__ = GsplatError.__str__


class ReadError(GsplatError, OSError):
    """The operating system could not read a source."""

    __str__ = GsplatError.__str__


class WriteError(GsplatError, OSError):
    """The operating system could not write a target, or did not keep what was written."""

    __str__ = GsplatError.__str__


class ValidationError(GsplatError, ValueError):
    """What was written does not hold its derived bounds, or renders below the quality asked for."""


class ClusterError(GsplatError, RuntimeError):
    """Workers, or the connection to their scheduler, were lost, or they are unlike each other."""


class MissingDependencyError(GsplatError, ImportError):  # type: ignore[misc] # both have a `path`
    """An optional package is absent."""

    __str__ = GsplatError.__str__


class GsplatWarning(UserWarning):
    """Base of every warning; `code` names its kind in JSON reports."""

    code = "warning"

    def __init__(self, message: str, *, code: str | None = None) -> None:
        super().__init__(quoted(message, _MAX_MESSAGE))
        if code is not None:
            self.code = code


class LossyConversionWarning(GsplatWarning):
    """Something was dropped or clamped because the target cannot hold it."""

    code = "lossy"


class NonFiniteWarning(GsplatWarning):
    """Values that are not finite were found; the splats that hold them were dropped."""

    code = "non-finite"


def quoted(text: str, limit: int | None = None) -> str:
    """Return a text that may hold names from a file so that a terminal can show it: no control characters, no end of it.

    Parameters
    ----------
    text
        To show; line breaks stay.
    limit
        Most characters; what is in the middle of more is left out.
    """
    if limit is not None and len(text) > limit:
        text = f"{text[: limit // 2]} ... {text[-limit // 4 :]}"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode("ascii") for c in text)


def counts_in_words(counts: Mapping[str, int]) -> str:
    """Return causes and how often each was found, as one phrase."""
    return ", ".join(f"{cause} {count}" for cause, count in counts.items())
