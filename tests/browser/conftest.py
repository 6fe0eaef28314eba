"""One browser for all tests of the session, or a reason why there is none."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.browser import chromium

REQUIRED = "GSPLAT_TOOLS_REQUIRE_BROWSER"


@pytest.fixture(scope="session")
def browser() -> Iterator[chromium.Chromium]:
    """Headless Chromium with the page of this folder."""
    stop_where_missing(chromium.missing())
    with chromium.Chromium() as running:
        yield running


def stop_where_missing(reason: str | None) -> None:
    """Skip the test where something is not installed; fail it where the environment says that it must be."""
    if reason is None:
        return
    if os.environ.get(REQUIRED) == "1":
        pytest.fail(f"{REQUIRED}=1, but {reason}")
    pytest.skip(reason)
