"""An S3 server on loopback, and a proxy before it that fails or hangs on demand."""

from __future__ import annotations

import http.client
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from gsplat_tools.formats import _store_requests

BUCKET = "bucket"

Fault = Callable[[str, str, int], str | None]
"""Method, path and number of the request, from 0, to None or what goes wrong:

503         the store is busy
cut         the connection ends without an answer
hang        the request is taken and never answered
deaf        not even the body of the request is taken
stall       the answer ends in the middle of its body, and the connection stays open
drip        the body of the answer comes a byte at a time, `DRIP` seconds apart
late        the request is carried out, and never answered
"""

DRIP = 0.2
LONGEST = 120.0
"""Seconds that a request hangs if nobody gives it up."""


class Proxy:
    """Passes requests on to a server, unless `fault` says otherwise."""

    def __init__(self, port: int) -> None:
        self.fault: Fault | None = None
        self.count = 0
        self.failed = 0
        self.log: list[tuple[str, str]] = []
        self.ranges: list[str] = []
        self.released = threading.Event()
        lock = threading.Lock()
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *_: object) -> None:
                pass

            def _pass(self) -> None:
                with lock:
                    number, proxy.count = proxy.count, proxy.count + 1
                    proxy.log.append((self.command, self.path))
                    fault = proxy.fault(self.command, self.path, number) if proxy.fault else None
                    proxy.failed += fault is not None
                    proxy.ranges.append(self.headers.get("Range") or "")
                size = int(self.headers.get("Content-Length") or 0)
                if fault in ("cut", "deaf"):
                    if fault == "deaf":
                        proxy.hang(self.connection)
                    self.close_connection = True
                    with suppress(OSError):
                        self.connection.shutdown(socket.SHUT_RDWR)
                    return
                body = self._body(size)
                if fault == "hang":
                    proxy.hang(self.connection)
                    self.close_connection = True
                    return
                if fault == "503":
                    text = b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"
                    self.send_response(503)
                    self.send_header("Content-Length", str(len(text)))
                    self.end_headers()
                    if self.command != "HEAD":
                        self.wfile.write(text)
                    return
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
                headers = {name: value for name, value in self.headers.items() if name.lower() != "transfer-encoding"}
                if self.headers.get("Transfer-Encoding"):
                    headers["Content-Length"] = str(len(body))
                connection.request(self.command, self.path, body, headers)
                answer = connection.getresponse()
                data = answer.read()
                if fault == "late":
                    proxy.hang(self.connection)
                    self.close_connection = True
                    return
                self.send_response(answer.status)
                for name, value in answer.getheaders():
                    if name.lower() not in ("transfer-encoding", "connection", "content-length", "server", "date"):
                        self.send_header(name, value)
                length = answer.getheader("Content-Length") if self.command == "HEAD" else str(len(data))
                self.send_header("Content-Length", length or "0")
                self.end_headers()
                connection.close()
                if fault in ("stall", "drip"):
                    self.close_connection = True
                    self.wfile.write(data[: len(data) // 2])
                    self.wfile.flush()
                    if fault == "stall":
                        proxy.hang(self.connection)
                    for byte in data[len(data) // 2 :] if fault == "drip" else b"":
                        proxy.released.wait(DRIP)
                        self.wfile.write(bytes([byte]))
                elif self.command != "HEAD":
                    self.wfile.write(data)

            def _body(self, size: int) -> bytes:
                if (self.headers.get("Transfer-Encoding") or "").lower() != "chunked":
                    return self.rfile.read(size)
                parts = []
                while length := int(self.rfile.readline().split(b";")[0], 16):
                    parts.append(self.rfile.read(length))
                    self.rfile.readline()
                while self.rfile.readline().strip():
                    pass
                return b"".join(parts)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, *_: object) -> None:
                pass

        self._server = Server(("127.0.0.1", 0), Handler)
        self.direct = f"http://127.0.0.1:{port}"
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def hang(self, connection: socket.socket) -> None:
        """Wait until the other side gives up, or the proxy ends."""
        end = time.monotonic() + LONGEST
        while time.monotonic() < end and not self.released.wait(0.05):
            try:
                if not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
                    return
            except BlockingIOError:
                continue
            except OSError:
                return

    def reset(self, fault: Fault | None = None) -> None:
        """Forget what happened, and fail like this from now on."""
        self.fault, self.count, self.failed = fault, 0, 0
        self.log, self.ranges = [], []

    def close(self) -> None:
        self.released.set()
        self._server.shutdown()
        self._server.server_close()


@contextmanager
def s3_server() -> Iterator[Proxy]:
    """An empty bucket, for this process and its children; yields the proxy that stands before it."""
    import fsspec
    import requests
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=port, verbose=False)
    server.start()
    proxy = Proxy(port)
    own = {
        "AWS_ENDPOINT_URL": proxy.url,
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "NO_PROXY": "127.0.0.1",
        "no_proxy": "127.0.0.1",
    }
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    try:
        forget()
        requests.post(f"{proxy.direct}/moto-api/reset", timeout=10)  # servers of one process share what they hold
        fsspec.filesystem("s3").mkdir(BUCKET)
        yield proxy
    finally:
        forget()
        proxy.close()
        server.stop()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def forget() -> None:
    """Let go of connections to an earlier server."""
    import fsspec

    for kind in (fsspec.get_filesystem_class("s3"), _store_requests._s3()):
        kind.clear_instance_cache()
    fsspec.config.conf.clear()
