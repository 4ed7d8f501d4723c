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

import hashlib
import secrets
from typing import TYPE_CHECKING

from starlette.datastructures import QueryParams
from starlette.responses import HTMLResponse, JSONResponse, Response

from pipeline.report.pages import is_page

if TYPE_CHECKING:
    from collections.abc import Mapping

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
                more = [(k.encode(), v.encode()) for k, v in HEADERS.items() if k.encode() not in own]
                message = {**message, "headers": [*message["headers"], *more]}
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
        refused = self._check_origin(scope, headers, bears=bears)
        if refused:
            return _refuse(scope, "refused", refused)
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
