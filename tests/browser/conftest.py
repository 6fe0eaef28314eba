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
    reason = chromium.missing()
    if reason is not None:
        if os.environ.get(REQUIRED) == "1":
            pytest.fail(f"{REQUIRED}=1, but {reason}")
        pytest.skip(reason)
    with chromium.Chromium() as running:
        yield running
