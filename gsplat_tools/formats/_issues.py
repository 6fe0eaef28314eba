"""What a check of a file finds: one record per finding, with a documented code, for readers and validators alike.

Checks yield issues and never raise; a reader raises the first error, a validator collects them all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from gsplat_tools.errors import CorruptDataError, FormatError

Severity = Literal["error", "warning", "info", "hint"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One obligation of a format.

    Parameters
    ----------
    severity
        "error" where a reader has to refuse the file.
    meaning
        What the obligation is, in one line, for the documents.
    error
        Class that a reader raises.
    """

    severity: Severity
    meaning: str
    error: type[FormatError] = CorruptDataError


@dataclass(frozen=True, slots=True, kw_only=True)
class Issue:
    """One finding.

    Parameters
    ----------
    code
        Key in the rules of the format.
    message
        What was expected, what was found, what to do.
    field
        Entry of the archive, or path of the field in its header.
    frame, splat
        Where in the scene.
    value
        What was found, where it is a number or a word.
    offset
        Byte offset in the entry.
    count
        How many splats, records or values break the rule there.
    """

    code: str
    message: str
    field: str | None = None
    frame: int | None = None
    splat: int | None = None
    value: Any = None
    offset: int | None = None
    count: int = 1


def refuse(issue: Issue, rules: dict[str, Rule]) -> FormatError:
    """Return the exception that stands for an issue; its `code` is that of the issue."""
    error = rules[issue.code].error(issue.message, field=issue.field, frame=issue.frame, offset=issue.offset)
    error.code = issue.code  # type: ignore[attr-defined]
    return error


@contextmanager
def naming_rules(codes: Mapping[str, str]) -> Iterator[None]:
    """Give refusals inside the block, or the decorated function, the code of the rule that their field is about.

    Parameters
    ----------
    codes
        Code by field, or by the first word of it; the empty string stands for refusals without a field. What is not named
        is known by the class of the error.
    """
    try:
        yield
    except FormatError as error:
        field = error.field or ""
        code = codes.get(field) or codes.get(field.split(" ")[0])
        if code is not None and not hasattr(error, "code"):
            error.code = code  # type: ignore[attr-defined]
        raise


def raise_errors(issues: Iterable[Issue], rules: dict[str, Rule]) -> list[Issue]:
    """Return what is less than an error.

    Raises
    ------
    FormatError
        The first error among the issues.
    """
    rest = []
    for issue in issues:
        if rules[issue.code].severity == "error":
            raise refuse(issue, rules)
        rest.append(issue)
    return rest
