"""Connections of the workbench: those that have not shown the token are few, short and hardly read.

Every user of the machine can connect. A connection is pending until a request on it has shown the token.
It is closed after `PENDING_S`, after the first answer, and when it is the oldest of too many. Whoever has the
token shows it with the first bytes, long before as many others have come.
"""

from __future__ import annotations

import asyncio
import logging
import resource
from contextlib import suppress
from typing import TYPE_CHECKING

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from pipeline.web.guard import ADMIT

if TYPE_CHECKING:
    import socket
    from collections.abc import Mapping

    from starlette.types import ASGIApp

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
