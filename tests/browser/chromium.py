"""A headless Chromium that runs the functions of jobs.mjs, one at a time.

The page asks a small loopback server for work and posts back what it did; nothing but the standard library is needed here.
WebGL runs in software (SwiftShader), so that the pixels do not depend on the machine's graphics card.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
WEB = HERE.parents[1] / "web"
NODE_MODULES = HERE / "node_modules"
PACKAGES = ("@sparkjsdev/spark", "three", "fzstd")
CONTENT_TYPES = {".html": "text/html", ".mjs": "text/javascript", ".js": "text/javascript", ".json": "application/json"}

FLAGS = (
    "--headless",
    "--no-sandbox",  # test containers run as root, where the sandbox refuses to start
    "--no-first-run",
    "--no-proxy-server",
    "--disable-quic",
    "--disable-sync",
    "--disable-extensions",
    "--disable-component-update",
    "--disable-background-networking",
    "--disable-background-timer-throttling",
    "--disable-renderer-backgrounding",
    "--disable-dev-shm-usage",  # containers often give /dev/shm 64 MiB
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


class BrowserError(RuntimeError):
    """The page, a job in it or Chromium itself failed; `error` is the JavaScript error's name, message, field and offset."""

    def __init__(self, message: str, *, error: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.error = dict(error or {})


def executable() -> str | None:
    """Path of Chromium: what GSPLAT_TOOLS_CHROMIUM says, or Debian's, or none."""
    named = os.environ.get("GSPLAT_TOOLS_CHROMIUM")
    return shutil.which(named) if named else shutil.which("chromium")


def missing() -> str | None:
    """Say what is not installed, or None where everything is."""
    if executable() is None:
        return "Chromium is not installed; run scripts/peers"
    absent = [name for name in PACKAGES if not (NODE_MODULES / name / "package.json").is_file()]
    return f"npm packages are not installed: {', '.join(absent)}; run scripts/peers" if absent else None


class Chromium:
    """One browser with one page; `call` runs a function of jobs.mjs in it.

    Parameters
    ----------
    timeout
        Seconds that the page may take to load, and each job to finish.
    """

    def __init__(self, *, timeout: float = 60.0) -> None:
        path = executable()
        if path is None:
            raise BrowserError("Chromium is not installed")
        self.timeout = timeout
        self._jobs: queue.Queue[dict[str, Any]] = queue.Queue()
        self._results: queue.Queue[tuple[str, bytes]] = queue.Queue()
        self._blobs: dict[str, bytes] = {}
        self._last_id = 0
        self._closing = threading.Event()
        self._server = _Server(self)
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        self._thread.start()
        self._folder = Path(tempfile.mkdtemp(prefix="gsplat-tools-chromium-"))
        self._log = self._folder / "log"
        page = f"http://127.0.0.1:{self._server.server_address[1]}/page.html"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [path, *FLAGS, f"--user-data-dir={self._folder / 'profile'}", page],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Its own process group, so that closing ends the helper processes as well and nothing else.
                start_new_session=True,
            )

    def call(self, name: str, settings: Mapping[str, Any] | None = None, **blobs: bytes) -> tuple[dict[str, Any], bytes]:
        """Run `name` of jobs.mjs in the page and return its report and its bytes.

        Raises
        ------
        BrowserError
            It threw, Chromium ended, or there was no answer in time.
        """
        self._last_id += 1
        job = str(self._last_id)
        self._blobs = {f"/blob/{job}/{key}": blob for key, blob in blobs.items()}
        self._jobs.put({"id": job, "name": name, "settings": dict(settings or {}), "blobs": list(blobs)})
        path, body = self._wait_for_result(name, job)
        line, _, rest = body.partition(b"\n")
        answer = json.loads(line)
        if "error" in answer:
            error = answer["error"]
            where = f"{name} failed in the browser" if path != "/broken" else "the page did not load"
            raise BrowserError(f"{where}: {error['name']}: {error['message']}\n{error['stack']}", error=error)
        return answer["report"], rest

    def close(self) -> None:
        """End Chromium and the server, and remove the profile."""
        self._closing.set()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        # A helper process may still write into the profile for a moment.
        for _ in range(50):
            shutil.rmtree(self._folder, ignore_errors=True)
            if not self._folder.exists():
                break
            time.sleep(0.1)

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for_result(self, name: str, job: str) -> tuple[str, bytes]:
        """Return the posted answer to `job`."""
        end = time.monotonic() + self.timeout
        while time.monotonic() < end:
            try:
                path, body = self._results.get(timeout=0.25)
            except queue.Empty:
                if self._process.poll() is not None:
                    raise BrowserError(f"Chromium ended with status {self._process.returncode}: {self._last_words()}") from None
                continue
            if path in {"/broken", f"/result/{job}"}:
                return path, body
        raise BrowserError(f"{name} gave no answer in {self.timeout:g} s; Chromium said: {self._last_words()}")

    def _last_words(self) -> str:
        """Return the end of what Chromium wrote."""
        return self._log.read_bytes()[-2000:].decode(errors="replace").strip() or "(nothing)"


class _Server(ThreadingHTTPServer):
    """Files, jobs and results on a loopback port of the system's choice."""

    daemon_threads = True

    def __init__(self, browser: Chromium) -> None:
        self.browser = browser
        super().__init__(("127.0.0.1", 0), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that a closing browser cuts."""


class _Handler(BaseHTTPRequestHandler):
    """What the page asks for."""

    server: _Server
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = -1  # head and body in one packet

    def do_GET(self) -> None:
        browser = self.server.browser
        if self.path == "/job":
            self._send_job()
        elif self.path.startswith("/blob/"):
            self._send(browser._blobs.get(self.path), "application/octet-stream")
        else:
            self._send_file()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.browser._results.put((self.path, body))
        self._send(b"", "text/plain")

    def log_message(self, format: str, *args: object) -> None:
        """Keep pytest's output free of requests."""

    def _send_job(self) -> None:
        """Answer with a job, or with nothing after a few seconds, or say that it is over."""
        browser = self.server.browser
        end = time.monotonic() + 5
        while time.monotonic() < end and not browser._closing.is_set():
            with contextlib.suppress(queue.Empty):
                self._send(json.dumps(browser._jobs.get(timeout=0.1)).encode(), "application/json")
                return
        self._send(b"", "text/plain", HTTPStatus.GONE if browser._closing.is_set() else HTTPStatus.NO_CONTENT)

    def _send_file(self) -> None:
        """Answer with a file of tests/browser or web; nothing else of the machine is served."""
        root, name = (WEB, self.path.removeprefix("/web/")) if self.path.startswith("/web/") else (HERE, self.path[1:])
        path = (root / name).resolve()
        is_served = path.is_relative_to(root.resolve()) and path.suffix in CONTENT_TYPES and path.is_file()
        self._send(path.read_bytes() if is_served else None, CONTENT_TYPES.get(path.suffix, "text/plain"))

    def _send(self, body: bytes | None, content_type: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Answer with `body`, or with 404 where there is none."""
        self.send_response(HTTPStatus.NOT_FOUND if body is None else status)
        self.send_header("Content-Type", content_type)
        self.send_header("Cache-Control", "no-store")
        if status is not HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(body or b"")))
        self.end_headers()
        if body and status is not HTTPStatus.NO_CONTENT:
            self.wfile.write(body)
