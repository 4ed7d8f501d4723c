"""A workbench that runs beside a test, and a plain client for it."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from typing import TYPE_CHECKING, cast
from urllib.parse import urlencode

from pipeline.web import Limits
from pipeline.web.server import WorkbenchServer, build_app

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from chrome import Chrome

    from pipeline.batch.batch_work import Report, Task

RUN = "field/hidden"
TRACK = 1.6
PATIENCE_S = 60.0
OPEN_FILES = 1024
SHOWN = "document.querySelector('.pane')?.dataset.drawn"
ERROR = "Number(document.querySelector('.number.r .value').textContent)"
TOKEN = "the-token-of-the-tests"  # noqa: S105 - of no server but these
LIMITS = Limits(log_bytes=200_000_000, all_bytes=400_000_000, timeout_s=600.0)


def look_for_trouble(chrome: Chrome) -> None:
    assert chrome.errors == []
    asked = [address for address in chrome.requests if "//" in address and not address.startswith("file:")]
    assert {address.split("/")[2].split(":")[0] for address in asked} == {"127.0.0.1"}


class Workbench:
    """A server on a free port of the loopback."""

    def __init__(
        self,
        results: Path,
        *,
        limits: Limits = LIMITS,
        work: Callable[[Task], Report] | None = None,
    ) -> None:
        app = build_app(results, token=TOKEN, limits=limits, diagnosis=False, work=work)
        listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(listener.getsockname()[1])
        self._server = WorkbenchServer(app, OPEN_FILES)
        self._thread = threading.Thread(target=self._server.run, args=([listener],), daemon=True)
        self._thread.start()
        end = time.monotonic() + PATIENCE_S
        while not self._server.started:
            assert time.monotonic() < end
            time.sleep(0.01)
        self.results = results

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def address(self) -> str:
        """As `slip serve` prints it."""
        return f"{self.origin}/?{urlencode({'token': TOKEN})}"

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(timeout=PATIENCE_S)

    def request(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        *,
        headers: Mapping[str, str] | None = None,
        known: bool = True,
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        own = {"Cookie": f"slip-{self.port}={TOKEN}"} if known else {}
        own |= {} if method == "GET" else {"Origin": self.origin}
        try:
            connection.request(method, path, body, headers={**own, **(headers or {})})
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            connection.close()

    def get(self, path: str) -> dict[str, object]:
        status, _, body = self.request("GET", path)
        assert status == 200, body
        return cast("dict[str, object]", json.loads(body))

    def post(self, path: str, **content: object) -> dict[str, object]:
        status, _, body = self.request("POST", path, json.dumps(content).encode())
        assert status == 200, body
        return cast("dict[str, object]", json.loads(body))

    def refuse(self, path: str, **content: object) -> dict[str, str]:
        status, _, body = self.request("POST", path, json.dumps(content).encode())
        assert status >= 400, body
        return cast("dict[str, str]", json.loads(body)["error"])

    def session(self, run: str, action: str = "open", **more: object) -> dict[str, object]:
        return self.post("/api/session", run=run, action=action, **more)

    def wait_for_jobs(self) -> list[dict[str, object]]:
        end = time.monotonic() + PATIENCE_S
        while True:
            jobs = cast("list[dict[str, object]]", self.get("/api/jobs")["jobs"])
            if all(job["done"] for job in jobs):
                return jobs
            assert time.monotonic() < end, jobs
            time.sleep(0.05)
