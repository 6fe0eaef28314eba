"""The page with its configuration, and with the files themselves where it has to work offline."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from typing import Any

from gsplat_tools.errors import CapabilityError
from gsplat_tools.viewing.payload import Exhibit

_EMPTY = '<script type="application/json" id="config">{"files":[],"cameras":[]}</script>'
"""What `viewer/index.html` has where the configuration goes."""

_LARGEST_INSIDE = 384 << 20
"""Bytes; as base64 the largest text that Chromium holds, 512 MiB."""


def template() -> str:
    """Return the page as it was built, without files.

    Raises
    ------
    CapabilityError
        It was not built into this installation.
    """
    page = files("gsplat_tools.viewing").joinpath("page", "index.html")
    if not page.is_file():
        raise CapabilityError("the viewer's page is missing from this installation; build it with scripts/build_viewer")
    return page.read_text(encoding="utf-8")


def served_page(exhibit: Exhibit) -> str:
    """Return the page for a server that has the files at /file/N and what validating them finds at /report/N."""
    entries = [
        {**payload.to_json(), "url": f"file/{index}", "report": f"report/{index}"}
        for index, payload in enumerate(exhibit.payloads)
    ]
    return _with(exhibit, entries, "")


def offline_page(exhibit: Exhibit) -> str:
    """Return the page with every file inside.

    Raises
    ------
    CapabilityError
        A file cannot be shown, or is larger than a page can hold.
    """
    for payload in exhibit.payloads:
        if payload.error:
            raise CapabilityError(f"a file cannot be shown: {payload.error}")
        if payload.path.stat().st_size > _LARGEST_INSIDE:
            raise CapabilityError(
                f"a page holds files of up to {_LARGEST_INSIDE:,} bytes; leave out --html, or convert it first",
                path=payload.source,
            )
    entries = [{**payload.to_json(), "embedded": f"file-{i}"} for i, payload in enumerate(exhibit.payloads)]
    inside = "".join(
        f'<script type="application/octet-stream" id="file-{i}">{base64.b64encode(payload.path.read_bytes()).decode()}</script>'
        for i, payload in enumerate(exhibit.payloads)
    )
    return _with(exhibit, entries, inside)


def _with(exhibit: Exhibit, entries: list[dict[str, Any]], inside: str) -> str:
    """Return the page with a configuration, and with more elements behind it."""
    config = json.dumps({"files": entries, "cameras": [], **exhibit.view})
    # Inside a script element only "</" could end it.
    safe = config.replace("</", r"<\/")
    element = f'<script type="application/json" id="config">{safe}</script>'
    page = template()
    if _EMPTY not in page:
        raise CapabilityError("the viewer's page has no place for its configuration; build it anew with scripts/build_viewer")
    return page.replace(_EMPTY, element + inside)
