"""Who may ask: this machine's own page, and nobody else.

A page of another site that a browser has open may send requests to the loopback; a name that such a site owns
may even resolve to it. So the host must be one that the server was started for, and whatever comes from
another origin is refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.responses import JSONResponse

if TYPE_CHECKING:
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
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")

_SAFE = ("GET", "HEAD")
_OWN_SITES = ("same-origin", "none")


class Guard:
    """Refuses foreign hosts and origins, and puts the headers on every answer.

    Args:
        app: what is guarded.
        hosts: names under which the server may be addressed, without a port.
    """

    def __init__(self, app: ASGIApp, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self._app = app
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

        refused = self._refuse(scope)
        if refused:
            answer = JSONResponse({"error": {"code": "refused", "message": refused}}, status_code=403)
            await answer(scope, receive, send_guarded)
            return
        await self._app(scope, receive, send_guarded)

    def _refuse(self, scope: Scope) -> str:
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]
        }
        host = headers.get("host", "")
        if strip_port(host) not in self._hosts:
            return "this server does not go by that name"
        origin = headers.get("origin")
        if origin is not None and not _is_own(origin, host):
            return "the request comes from another origin"
        if scope["method"] in _SAFE:
            # A link from elsewhere may open the page; it may not read or load anything else.
            site = headers.get("sec-fetch-site", "same-origin")
            navigates = headers.get("sec-fetch-mode") == "navigate" and scope["path"] == "/"
            return "" if site in _OWN_SITES or navigates else "the request comes from another site"
        if origin is None:
            return "a request that changes something must say its origin"
        return ""


def strip_port(host: str) -> str:
    """A host header's name, in small letters, without the port."""
    if host.startswith("["):
        return host[: host.find("]") + 1].lower()
    return host.partition(":")[0].lower()


def _is_own(origin: str, host: str) -> bool:
    parts = urlsplit(origin)
    return parts.scheme == "http" and parts.netloc.lower() == host.lower()
