"""A server on loopback that has the page, the files that were named, and nothing else."""

from __future__ import annotations

import errno
import json
import shutil
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from gsplat_tools.errors import GsplatError
from gsplat_tools.formats._json import finite
from gsplat_tools.validation import validate
from gsplat_tools.viewing.page import served_page
from gsplat_tools.viewing.payload import Exhibit

HOST = "127.0.0.1"

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self' data: blob:; worker-src blob: data:; frame-ancestors 'none'; base-uri 'none'"
)
"""The page runs what is in it and asks only this server; nothing may show it in a frame."""


class ViewServer(ThreadingHTTPServer):
    """Serves an exhibit on a loopback port.

    Parameters
    ----------
    exhibit
        Files to show.
    port
        Port to listen on; 0 lets the system choose.

    Raises
    ------
    OSError
        The port is in use, or not ours to use.
    """

    daemon_threads = True

    def __init__(self, exhibit: Exhibit, port: int = 0) -> None:
        self.exhibit = exhibit
        self.page = served_page(exhibit).encode("utf-8")
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            reason = (
                "in use; name another" if error.errno == errno.EADDRINUSE else f"not to be had ({error.strerror}); name another"
            )
            raise OSError(error.errno, f"port {port} of {HOST} is {reason} with --port, or leave it out") from error

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of connections that the browser cut."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_address[1]}/"


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer with the page, a file, or what validating it finds."""
        # A page of another host that resolves to loopback must not read the files.
        port = self.server.server_address[1]
        if self.headers.get("Host") not in {f"{HOST}:{port}", f"localhost:{port}"}:
            self._refuse(HTTPStatus.FORBIDDEN)
            return
        payloads = self.server.exhibit.payloads
        path = self.path.partition("?")[0]
        known = {f"/file/{i}": payload.path for i, payload in enumerate(payloads)}
        reports = {f"/report/{i}": payload.source for i, payload in enumerate(payloads)}
        if path == "/":
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif path in known:
            with known[path].open("rb") as stream:
                self._start(known[path].stat().st_size, "application/octet-stream")
                if self.command == "GET":
                    shutil.copyfileobj(stream, self.wfile)
        elif path in reports:
            try:
                report: dict[str, Any] = validate(reports[path])
            except GsplatError as error:
                report = {"issues": [{"severity": "error", "code": "unreadable", "message": str(error)}]}
            self._answer(json.dumps(finite(report)).encode("utf-8"), "application/json")
        else:
            self._refuse(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET  # noqa: N815 - the name that http.server calls

    def _start(self, size: int, content_type: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Send the head of an answer."""
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(size))
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _answer(self, body: bytes, content_type: str) -> None:
        """Send a whole answer."""
        self._start(len(body), content_type)
        if self.command == "GET":
            self.wfile.write(body)

    def _refuse(self, status: HTTPStatus) -> None:
        """Send a status without a body."""
        self.close_connection = True
        self._start(0, "text/plain", status)

    def log_message(self, *_: Any) -> None:
        """Say nothing: requests are not news."""
