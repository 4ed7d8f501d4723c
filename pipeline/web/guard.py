"""Access control: only clients with the token, and only requests from this server's own page.

Other users of the machine can also reach the loopback, so the printed token is required: once in the address,
then as a cookie, or as `Authorization: Bearer` from a script. Pages of other sites in the same browser can
send requests here as well, and a host name of such a site may resolve to this machine (DNS rebinding).
Therefore the host must be one that the server was started for, and requests from other origins are refused.

The stored pages of the results are sandboxed from the workbench, so links between them have no origin that
the browser knows. They are opened with a separate cookie that follows links and gives access to nothing else.
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
"""Key in a request's state of the callback for a connection that has shown the token."""
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
# The page is opened by a second request: this removes the token from the address, and the browser treats
# later requests as same-site, wherever the link was. The script preserves the selected run.
_WELCOME = (
    f'{_HEAD}<noscript><meta http-equiv="refresh" content="0; url=/"></noscript>'
    '<script src="/enter.js"></script></head><body></body></html>'
)


def make_token() -> str:
    """A random token."""
    return secrets.token_urlsafe(32)


class Guard:
    """Refuses requests without the token or from other hosts and origins, and adds the security headers.

    Args:
        app: the protected application.
        token: the required token.
        hosts: allowed host names of the server, without a port.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self._app = app
        self._token = token
        self._page_token = hashlib.sha256(f"pages {token}".encode()).hexdigest()
        self._hosts = frozenset(host.lower() for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                # A run's report has its own, stricter policy.
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
        """The answer to a request that is not forwarded to the workbench; None if it is forwarded."""
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
        # Cookies are shared between ports: every workbench on a host needs its own cookie name.
        cookie = f"slip-{scope['server'][1]}"
        if scope["path"] == "/" and self._is_token(QueryParams(scope["query_string"]).get("token", "")):
            welcome = HTMLResponse(_WELCOME)
            welcome.set_cookie(cookie, self._token, httponly=True, samesite="strict")
            welcome.set_cookie(f"{cookie}-pages", self._page_token, httponly=True, samesite="lax")
            return welcome
        # Our cookies are unquoted; common parsers take quadratic time for quoted ones.
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
        # A link from another site may open the page, but not read, load or change anything.
        navigates = (
            scope["method"] in _SAFE
            and headers.get("sec-fetch-mode") == "navigate"
            and (scope["path"] == "/" or _shows_page(scope))
        )
        if headers.get("sec-fetch-site", "same-origin") not in _OWN_SITES and not navigates:
            return "the request comes from another site"
        # Pages of other sites cannot send the token in a header, scripts can.
        if scope["method"] not in _SAFE and origin is None and not bears:
            return "a request that changes something must say its origin"
        return ""


def _shows_page(scope: Scope) -> bool:
    """Whether a request only opens a stored page of the results."""
    return scope["method"] in _SAFE and is_page(scope["path"].removeprefix("/"))


def strip_port(host: str) -> str:
    """Host name of a host header, in lower case, without the port."""
    if host.startswith("["):
        return host[: host.find("]") + 1].lower()
    return host.partition(":")[0].lower()


def _refuse(scope: Scope, code: str, why: str) -> Response:
    if scope["path"] == "/":
        sentence = f"{why[0].upper()}{why[1:]}."
        return HTMLResponse(f"{_HEAD}</head><body><p>{sentence}</p></body></html>", status_code=_REFUSED)
    return JSONResponse({"error": {"code": code, "message": why}}, status_code=_REFUSED)


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
_OPEN_FILES = 4096
"""Requested limit of open files: some hundreds of connections, and the files of analyses."""
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
                self.send_400_response("The head of the request is too long.")
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


def raise_open_files() -> int:
    """Raise this process's limit of open files as far as needed and allowed.

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
    """Report errors of the event loop except socket errors: asyncio retries if there are too many files."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)


def _is_defect(record: logging.LogRecord) -> bool:
    """Whether to print a log record: all except requests cancelled by the shutdown."""
    return not (record.exc_info and isinstance(record.exc_info[1], asyncio.CancelledError))
