"""Who may ask the workbench: whoever has the token, from this server's own page or from a script.

Other users of the machine reach the loopback, too, so a token is required: once in the address that `slip
serve` prints, then as a cookie, or as `Authorization: Bearer` from a script. Pages of other sites that are
open in the same browser can send requests as well, and the name of such a site may be made to resolve to this
machine. Therefore the server must be asked by one of its own names, and requests from other origins are
refused. A link may open the page or a stored page of the results, and nothing else; stored pages are
sandboxed, so that links between them have no origin that the browser knows.
"""

from ipaddress import ip_address
from secrets import compare_digest
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.report import is_page
from pipeline.web import LOOPBACK

HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' "
    "data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
SANDBOX = {
    "content-security-policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts"
}
"""Headers of stored pages, which may run their own scripts and reach nothing else."""
EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 - compared, not bound
"""Where a server listens that is reached at every address of its machine."""
_HOW_TO_ENTER = (
    "open the workbench with the whole address that `slip serve` printed, the one with ?token= in it; "
    "a script sends the token as `Authorization: Bearer`"
)
_READS = ("GET", "HEAD")
_REFUSED = 403


class Guard:
    """Refuses requests without the token or from other hosts and origins, and adds the security headers.

    Args:
        app: the protected application.
        token: the required token.
        hosts: names of the server, without a port. Where one stands for all addresses, it is also reached by
            any address: only a name can be made to resolve to this machine.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self._app = app
        self._token = token
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, or refuse it."""

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        else:
            await (self.answer(Request(scope)) or self._app)(scope, receive, send_guarded)

    def answer(self, request: Request) -> Response | None:
        """The answer to a request that is not forwarded to the workbench; None if it is forwarded."""
        bears = self._is_token(request.headers.get("authorization", ""), "Bearer ")
        if reason := self._find_stranger(request, bears=bears):
            return _refuse(request, "refused", reason)
        # Cookies are shared between ports: every workbench on a host needs its own name.
        cookie = f"slip-{request.scope['server'][1]}"
        if request.url.path == "/" and self._is_token(request.query_params.get("token", "")):
            # The second request has no token in its address, and keeps what stands behind # there.
            entered = RedirectResponse("/", status_code=303)
            entered.set_cookie(cookie, self._token, httponly=True, samesite="lax")
            return entered
        if bears or self._is_token(request.cookies.get(cookie, "")):
            return None
        return _refuse(request, "no_token", _HOW_TO_ENTER)

    def _is_token(self, given: str, before: str = "") -> bool:
        return compare_digest(given.encode(), f"{before}{self._token}".encode())

    def _find_stranger(self, request: Request, *, bears: bool) -> str:
        """Why a request is refused whatever token it has; empty if it is not."""
        headers, reads = request.headers, request.method in _READS
        host = headers.get("host", "").lower()
        if not self._is_own(host):
            return "this server does not have that name"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}":
            return "the request comes from another origin"
        path = request.scope["path"]
        opens = path == "/" or is_page(path.removeprefix("/"))
        is_link = reads and opens and headers.get("sec-fetch-mode") == "navigate"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none") and not is_link:
            return "the request comes from another site"
        # Pages of other sites cannot send the token in a header, scripts can.
        if not reads and origin is None and not bears:
            return "a request that changes something must say its origin"
        return ""

    def _is_own(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name in self._hosts or (
                not set(self._hosts).isdisjoint(EVERYWHERE) and bool(ip_address(name))
            )
        except ValueError:
            return False


def _refuse(request: Request, code: str, why: str) -> Response:
    if request.scope["path"] != "/":
        return JSONResponse({"error": {"code": code, "message": why}}, _REFUSED)
    page = '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>workbench \u00b7 slip</title>'
    page += (
        '<meta name="viewport" content="width=device-width"><meta name="color-scheme" content="light dark">'
    )
    return HTMLResponse(f'{page}<link rel="icon" href="data:,"><p>{why[0].upper()}{why[1:]}.</p>', _REFUSED)
