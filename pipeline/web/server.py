"""HTTP routes of the workbench, limits of its connections, and start of its server."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from pipeline.core import PathError, resolve_inside
from pipeline.report import CATALOGUE, PAGES, PLANS, is_page
from pipeline.report.drive_pages import PREVIEW
from pipeline.report.theme import load_bundle, warm_bundle
from pipeline.sources import list_presets
from pipeline.store import REPORT
from pipeline.web import (
    ADMIT,
    EVERY_ADDRESS,
    LOOPBACK,
    Ask,
    Guard,
    Limits,
    ServerFolders,
    WorkbenchError,
    answer,
    bind_port,
    is_loopback,
    make_handlers,
    make_token,
    raise_open_files,
    read_ask,
)
from pipeline.web.jobs import Jobs
from pipeline.web.stored_runs import KINDS, find_file, find_run, list_runs
from pipeline.web.workbench import Sessions

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.types import ASGIApp

    from pipeline.batch.batch_work import Report, Task

    Answer = Callable[[Request], Awaitable[Response]]

# Connections of the workbench: limits of number, time and size for those that have not shown the token.
#
# Every user of the machine can connect. A connection is pending until a request on it has shown the token. A
# pending connection is closed after `PENDING_S`, after the first answer, and if it is the oldest of too many.
# Clients with the token show it with the first bytes, long before the limit is reached.

PENDING_S = 10.0
"""Longest time until a connection has shown the token [s]: enough for two lost packets and the headers."""
ANSWER_S = 1.0
"""Time to read the answer to a request whose body is not read, before the connection is reset [s]."""
MOST_PENDING = 256
"""Largest number of pending connections: a quarter of the usual limit of 1,024 open files."""
_HEAD_BYTES = 16_384
"""Largest request head of a pending connection [bytes]: h11's own limit for a head that arrives in parts."""
_HEAD_LINES = 100
"""Largest number of lines of such a head: h11 takes 22 us per line, and browsers send about 20."""
_ACCEPTS = 8
"""Ratio of the limit of pending connections to those accepted at once. A connection is closed three rounds of
the event loop after it was accepted, so fewer connections are waiting to be closed than may be pending, and a
connection that has sent its headers is read before it becomes the oldest."""
_QUEUE = 512
"""Length of the kernel's queue of connections, 0.3 s of refused requests; further ones are dropped, and the
client retries after 1 s."""


class Connections(ServerState):
    """Shared state of the connections of a server.

    Args:
        most_pending: largest number of pending connections.

    Attributes:
        pending: pending connections, the oldest first.
    """

    def __init__(self, most_pending: int) -> None:
        super().__init__()
        self.most_pending = most_pending
        self.pending: dict[WorkbenchProtocol, None] = {}


class WorkbenchProtocol(H11Protocol):
    """HTTP on one connection, pending until the application calls `ADMIT` of a request's state."""

    def __init__(
        self,
        config: uvicorn.Config,
        server_state: Connections,
        app_state: Mapping[str, object],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, {**app_state, ADMIT: self._end_pending}, _loop)
        self._shared = server_state
        self._lines = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as uvicorn
        """Start to wait for the token, and close the oldest connection if there are too many."""
        super().connection_made(transport)
        pending = self._shared.pending
        pending[self] = None
        self._deadline = self.loop.call_later(PENDING_S, transport.abort)
        if len(pending) > self._shared.most_pending:
            oldest = next(iter(pending))
            del pending[oldest]
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._end_pending()
        super().connection_lost(exc)

    def _end_pending(self) -> None:
        self._deadline.cancel()
        self._shared.pending.pop(self, None)

    def data_received(self, data: bytes) -> None:
        """Process data, unless the head is so long that parsing it would delay other clients."""
        if self in self._shared.pending:
            head = data.partition(b"\r\n\r\n")[0]
            self._lines += head.count(b"\n")
            if len(head) > _HEAD_BYTES or self._lines > _HEAD_LINES:
                self.send_400_response("The header of the request is too long.")
                return
        super().data_received(data)

    def on_response_complete(self) -> None:
        """Close the connection if the token was not shown or the body was not read; else keep it open."""
        if self.cycle.more_body:
            # If closed immediately, incoming data would reset it, and the answer might be lost.
            self.flow.pause_reading()
            with suppress(OSError):
                self.transport.write_eof()
            self.loop.call_later(ANSWER_S, self.transport.abort)
            return
        if self in self._shared.pending:
            self.transport.close()
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Answer data that are not HTTP, unless a response is already being sent."""
        answers = self.cycle is not None and not self.cycle.response_complete
        if answers:
            # The application must not answer a second time.
            self.cycle.disconnected = True
        if answers and self.cycle.response_started:
            self.transport.abort()
        else:
            super().send_400_response(msg)


class WorkbenchServer(uvicorn.Server):
    """Serves the workbench on listening sockets.

    Args:
        app: the workbench.
        open_files: limit of open files and connections of the process.
    """

    def __init__(self, app: ASGIApp, open_files: int) -> None:
        most_pending = min(MOST_PENDING, open_files // 4)
        super().__init__(
            uvicorn.Config(
                app,
                http=WorkbenchProtocol,
                loop="asyncio",
                ws="none",
                # Warnings report errors of clients.
                log_level="error",
                server_header=False,
                access_log=False,
                backlog=max(1, most_pending // _ACCEPTS),
                timeout_graceful_shutdown=2,
            )
        )
        self.server_state = Connections(most_pending)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept connections."""
        asyncio.get_running_loop().set_exception_handler(_report_defect)
        logging.getLogger("uvicorn.error").addFilter(_is_defect)
        await super().startup(sockets)
        for listener in sockets or []:
            # asyncio uses the same value for the queue and for the connections accepted at once.
            listener.listen(_QUEUE)


def _report_defect(loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
    """Report errors of the event loop except socket errors: asyncio retries if there are too many files."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)


def _is_defect(record: logging.LogRecord) -> bool:
    """Whether to print a log record: all except requests cancelled by the shutdown."""
    return not (record.exc_info and isinstance(record.exc_info[1], asyncio.CancelledError))


_LONGEST_LENGTH = 18
"""Largest number of digits of an announced log size, checked before parsing."""

_SCRIPTS = {
    "pipeline.web": (
        "enter",
        "page",
        "pane",
        "figures",
        "tabs",
        "runs",
        "model",
        "parts",
        "plan",
        "difference",
    ),
    "pipeline.report": ("cursor", "marks", "plots"),
}

# The report contains its own policy: it may run its own scripts, and access nothing else.
_SHUT_OFF = {
    "content-security-policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts"
}


class Web:
    """HTTP handlers of the workbench.

    Args:
        sessions: the sessions that the handlers use.
    """

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions

    def routes(self) -> list[Route]:
        """All routes."""
        sessions = self._sessions
        asked = {
            "session": sessions.answer,
            "figures": sessions.draw,
            "rows": sessions.redraw,
            "save": sessions.save,
            "diagnose": sessions.diagnose,
            "plan": sessions.plan,
        }
        return [
            Route("/", _serve_own("pipeline.web", "page.html", "text/html")),
            Route("/page.css", _serve_own("pipeline.web", "page.css", "text/css")),
            *(
                Route(f"/{name}.js", _serve_own(package, f"{name}.js", "text/javascript"))
                for package, names in _SCRIPTS.items()
                for name in names
            ),
            Route("/vega.js", self.bundle),
            Route("/model.toml", self.download),
            Route("/report", self.report),
            *(Route(f"/{name}", self.page) for name in PAGES),
            *(Route(f"/{top}/{{place:path}}", self.page) for top in ("runs", PLANS)),
            Route("/api/runs", self.runs),
            Route("/api/jobs", self.jobs),
            *(Route(f"/api/{name}", _serve_asked(do), methods=["POST"]) for name, do in asked.items()),
            Route("/api/upload", self.upload, methods=["POST"]),
            Route("/plan", self.plan_file),
            Route("/api/sample", self.sample, methods=["POST"]),
            Route("/api/retry", self.retry, methods=["POST"]),
            Route("/api/dismiss", self.dismiss, methods=["POST"]),
        ]

    async def runs(self, _: Request) -> Response:
        """Runs, jobs and known vehicles."""
        sessions = self._sessions
        listed = await run_in_threadpool(list_runs, sessions.store)
        presets = [{"id": preset.id, "name": preset.name} for preset in list_presets()]
        answer_parts = {"jobs": sessions.jobs.show(), "vehicles": presets, "results": str(sessions.results)}
        answer_parts["catalogue"] = (sessions.results / CATALOGUE).is_file()
        return answer({**listed, **answer_parts})

    async def jobs(self, _: Request) -> Response:
        """All jobs."""
        return answer({"jobs": self._sessions.jobs.show()})

    async def download(self, request: Request) -> Response:
        """The model file of a session."""
        run, slot = request.query_params.get("run", ""), request.query_params.get("slot", "a")
        text = await run_in_threadpool(self._sessions.format_model, run, slot)
        name = quote(f"{run.rpartition('/')[2]}.toml", safe="")
        disposition = f"attachment; filename*=UTF-8''{name}"
        return PlainTextResponse(text, headers={"content-disposition": disposition})

    async def report(self, request: Request) -> Response:
        """The stored report of a run, sandboxed from this page."""
        run = request.query_params.get("run", "")
        manifest = await run_in_threadpool(find_run, self._sessions.store, run)
        path = manifest.path(REPORT)
        if not path.is_file():
            raise WorkbenchError("no_report", "its report is gone", where=run, hint="Analyze the log again.")
        return FileResponse(path, media_type="text/html", headers=_SHUT_OFF)

    async def page(self, request: Request) -> Response:
        """A stored page of the results, by its path in their folder, sandboxed from the workbench."""
        name = request.scope["path"].removeprefix("/")
        try:
            path = resolve_inside(self._sessions.results.resolve(), name)
        except PathError:
            path = None
        if path is None or not (is_page(name) and path.is_file()):
            raise WorkbenchError(
                "no_page", "the results have no such page", where=name, hint="Open / for the workbench."
            )
        return FileResponse(path, media_type="text/html", headers=_SHUT_OFF)

    async def bundle(self, _: Request) -> Response:
        """The JavaScript of the figures."""
        script = await run_in_threadpool(load_bundle)
        # It changes only with the installed version: caching avoids reloading megabytes.
        headers = {"cache-control": "private, max-age=3600"}
        return Response(script, media_type="text/javascript", headers=headers)

    async def upload(self, request: Request) -> Response:
        """Receive a log, and start its analysis."""
        length = request.headers.get("content-length", "")
        if not (length.isascii() and length.isdecimal() and len(length) <= _LONGEST_LENGTH):
            raise WorkbenchError("no_length", "the size of the log is not known", hint="Drop it again.")
        name = request.query_params.get("name", "")
        job = await self._sessions.jobs.take(name, int(length), request.stream())
        return answer({"job": job.show()})

    async def plan_file(self, request: Request) -> Response:
        """A file of the plan of a run; its page is sandboxed from this one."""
        run, name = request.query_params.get("run", ""), request.query_params.get("file", "")
        manifest = await run_in_threadpool(find_run, self._sessions.store, run)
        path = find_file(self._sessions.results, manifest.run, name)
        if not path.is_file():
            raise WorkbenchError("no_plan", "nothing is planned", where=run, hint="Plan a drive first.")
        if name == PREVIEW:
            return FileResponse(path, media_type=KINDS[name])
        shown = "inline" if name.endswith(".html") else "attachment"
        return FileResponse(
            path, media_type=KINDS[name], filename=name, content_disposition_type=shown, headers=_SHUT_OFF
        )

    async def sample(self, _: Request) -> Response:
        """Start to simulate a sample log and to analyze it."""
        job = await run_in_threadpool(self._sessions.jobs.make_sample)
        return answer({"job": job.show()})

    async def retry(self, request: Request) -> Response:
        """Repeat the analysis of a log with the vehicle that the user has chosen."""
        query = request.query_params
        job = self._sessions.jobs.retry(query.get("id", ""), query.get("vehicle", ""))
        return answer({"job": job.show()})

    async def dismiss(self, request: Request) -> Response:
        """Remove a job that has ended."""
        self._sessions.jobs.dismiss(request.query_params.get("id", ""))
        return answer({"jobs": self._sessions.jobs.show()})


def build_app(
    results: Path,
    *,
    token: str,
    hosts: tuple[str, ...] = LOOPBACK,
    limits: Limits | None = None,
    diagnosis: bool = True,
    work: Callable[[Task], Report] | None = None,
) -> ASGIApp:
    """The workbench as an ASGI application.

    Args:
        results: the results folder; need not exist yet.
        token: the token that requests must have.
        hosts: allowed host names, without a port.
        limits: limits of logs and their processing.
        diagnosis: whether an uploaded log is also diagnosed.
        work: function of the worker process for a task; importable by its name there.
    """
    places = ServerFolders(results)
    jobs = Jobs(results, limits or Limits(), diagnosis=diagnosis, places=places, work=work)

    @asynccontextmanager
    async def live(_: Starlette) -> AsyncIterator[None]:
        try:
            yield
        finally:
            await run_in_threadpool(jobs.close)

    routes = Web(Sessions(results, jobs)).routes()
    app = Starlette(routes=routes, exception_handlers=make_handlers(places), lifespan=live)
    return Guard(app, token, hosts)


def _serve_asked(do: Callable[[Ask], Mapping[str, object]]) -> Answer:
    async def serve(request: Request) -> Response:
        return answer(await run_in_threadpool(do, await read_ask(request)))

    return serve


def _serve_own(package: str, name: str, kind: str) -> Answer:
    content = files(package).joinpath(name).read_text(encoding="utf-8")

    async def serve(_: Request) -> Response:
        return Response(content, media_type=kind)

    return serve


def serve(
    results: Path,
    *,
    host: str,
    port: int,
    notify: Callable[[str, str], None],
    limits: Limits,
    diagnosis: bool = True,
) -> None:
    """Serve the workbench until it is interrupted.

    Args:
        results: the results folder.
        host: address to listen on; any address but the loopback opens it to the network.
        port: port to listen on; 0 selects any free one.
        notify: callback, called with the address and the token when the server listens.
        limits: limits of logs and their processing.
        diagnosis: whether an uploaded log is also diagnosed.

    Raises:
        WorkbenchError: ``no_such_port``; ``port_taken``, the port cannot be opened.
    """
    # Child processes must not import code from their working folder.
    os.environ["PYTHONSAFEPATH"] = "1"
    if host == "localhost":
        # Another program may listen on the other address of that name, and would receive the token.
        host = LOOPBACK[0]
    listener = bind_port(host, port)
    hosts = LOOPBACK if is_loopback(host) else (*LOOPBACK, host.lower(), *_own_names(host))
    token = make_token()
    app = build_app(results, token=token, hosts=hosts, limits=limits, diagnosis=diagnosis)
    warm_bundle()
    shown = _find_own_address(host) if host in EVERY_ADDRESS else host
    shown = f"[{shown}]" if ":" in shown else shown
    notify(f"http://{shown}:{listener.getsockname()[1]}/", token)
    WorkbenchServer(app, raise_open_files()).run(sockets=[listener])


def _own_names(host: str) -> tuple[str, ...]:
    """Host names of this machine if the server listens on all addresses."""
    name = socket.gethostname().lower()
    return (name, f"{name}.local") if host in EVERY_ADDRESS else ()


_FAR = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}  # noqa: S104 - likewise
"""Addresses of documentation, to which nothing is sent: the way to them is that to other machines."""


def _find_own_address(host: str) -> str:
    """The address at which other machines reach this one; the host itself where it has no network."""
    family, far = _FAR[host]
    with socket.socket(family, socket.SOCK_DGRAM) as asked:
        try:
            asked.connect((far, 9))
        except OSError:
            return host
        return str(asked.getsockname()[0])
