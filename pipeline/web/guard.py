"""Who may ask: whoever holds the token, from this server's own page, and nobody else.

Other users of the machine can reach the loopback as well, so the token that was printed with the address is
asked for: once in the address, then as a cookie, or as `Authorization: Bearer` by a script. A page of another
site that a browser has open may send requests here too; a name that such a site owns may even resolve to this
machine. So the host must be one that the server was started for, and whatever comes from another origin is
refused.

The stored pages of the results are shut off from the workbench, so the links between them come from nowhere
that the browser knows: they are opened with a cookie that follows links and opens nothing else.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import resource
import secrets
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

import uvicorn
from starlette.datastructures import QueryParams
from starlette.responses import HTMLResponse, JSONResponse, Response
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from pipeline.report.page import is_page

if TYPE_CHECKING:
    import socket

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
ADMIT = "admit"
"""Key in a request's state of what is called once its connection has shown the token."""
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_HOW_TO_ENTER = (
    "open the workbench with the whole address that `slip serve` printed, the one with ?token= in it; "
    "a script sends the token as `Authorization: Bearer`"
)

_REFUSED = 403
_SAFE = ("GET", "HEAD")
_OWN_SITES = ("same-origin", "none")
_HEAD = (
    '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>workbench \u00b7 slip</title>'
    '<meta name="viewport" content="width=device-width, initial-scale=1">'
    '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
)
# The page is opened by a request of its own: the token leaves the address, and the browser takes later
# requests for the same site's, wherever the link to here stood. The script keeps which run was meant.
_WELCOME = (
    f'{_HEAD}<noscript><meta http-equiv="refresh" content="0; url=/"></noscript>'
    '<script src="/enter.js"></script></head><body></body></html>'
)


def make_token() -> str:
    """A token that nobody can guess."""
    return secrets.token_urlsafe(32)


class Guard:
    """Refuses whoever has no token, foreign hosts and origins, and puts the headers on every answer.

    Args:
        app: what is guarded.
        token: what must be known.
        hosts: names under which the server may be addressed, without a port.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self._app = app
        self._token = token
        self._page_token = hashlib.sha256(f"pages {token}".encode()).hexdigest()
        self._hosts = frozenset(host.lower() for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                # A run's own report brings its own, even stricter, policy with it.
                own = {name.lower() for name, _ in message["headers"]}
                added = [(k.encode(), v.encode()) for k, v in HEADERS.items() if k.encode() not in own]
                message = {**message, "headers": [*message["headers"], *added]}
            await send(message)

        answer = self._answer(scope)
        admit = scope.get("state", {}).get(ADMIT)
        if admit is not None and (answer is None or answer.status_code != _REFUSED):
            admit()
        await (answer or self._app)(scope, receive, send_guarded)

    def _answer(self, scope: Scope) -> Response | None:
        """The answer to a request that does not reach the workbench."""
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]
        }
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        bears = scheme.lower() == "bearer" and self._is_token(bearer.strip())
        reason = self._check_origin(scope, headers, bears=bears)
        if reason:
            return _refuse(scope, "refused", reason)
        if bears:
            return None
        # Cookies do not tell ports apart: workbenches side by side need names of their own.
        cookie = f"slip-{scope['server'][1]}"
        if scope["path"] == "/" and self._is_token(QueryParams(scope["query_string"]).get("token", "")):
            welcome = HTMLResponse(_WELCOME)
            welcome.set_cookie(cookie, self._token, httponly=True, samesite="strict")
            welcome.set_cookie(f"{cookie}-pages", self._page_token, httponly=True, samesite="lax")
            return welcome
        # Own cookies are plain; the usual parsers take the square of the length over quoted ones.
        pairs = (part.strip().partition("=") for part in headers.get("cookie", "").split(";"))
        cookies = {name: value for name, _, value in pairs}
        if self._is_token(cookies.get(cookie, "")):
            return None
        opens = cookies.get(f"{cookie}-pages", "").encode()
        if _shows_page(scope) and secrets.compare_digest(opens, self._page_token.encode()):
            return None
        return _refuse(scope, "no_token", _HOW_TO_ENTER)

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self._token.encode())

    def _check_origin(self, scope: Scope, headers: Mapping[str, str], *, bears: bool) -> str:
        host = headers.get("host", "")
        if strip_port(host) not in self._hosts:
            return "this server does not go by that name"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host.lower()}":
            return "the request comes from another origin"
        # A link from elsewhere may open the page; it may not read, load or change anything.
        navigates = (
            scope["method"] in _SAFE
            and headers.get("sec-fetch-mode") == "navigate"
            and (scope["path"] == "/" or _shows_page(scope))
        )
        if headers.get("sec-fetch-site", "same-origin") not in _OWN_SITES and not navigates:
            return "the request comes from another site"
        # No page of another site can send the token itself, as a script does.
        if scope["method"] not in _SAFE and origin is None and not bears:
            return "a request that changes something must say its origin"
        return ""


def _shows_page(scope: Scope) -> bool:
    """Whether a request only opens a stored page of the results."""
    return scope["method"] in _SAFE and is_page(scope["path"].removeprefix("/"))


def strip_port(host: str) -> str:
    """A host header's name, in small letters, without the port."""
    if host.startswith("["):
        return host[: host.find("]") + 1].lower()
    return host.partition(":")[0].lower()


def _refuse(scope: Scope, code: str, why: str) -> Response:
    if scope["path"] == "/":
        sentence = f"{why[0].upper()}{why[1:]}."
        return HTMLResponse(f"{_HEAD}</head><body><p>{sentence}</p></body></html>", status_code=_REFUSED)
    return JSONResponse({"error": {"code": code, "message": why}}, status_code=_REFUSED)


# Connections of the workbench: those that have not shown the token are few, short and hardly read.
#
# Every user of the machine can connect. A connection is pending until a request on it has shown the token. It
# is closed after `PENDING_S`, after the first answer, and when it is the oldest of too many. Whoever has the
# token shows it with the first bytes, long before as many others have come.

PENDING_S = 10.0
"""Longest time until a connection has shown the token [s]: two lost packets and the headers fit into it."""
ANSWER_S = 1.0
"""Time to read the answer to a request whose body is not read, before the connection is reset [s]."""
MOST_PENDING = 256
"""Most connections that have not shown the token: a quarter of the usual limit of 1,024 open files."""
_HEAD_BYTES = 16_384
"""Largest head of a request without a shown token: h11's own limit where a head comes in parts [bytes]."""
_HEAD_LINES = 100
"""Most lines of such a head: one takes h11 22 us, and browsers send about 20."""
_OPEN_FILES = 4096
"""Open files that the server asks for: some hundreds of connections, and what the analysis of runs opens."""
_ACCEPTS = 8
"""Pending connections over those that are accepted at once. A connection is closed three rounds of the event
loop after it was accepted, so those that are not closed yet are fewer than the pending ones, and one that has
sent its headers is read before it is the oldest."""
_QUEUE = 512
"""Connections that the kernel keeps until they are accepted, 0.3 s of refused requests: what comes beyond
them is dropped and tried again after 1 s."""


class Connections(ServerState):
    """What the connections of a server share.

    Args:
        most_pending: most connections that have not shown the token.

    Attributes:
        pending: those connections, the oldest first.
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
        """Begin to wait for the token, and close the oldest connection of too many."""
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
        """Take data in, unless the head is so long that reading it would hold up others."""
        if self in self._shared.pending:
            head = data.partition(b"\r\n\r\n")[0]
            self._lines += head.count(b"\n")
            if len(head) > _HEAD_BYTES or self._lines > _HEAD_LINES:
                self.send_400_response("The head of the request is too long.")
                return
        super().data_received(data)

    def on_response_complete(self) -> None:
        """Close the connection where the token was not shown or the body was not read; else keep it."""
        if self.cycle.more_body:
            # Closed at once, it would be reset by what still comes, and the answer might be lost.
            self.flow.pause_reading()
            with suppress(OSError):
                self.transport.write_eof()
            self.loop.call_later(ANSWER_S, self.transport.abort)
            return
        if self in self._shared.pending:
            self.transport.close()
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, unless the answer to its beginning is under way."""
        answers = self.cycle is not None and not self.cycle.response_complete
        if answers:
            # The application must not answer a second time.
            self.cycle.disconnected = True
        if answers and self.cycle.response_started:
            self.transport.abort()
        else:
            super().send_400_response(msg)


class WorkbenchServer(uvicorn.Server):
    """Serves the workbench on sockets that listen.

    Args:
        app: the workbench.
        open_files: how many files and connections the process may have open.
    """

    def __init__(self, app: ASGIApp, open_files: int) -> None:
        most_pending = min(MOST_PENDING, open_files // 4)
        super().__init__(
            uvicorn.Config(
                app,
                http=WorkbenchProtocol,
                loop="asyncio",
                ws="none",
                # A warning is what a client did wrong.
                log_level="error",
                server_header=False,
                access_log=False,
                backlog=max(1, most_pending // _ACCEPTS),
                timeout_graceful_shutdown=2,
            )
        )
        self.server_state = Connections(most_pending)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to accept connections."""
        asyncio.get_running_loop().set_exception_handler(_report_defect)
        logging.getLogger("uvicorn.error").addFilter(_is_defect)
        await super().startup(sockets)
        for listener in sockets or []:
            # To asyncio the queue is as long as what it accepts at once.
            listener.listen(_QUEUE)


def raise_open_files() -> int:
    """Raise this process's limit of open files as far as it may and as is needed.

    Returns:
        The limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return _OPEN_FILES
    wanted = _OPEN_FILES if hard == resource.RLIM_INFINITY else min(_OPEN_FILES, hard)
    if soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    return max(soft, wanted)


def _report_defect(loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
    """Report what failed in the event loop, except sockets: asyncio accepts again where files ran out."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)


def _is_defect(record: logging.LogRecord) -> bool:
    """Whether a record is to be printed: all but requests that were cancelled because the server ends."""
    return not (record.exc_info and isinstance(record.exc_info[1], asyncio.CancelledError))
