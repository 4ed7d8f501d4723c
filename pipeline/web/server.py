"""HTTP routes of the workbench, and start of its server."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route

from pipeline.job.analyze import PREVIEW, REPORT
from pipeline.job.watch import read_statements
from pipeline.report.page import CATALOGUE, PAGES, PLANS, is_page, load_bundle, warm_bundle
from pipeline.sources import list_presets
from pipeline.web.answers import Ask, Limits, ServerFolders, WorkbenchError, answer, make_handlers, read_ask
from pipeline.web.guard import LOOPBACK, Guard, make_token
from pipeline.web.jobs import Jobs
from pipeline.web.stored_runs import KINDS, find_file, find_run, list_runs
from pipeline.web.workbench import Sessions

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.types import ASGIApp

    from pipeline.batch.batch_work import Report, Task

    Answer = Callable[[Request], Awaitable[Response]]

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
        "live",
    ),
    "pipeline.report": ("marks", "plots"),
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
            Route("/live", _serve_own("pipeline.web", "live.html", "text/html")),
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
            Route("/api/live", self.live),
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

    async def live(self, _: Request) -> Response:
        """Last outputs of `slip watch` for the recordings it follows, with their age [s]."""
        statements = await run_in_threadpool(read_statements, self._sessions.store)
        now = time.time()
        watched = [
            {"log": said.log, "rows": said.rows, "ended": said.ended, "age_s": max(now - said.time, 0.0)}
            for said in statements
        ]
        return answer({"watched": watched})

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
        name, root = request.scope["path"].removeprefix("/"), self._sessions.results.resolve()
        path = (root / name).resolve()
        if not (is_page(name) and path.is_relative_to(root) and path.is_file()):
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


_LAST_PORT = 65535


def is_loopback(host: str) -> bool:
    """Whether an address is reachable from this machine only."""
    return host in LOOPBACK or host == "::1"


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
    from pipeline.web.guard import WorkbenchServer, raise_open_files  # noqa: PLC0415 - heavy

    # Child processes must not import code from their working folder.
    os.environ["PYTHONSAFEPATH"] = "1"
    if host == "localhost":
        # Another program may listen on the other address of that name, and would receive the token.
        host = LOOPBACK[0]
    listener = _listen(host, port)
    hosts = LOOPBACK if is_loopback(host) else (*LOOPBACK, host.lower(), *_own_names(host))
    token = make_token()
    app = build_app(results, token=token, hosts=hosts, limits=limits, diagnosis=diagnosis)
    warm_bundle()
    shown = f"[{host}]" if ":" in host else host
    notify(f"http://{shown}:{listener.getsockname()[1]}/", token)
    WorkbenchServer(app, raise_open_files()).run(sockets=[listener])


def _listen(host: str, port: int) -> socket.socket:
    if not 0 <= port <= _LAST_PORT:
        hint = "Give another --port, or 0 for any that is free."
        raise WorkbenchError(
            "no_such_port", f"ports are 0 to {_LAST_PORT}", where=f"{host}:{port}", hint=hint
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        # Clients may connect as soon as the address is printed; the answer comes when the server is ready.
        listener.listen()
    except OSError as error:
        listener.close()
        hint = "Give another --port, or 0 for any that is free."
        raise WorkbenchError(
            "port_taken", f"nothing can listen there: {error.strerror}", where=f"{host}:{port}", hint=hint
        ) from error
    return listener


def _own_names(host: str) -> tuple[str, ...]:
    """Host names of this machine if the server listens on all addresses."""
    if host not in {"0.0.0.0", "::"}:  # noqa: S104 - compared, not bound
        return ()
    name = socket.gethostname().lower()
    try:
        addresses = {str(info[4][0]) for info in socket.getaddrinfo(name, None)}
    except OSError:
        addresses = set()
    return (name, f"{name}.local", *(f"[{each}]" if ":" in each else each for each in sorted(addresses)))
