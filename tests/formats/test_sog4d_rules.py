"""Every rule of the bundle has a code, and a minimal bundle that breaks it and no other."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path

import pytest

from gsplat_tools.errors import FormatError, GsplatWarning
from gsplat_tools.formats.sog4d import RULES, Sog4dReadOptions, read
from gsplat_tools.formats.sog4d.validate import check
from tests.sog4d_bundles import BROKEN, FRAMES, valid_bundle

# A bundle of millions of entries is no fixture.
UNTESTED = {"zip-too-many-entries"}


def read_everything(data: bytes) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        sequence = read(io.BytesIO(data), Sog4dReadOptions())
    for frame in range(len(sequence)):
        sequence.frame(frame)


def test_valid_bundle__has_no_issue() -> None:
    assert list(check(io.BytesIO(valid_bundle()))) == []
    read_everything(valid_bundle())


def test_rules__have_a_bundle_each() -> None:
    assert set(BROKEN) | UNTESTED == set(RULES)


@pytest.mark.parametrize("code", BROKEN)
def test_rule__is_broken_by_its_bundle_alone(code: str) -> None:
    found = {issue.code for issue in check(io.BytesIO(BROKEN[code]()))}

    assert found == {code}


@pytest.mark.parametrize("code", [code for code in BROKEN if RULES[code].severity == "error"])
def test_reader__refuses_what_breaks_a_rule_and_names_it(code: str) -> None:
    with pytest.raises(FormatError) as caught:
        read_everything(BROKEN[code]())

    assert caught.value.code == code  # type: ignore[attr-defined]
    assert type(caught.value) is RULES[code].error


@pytest.mark.parametrize("code", [code for code in BROKEN if RULES[code].severity != "error"])
def test_reader__reads_what_is_less_than_an_error(code: str) -> None:
    read_everything(BROKEN[code]())


@pytest.mark.parametrize(
    ("code", "field", "frame", "splat"),
    [
        ("missing-field", "meta.json streams.rotation", None, None),
        ("range-value", "meta.json streams.position.rangeMin[1].x", 1, None),
        ("time-value", "meta.json timeMapping.frameTimesNormalized", 2, None),
        ("segments", "meta.json streams.sh.shNDeltaSegments[1]", 2, None),
        ("file-missing", "frames/00001/sh0.webp", 1, None),
        ("image-size", "frames/00001/sh0.webp", 1, None),
        ("index-range", "frames/00002/scale.webp", 2, 3),
        ("label-range", "sh/base2.webp", 2, 1),
        ("delta-splat", "sh/delta0.bin", 1, 5),
        ("delta-order", "sh/delta0.bin", 1, 3),
    ],
)
def test_issue__says_where(code: str, field: str, frame: int | None, splat: int | None) -> None:
    (issue,) = check(io.BytesIO(BROKEN[code]()))

    assert (issue.field, issue.frame, issue.splat) == (field, frame, splat)


def test_issue__counts_all_and_names_the_first() -> None:
    (issue,) = check(io.BytesIO(BROKEN["index-range"]()))

    assert (issue.count, issue.splat, issue.value) == (2, 3, 3)


def test_error__gives_entry_frame_and_what_was_found() -> None:
    with pytest.raises(FormatError) as caught:
        read_everything(BROKEN["label-range"]())

    assert str(caught.value) == "sh/base2.webp, frame 2: expected a label below 3, found 3 at splat 1"


def test_page__lists_every_rule_with_its_severity() -> None:
    page = (Path(__file__).parents[2] / "docs" / "formats" / "sog4d.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z0-9-]+)` \| (error|warning|info|hint) \|", page, re.MULTILINE))

    assert rows == {code: rule.severity for code, rule in RULES.items()}


def test_prefixes__are_refused() -> None:
    data = valid_bundle()
    for length in range(0, len(data), 7):
        with pytest.raises(FormatError):
            read_everything(data[:length])


def test_frames__are_decoded_only_when_asked_for() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        sequence = read(io.BytesIO(BROKEN["index-range"]()), Sog4dReadOptions())

    assert len(sequence) == FRAMES
    sequence.frame(0)
    with pytest.raises(FormatError):
        sequence.frame(2)
