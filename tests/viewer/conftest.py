"""Chromium driven by Playwright, and pages that a server of the test's own has."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from gsplat_tools.viewing.payload import prepare_exhibit
from gsplat_tools.viewing.server import ViewServer
from tests.browser import chromium
from tests.browser.conftest import stop_where_missing

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PATIENCE = 60.0


@pytest.fixture(scope="session")
def playwright_browser() -> Iterator[Browser]:
    stop_where_missing(None if chromium.executable() else "Chromium is not installed; run scripts/peers")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium.executable(), args=[flag for flag in chromium.FLAGS if flag != "--headless"]
        )
        yield browser
        browser.close()


class View:
    """A page, and everything that it said and asked for."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.requests: list[str] = []
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", self._listen)
        page.on("request", self._note)

    def _listen(self, message: Any) -> None:
        # What the driver says about reading pixels is not of the page's doing.
        if message.type in {"error", "warning"} and "GL Driver Message" not in message.text:
            self.complaints.append(message.text)

    def _note(self, request: Any) -> None:
        if not request.url.startswith(("data:", "blob:")):
            self.requests.append(request.url)

    def open(self, address: str) -> None:
        self.page.goto(address)
        self.wait_until("window.viewer && window.viewer.ready")
        # Nobody looks: drawing in software would only take time from what is tested.
        self.page.evaluate("viewer.paused = true")

    def wait_until(self, condition: str) -> None:
        """Ask until an expression holds; Playwright's own waiting would evaluate strings, which the page's policy forbids."""
        end = time.monotonic() + PATIENCE
        while not self.page.evaluate(condition):
            assert time.monotonic() < end, f"{condition} does not come true; the page says: {self.message or self.complaints}"
            time.sleep(0.05)

    @property
    def message(self) -> str:
        """What the page tells the user, or nothing."""
        return self.page.inner_text("#words") if self.page.is_visible("#message") else ""


@pytest.fixture
def new_view(playwright_browser: Browser) -> Iterator[Callable[..., View]]:
    contexts = []

    def make(width: int = 480, height: int = 320) -> View:
        context = playwright_browser.new_context(viewport={"width": width, "height": height})
        contexts.append(context)
        return View(context.new_page())

    yield make
    for context in contexts:
        context.close()


@contextmanager
def serving(*files: Path) -> Iterator[ViewServer]:
    """A server of files on a free port."""
    with ExitStack() as keep, ViewServer(prepare_exhibit(list(files), keep)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
