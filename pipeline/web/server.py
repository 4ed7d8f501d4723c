"""HTTP routes of the workbench, and the start of its server."""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import msgspec
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route

from pipeline.core import SlipError, naming_os_errors, resolve_inside
from pipeline.report import CATALOGUE, PAGES, PLANS, is_page
from pipeline.report.theme import load_bundle, warm_bundle
from pipeline.sources import list_presets
from pipeline.store import REPORT
from pipeline.web import LOOPBACK, Ask, Limits, WorkbenchError
from pipeline.web.guard import EVERYWHERE, SANDBOX, Guard
from pipeline.web.jobs import Jobs, work
from pipeline.web.runs import find_run, summarize_run
from pipeline.web.workbench import Workbench

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from pipeline.batch.batch_work import Report, Task

_MOST_BYTES = 100_000
"""Largest body of a request that is no log [bytes]."""
_ROOMS = [Path(str(files(room))) for room in ("pipeline.web", "pipeline.report")]
"""Folders of the page's own files."""
_NOT_FOUND = ("no_such_run", "no_such_job", "no_page")


class Web:
    """HTTP handlers of the workbench.

    Args:
        bench: the state that they use.
    """

    def __init__(self, bench: Workbench) -> None:
        self._bench = bench

    def routes(self) -> list[Route]:
        """All routes."""
        bench = self._bench
        asked = {
            "session": bench.answer,
            "figures": bench.draw,
            "rows": bench.redraw,
            "save": bench.save,
            "validate": bench.validate,
            "diagnose": bench.diagnose,
        }
        own = [file for room in _ROOMS for file in room.iterdir() if file.suffix in (".js", ".css")]
        return [
            Route("/", _serve(_ROOMS[0] / "page.html")),
            *(Route(f"/{file.name}", _serve(file)) for file in own),
            Route("/vega.js", self.bundle),
            Route("/model.toml", self.download),
            Route("/report", self.report),
            *(Route(f"/{name}", self.page) for name in PAGES),
            *(Route(f"/{top}/{{place:path}}", self.page) for top in ("runs", PLANS)),
            Route("/api/runs", self.runs),
            Route("/api/jobs", self.jobs),
            *(Route(f"/api/{name}", partial(_ask, do), methods=["POST"]) for name, do in asked.items()),
            Route("/api/upload", self.upload, methods=["POST"]),
            Route("/api/sample", self.sample, methods=["POST"]),
            Route("/api/retry", self.retry, methods=["POST"]),
            Route("/api/dismiss", self.dismiss, methods=["POST"]),
        ]

    def runs(self, _: Request) -> Response:
        """Runs, jobs and known vehicles."""
        bench = self._bench
        return answer(
            {
                "runs": [summarize_run(manifest) for manifest in bench.store.manifests()],
                "jobs": bench.jobs.show(),
                "vehicles": [{"id": preset.id, "name": preset.name} for preset in list_presets()],
                "results": str(bench.results),
                "catalogue": (bench.results / CATALOGUE).is_file(),
            }
        )

    def jobs(self, _: Request) -> Response:
        """All jobs."""
        return answer({"jobs": self._bench.jobs.show()})

    def download(self, request: Request) -> Response:
        """The model file of a session."""
        run, slot = request.query_params.get("run", ""), request.query_params.get("slot", "a")
        text = self._bench.format_model(msgspec.convert({"run": run, "slot": slot}, Ask))
        name = quote(f"{run.rpartition('/')[2]}.toml", safe="")
        return PlainTextResponse(
            text, headers={"content-disposition": f"attachment; filename*=UTF-8''{name}"}
        )

    def report(self, request: Request) -> Response:
        """The stored report of a run, sandboxed from this page."""
        run = request.query_params.get("run", "")
        return _serve_page(find_run(self._bench.store, run).path(REPORT), run)

    def page(self, request: Request) -> Response:
        """A stored page of the results, by its path in their folder, sandboxed from the workbench."""
        name = request.scope["path"].removeprefix("/")
        path = resolve_inside(self._bench.results.resolve(), name)
        return _serve_page(path if is_page(name) else Path(), name)

    def bundle(self, _: Request) -> Response:
        """The JavaScript of the figures."""
        # It changes only with the installed version: caching avoids reloading megabytes.
        headers = {"cache-control": "private, max-age=3600"}
        return Response(load_bundle(), media_type="text/javascript", headers=headers)

    async def upload(self, request: Request) -> Response:
        """Receive a log, and start its analysis."""
        length, name = request.headers.get("content-length", "-1"), request.query_params.get("name", "")
        job = await self._bench.jobs.take(name, int(length), request.stream())
        return answer({"job": job.show()})

    def sample(self, _: Request) -> Response:
        """Start to simulate a sample log and to analyze it."""
        return answer({"job": self._bench.jobs.make_sample().show()})

    def retry(self, request: Request) -> Response:
        """Repeat the analysis of a log with the vehicle that the user has chosen."""
        query = request.query_params
        return answer({"job": self._bench.jobs.retry(query.get("id", ""), query.get("vehicle", "")).show()})

    def dismiss(self, request: Request) -> Response:
        """Remove a job; one that is being worked on is ended."""
        self._bench.jobs.dismiss(request.query_params.get("id", ""))
        return answer({"jobs": self._bench.jobs.show()})


async def _ask(do: Callable[[Ask], Mapping[str, object]], request: Request) -> Response:
    """Apply the change in the body of a request."""
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_BYTES:
            raise WorkbenchError("bad_request", "the request is too long", hint="Reload the page.")
    try:
        ask = msgspec.json.decode(body, type=Ask)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        what = f"the request cannot be read: {error}"
        raise WorkbenchError("bad_request", what, hint="Correct the field, or reload the page.") from None
    return answer(await run_in_threadpool(do, ask))


def answer(content: Mapping[str, object], status: int = 200) -> Response:
    """JSON response; numbers that are not finite become null."""
    body = msgspec.json.encode(content, enc_hook=np.generic.item)
    return Response(body, status, media_type="application/json")


def _serve(file: Path) -> Callable[[Request], Response]:
    return lambda _: FileResponse(file)


def _serve_page(path: Path, name: str) -> Response:
    if not path.is_file():
        hint = "Analyze the log again, or open / for the workbench."
        raise WorkbenchError("no_page", "the results have no such page", where=name, hint=hint)
    return FileResponse(path, media_type="text/html", headers=SANDBOX)


def _explain(_: Request, error: Exception) -> Response:
    if isinstance(error, SlipError):
        # An option of the command line is a field of the page, which its user sees.
        where = "" if error.where.startswith("--") else error.where
        said = {"code": error.code, "message": error.what, "where": where, "hint": error.hint}
        return answer({"error": said}, 404 if error.code in _NOT_FOUND else 422)
    what = f"an internal error occurred ({type(error).__name__})"
    hint = "See what the server printed; nothing was changed."
    return answer({"error": {"code": "defect", "message": what, "where": "", "hint": hint}}, 500)


def build_app(
    results: Path,
    *,
    token: str,
    hosts: tuple[str, ...] = LOOPBACK,
    limits: Limits | None = None,
    diagnosis: bool = True,
    do: Callable[[Task], Report] = work,
) -> ASGIApp:
    """The workbench as an ASGI application.

    Args:
        results: the results folder; need not exist yet.
        token: the token that requests must have.
        hosts: allowed host names, without a port.
        limits: limits of logs and their processing.
        diagnosis: whether a dropped log is also diagnosed.
        do: function of the worker process for a task; importable by its name there.
    """
    jobs = Jobs(results, limits or Limits(), diagnosis=diagnosis, do=do)

    @asynccontextmanager
    async def live(_: Starlette) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(jobs.close)

    # A client that has left is told nothing.
    handlers = {SlipError: _explain, ClientDisconnect: _explain, Exception: _explain}
    routes = Web(Workbench(results, jobs)).routes()
    return Guard(Starlette(routes=routes, exception_handlers=handlers, lifespan=live), token, hosts)


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
        diagnosis: whether a dropped log is also diagnosed.

    Raises:
        WorkbenchError: ``no_such_port``, ``port_taken``: nothing can listen there.
    """
    # Child processes must not import code from their working folder.
    os.environ["PYTHONSAFEPATH"] = "1"
    if host == "localhost":
        # Another program may listen on the other address of that name, and would receive the token.
        host = LOOPBACK[0]
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    what, hint = "nothing can listen there", "Give another --port, or 0 for any that is free."
    if port not in range(1 << 16):
        raise WorkbenchError("no_such_port", what, where=f"{host}:{port}", hint=hint)
    with naming_os_errors(WorkbenchError, "port_taken", what, where=f"{host}:{port}", hint=hint):
        listener = socket.create_server((host, port), family=family)
    hosts: tuple[str, ...] = (*LOOPBACK, host.lower())
    shown = host
    if host in EVERYWHERE:
        name = socket.gethostname().lower()
        hosts = (*hosts, name, f"{name}.local")
        shown = _find_own_address(host, family)
    token = secrets.token_urlsafe(32)
    app = build_app(results, token=token, hosts=hosts, limits=limits, diagnosis=diagnosis)
    warm_bundle()
    shown = f"[{shown}]" if ":" in shown else shown
    notify(f"http://{shown}:{listener.getsockname()[1]}/", token)
    settings = uvicorn.Config(
        app, ws="none", log_level="error", server_header=False, access_log=False, timeout_graceful_shutdown=2
    )
    uvicorn.Server(settings).run(sockets=[listener])


def _find_own_address(host: str, family: socket.AddressFamily) -> str:
    """The address at which other machines reach this one; the host itself where it has no network."""
    with socket.socket(family, socket.SOCK_DGRAM) as asked:
        try:
            # Addresses of documentation, to which nothing is sent: the way to them is that to other machines.
            asked.connect(("2001:db8::1" if ":" in host else "192.0.2.1", 9))
        except OSError:
            return host
        return str(asked.getsockname()[0])
