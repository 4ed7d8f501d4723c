"""The workbench: a local page to see where a model fails, to add effects, and to see the error decrease.

State is stored in files with the results, so the page can be reloaded at any time; the figures are those of
the report. The server listens only on the loopback by default, requires a token, and rejects requests from
other pages. Logs are processed in a separate process with limits of time and memory. Here are requests of the
page, answers of the server, limits of both, and access control.

Only clients with the token have access, and only requests from this server's own page. Other users of the
machine can also reach the loopback, so the printed token is required: once in the address, then as a cookie,
or as `Authorization: Bearer` from a script. Pages of other sites in the same browser can send requests here
as well, and a host name of such a site may resolve to this machine (DNS rebinding). Therefore the host must
be one that the server was started for, and requests from other origins are refused.

The stored pages of the results are sandboxed from the workbench, so links between them have no origin that
the browser knows. They are opened with a separate cookie that follows links and gives access to nothing else.
"""

import hashlib
import ipaddress
import math
import resource
import secrets
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from starlette.datastructures import QueryParams
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.core import SlipError
from pipeline.report import is_page

_UNDOABLE = (ArithmeticError, ValueError, TypeError, LookupError, RecursionError, MemoryError)


class WorkbenchError(SlipError):
    """A request to the workbench cannot be fulfilled."""


@contextmanager
def evaluating(run: str) -> Iterator[None]:
    """Convert every arithmetic error of the block, caused by values or formulas of the user, into one error.

    Args:
        run: the run that the error refers to.

    Raises:
        WorkbenchError: ``cannot_evaluate``.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except _UNDOABLE as error:
        raise WorkbenchError(
            "cannot_evaluate",
            f"that cannot be evaluated on this run ({type(error).__name__})",
            where=run,
            hint="The model is unchanged; take other values or another formula.",
        ) from error


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a workbench.

    Attributes:
        log_bytes: largest size of an uploaded log.
        all_bytes: largest total size of the uploaded logs that are not yet processed.
        logs: largest number of these logs.
        silence_s: timeout of an upload without data [s].
        timeout_s: time limit of an analysis or a diagnosis [s].
        memory_bytes: memory limit of an analysis or a diagnosis.
    """

    log_bytes: int = 16_000_000_000
    all_bytes: int = 32_000_000_000
    logs: int = 20
    silence_s: float = 60.0
    timeout_s: float = 1800.0
    memory_bytes: int = 4_000_000_000


class ServerFolders:
    """Folders of the server, and the texts that replace them on the page.

    Args:
        results: the results folder, as the user gave it.
    """

    def __init__(self, results: Path) -> None:
        replaced = {
            str(results.resolve()): str(results),
            str(Path.cwd()): ".",
            str(Path(__file__).parents[2]): "slip",
            sys.prefix: "python",
            sys.base_prefix: "python",
            str(Path.home()): "~",
            tempfile.gettempdir(): "temporary folder",
        }
        # Nested folders are replaced before the folders that contain them.
        self._replaced = sorted(replaced.items(), key=lambda item: -len(item[0]))

    def hide(self, text: str) -> str:
        """Replace the folders in a text that the user has not named."""
        for folder, said in self._replaced:
            if folder != "/":
                text = text.replace(folder, said)
        return text


MOST_BYTES = 100_000

Slot = Literal["a", "b"]


class Ask(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A change to a session.

    Attributes:
        run: name of the run.
        slot: `a`, or `b` for the second session.
        input: `command` or `measured`; None for the default.
        action: the action; `add_named` adds the effects of the diagnosis and fits them jointly, `add_found`
            adds its formula.
        anyway: add an effect even if it is refused; try others even if the diagnosis identified some.
        effect: id of the effect.
        parameter: name of the parameter.
        value: new value.
        channel, formula, parameters: fields of a formula, as typed.
        area: free area for a plan, as typed.
        tab: tab of the figures; empty for all.
        stretch: index of the enlarged stretch, 0 for the one with the largest error.
    """

    run: str
    slot: Slot = "a"
    input: Literal["command", "measured"] | None = None
    action: Literal[
        "open",
        "add",
        "add_named",
        "add_found",
        "drop",
        "switch",
        "set",
        "preview",
        "lock",
        "fit",
        "formula",
        "undo",
        "redo",
        "try",
    ] = "open"
    anyway: bool = False
    effect: str = ""
    parameter: str = ""
    value: float = 0.0
    channel: str = ""
    formula: str = ""
    area: str = ""
    parameters: str = ""
    tab: str = ""
    stretch: int = 0


async def read_ask(request: Request) -> Ask:
    """Parse the body of a request.

    Raises:
        WorkbenchError: ``bad_request``.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise _bad("it is too long")
    try:
        ask = msgspec.json.decode(bytes(body), type=Ask)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _bad(str(error)) from None
    if not math.isfinite(ask.value):
        raise _bad("the value is not a number")
    return ask


def _bad(why: str) -> WorkbenchError:
    return WorkbenchError("bad_request", f"the request cannot be read: {why}", hint="Reload the page.")


_NOT_FOUND = ("no_such_run", "no_such_desk", "no_such_job", "no_page")


def answer(content: Mapping[str, object], status_code: int = 200) -> Response:
    """JSON response; numbers that are not finite become null."""
    body = msgspec.json.encode(content, enc_hook=_make_plain)
    return Response(body, status_code=status_code, media_type="application/json")


def make_handlers(places: ServerFolders) -> dict[type[Exception], Callable[[Request, Exception], Response]]:
    """Handlers that turn errors into responses.

    Args:
        places: folders to hide from the page.
    """

    def respond(_: Request, error: Exception) -> Response:
        shown = error if isinstance(error, SlipError) else _name_defect(error)
        # An option of the command line is a field of the page, which its user sees.
        where = "" if shown.where.startswith("--") else places.hide(shown.where)
        said = {"message": places.hide(shown.what), "where": where, "hint": shown.hint}
        status = 404 if shown.code in _NOT_FOUND else 500 if shown is not error else 422
        return answer({"error": {"code": shown.code, **said}}, status)

    def ignore(_: Request, __: Exception) -> Response:
        # The client has disconnected.
        return Response(status_code=400)

    return {SlipError: respond, ClientDisconnect: ignore, Exception: respond}


def _name_defect(error: Exception) -> SlipError:
    hint = "See the log of the server; nothing was changed."
    return SlipError("defect", f"an internal error occurred ({type(error).__name__})", hint=hint)


def _make_plain(value: object) -> object:
    """Convert a NumPy number to a Python number."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON")


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
EVERY_ADDRESS = frozenset({"0.0.0.0", "::"})  # noqa: S104 - compared, not bound
"""Where a server listens that can be reached at every address of its machine."""
_HOW_TO_ENTER = (
    "open the workbench with the whole address that `slip serve` printed, the one with ?token= in it; "
    "a script sends the token as `Authorization: Bearer`"
)

_REFUSED = 403
_ENTRANCE = "/"
"""The page that the token in the address opens."""
_SAFE = ("GET", "HEAD")
_OWN_SITES = ("same-origin", "none")
_HEAD = (
    '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>workbench \u00b7 slip</title>'
    '<meta name="viewport" content="width=device-width, initial-scale=1">'
    '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
)


def make_token() -> str:
    """A random token."""
    return secrets.token_urlsafe(32)


class Guard:
    """Refuses requests without the token or from other hosts and origins, and adds the security headers.

    Args:
        app: the protected application.
        token: the required token.
        hosts: allowed host names of the server, without a port. With an address that stands for all, any
            address is allowed: only a name can be made to resolve to this machine.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self._app = app
        self._token = token
        self._page_token = hashlib.sha256(f"pages {token}".encode()).hexdigest()
        self._hosts = frozenset(host.lower() for host in hosts)
        self._takes_addresses = not EVERY_ADDRESS.isdisjoint(self._hosts)

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
        given = QueryParams(scope["query_string"]).get("token", "")
        if scope["path"] == _ENTRANCE and self._is_token(given):
            # The page is opened by a second request: that removes the token from the address, and the browser
            # treats later requests as same-site, wherever the link was. The script keeps the selected run.
            welcome = HTMLResponse(
                f'{_HEAD}<noscript><meta http-equiv="refresh" content="0; url={_ENTRANCE}"></noscript>'
                '<script src="/enter.js"></script></head><body></body></html>'
            )
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
        name = strip_port(host)
        if name not in self._hosts and not (self._takes_addresses and _is_address(name)):
            return "this server does not have that name"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host.lower()}":
            return "the request comes from another origin"
        # A link from another site may open the page, but not read, load or change anything.
        navigates = (
            scope["method"] in _SAFE
            and headers.get("sec-fetch-mode") == "navigate"
            and (scope["path"] == _ENTRANCE or _shows_page(scope))
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


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


def strip_port(host: str) -> str:
    """Host name of a host header, in lower case, without the port."""
    if host.startswith("["):
        return host[: host.find("]") + 1].lower()
    return host.partition(":")[0].lower()


def _refuse(scope: Scope, code: str, why: str) -> Response:
    if scope["path"] == _ENTRANCE:
        sentence = f"{why[0].upper()}{why[1:]}."
        return HTMLResponse(f"{_HEAD}</head><body><p>{sentence}</p></body></html>", status_code=_REFUSED)
    return JSONResponse({"error": {"code": code, "message": why}}, status_code=_REFUSED)


_OPEN_FILES = 4096
"""Requested limit of open files: some hundreds of connections, and the files of analyses."""


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


_LAST_PORT = 65535


def is_loopback(host: str) -> bool:
    """Whether an address is reachable from this machine only."""
    return host in LOOPBACK or host == "::1"


def bind_port(host: str, port: int) -> socket.socket:
    """A socket that listens on a port."""
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
