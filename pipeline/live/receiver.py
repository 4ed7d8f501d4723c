"""Process that records the messages of a live server and reconnects after lost connections.

It is a separate process because rosbridge messages have no time but that of their arrival, which a thread
beside the analysis would take late. It ends with the process that started it.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import msgspec

from pipeline.core import SlipError
from pipeline.live import LiveError
from pipeline.logs import TRANSFORM_TYPES
from pipeline.logs.live_recording import (
    FOXGLOVE_NAMES,
    FrameError,
    LiveProtocol,
    LiveRecording,
    choose_protocol,
)
from pipeline.sources import STRING_TYPE, MessageType, find_type, plain_type

if TYPE_CHECKING:
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import ClientConnection

OPEN_S: Final = 5.0
"""Timeout of a connection and of the first answer [s]: on one machine both take milliseconds."""
_FURTHER_TYPES: Final = frozenset({*TRANSFORM_TYPES, STRING_TYPE, "rcl_interfaces/ParameterEvent"})
"""Message types recorded besides those of motion: transforms, robot description, controller parameters."""
_POLL_S: Final = 0.5
_ASK_S: Final = 5.0
"""Interval between requests for the list of topics [s], to find nodes that start later."""
_REPORT_S: Final = 2.0
"""Longest time between two status lines [s]."""
_DELAYS_S: Final = (0.5, 10.0)
"""First and longest delay before reconnecting [s]; each is twice the previous one."""
_MOST_BYTES: Final = 16 << 20
"""Largest frame [bytes]: motion messages have kilobytes, the topic list of a large robot a few megabytes."""
_TOO_BIG: Final = 1009
"""WebSocket close code of a frame that is too large."""
_CLOCK_NS: Final = 86_400_000_000_000
"""Largest drift of message times against the clock of this machine [ns], one day: more is another clock."""
_IN_A_ROW: Final = 20
"""Messages of another clock in a row that show that the clock was set: single ones have a wrong time."""
_MOST_SET: Final = 100
"""Largest number of files that clocks begin: a robot's clock is set once or twice."""
_LAST_NS: Final = 1 << 63
# Silences the library's log of a connection: `LiveReceiver.note` reports it in one line.
_SILENT: Final = logging.getLogger(f"{__name__}.connection")
_SILENT.disabled = True


class ReceiverOrder(msgspec.Struct):
    """Order to a receiver, in the first line of its standard input.

    Attributes:
        address: numeric address of the server.
        folder: folder of the recording.
        topics: topics to record, with types if the user gave them; empty for all topics of motion.
    """

    address: str
    folder: str
    topics: dict[str, str]


class ReceiverState(msgspec.Struct, omit_defaults=True):
    """Status line of a receiver, written every few seconds and after every change.

    Attributes:
        note: status of the connection.
        cpu_s: CPU time of the process so far.
        code, what, where, hint: the error that has ended it.
    """

    note: str = ""
    cpu_s: float = 0.0
    code: str = ""
    what: str = ""
    where: str = ""
    hint: str = ""


class LiveReceiver:
    """Receives the messages of a server and writes them until it is stopped.

    Args:
        address: address of the server.
        recording: recording to write to.
        topics: topics as in `ReceiverOrder`.
    """

    def __init__(self, address: str, recording: LiveRecording, topics: Mapping[str, str]) -> None:
        self.address, self._recording, self._topics = address, recording, topics
        self._stopping = threading.Event()
        self._protocol: LiveProtocol | None = None
        self._is_connected = False
        self._reason, self._skipped, self._why = "", 0, ""
        # Offset of the server's clock from this machine's [ns], and that of the last messages beside it.
        self._offset_ns: int | None = None
        self._other_ns, self._others = 0, 0
        self._placed, self._set = 0, 0
        self._last_note, self._reported_s = "", 0.0

    def stop(self) -> None:
        """Request `run` to return."""
        self._stopping.set()

    def note(self) -> str:
        """Status of the connection, one line."""
        if not self._is_connected:
            return f"no connection to {self.address} ({self._reason}): trying again"
        protocol = self._protocol
        parts = [f"{self.address}, {protocol.name}, {len(protocol.channels)} topics"] if protocol else []
        parts += [protocol.warning[:200]] if protocol and protocol.warning else []
        parts += [f"{self._placed} of another clock: placed by their arrival"] if self._placed else []
        parts += [f"{self._skipped} left out ({self._why})"] if self._skipped else []
        return "; ".join(parts)

    def run(self) -> None:
        """Receive messages, and reconnect after lost connections.

        Raises:
            LiveError: ``needs_live``; ``no_live_server`` at the first connection; ``not_a_live_server``.
            LogError: ``recording_unwritable``.
        """
        # A wrong address is an error at the start; later the server may disappear and return.
        held: ExitStack | None = self._connect()
        delay = _DELAYS_S[0]
        while True:
            count = self._recording.message_count
            try:
                with held or self._connect():
                    self._receive()
            except LiveError as error:
                if error.code != "no_live_server":
                    raise
                self._reason = error.what
            except _list_failures() as error:
                self._reason = _explain_end(error)
            held, self._is_connected = None, False
            # Complete the file, so that the received messages are safe if the server never returns.
            self._recording.end_part()
            self._report()
            if self._recording.message_count > count:
                delay = _DELAYS_S[0]
            if self._stopping.wait(delay):
                return
            delay = min(2.0 * delay, _DELAYS_S[1])

    def _connect(self) -> ExitStack:
        """Connect to the server; closing the returned stack closes the connection."""
        try:
            from websockets.sync.client import connect  # noqa: PLC0415 - an extra
            from websockets.typing import Subprotocol  # noqa: PLC0415 - an extra
        except ImportError as error:
            what = "watching a server needs another package"
            hint = "Install the extra `live`: pip install 'slip-pipeline[live]'"
            raise LiveError("needs_live", what, where=self.address, hint=hint) from error
        parts = urlsplit(self.address)
        try:
            with ExitStack() as stack:
                # With a connected socket, the library uses no proxy and follows no redirect.
                endpoint = (parts.hostname, parts.port)
                reached = stack.enter_context(socket.create_connection(endpoint, timeout=OPEN_S))
                reached.settimeout(None)
                self._connection: ClientConnection = stack.enter_context(
                    connect(
                        self.address,
                        sock=reached,
                        subprotocols=[Subprotocol(name) for name in FOXGLOVE_NAMES],
                        compression=None,
                        open_timeout=OPEN_S,
                        close_timeout=1.0,
                        max_size=_MOST_BYTES,
                        logger=_SILENT,
                    )
                )
                self._is_connected = True
                return stack.pop_all()
        except (ValueError, *_list_failures()) as error:
            what = f"no server answers there: {_explain_end(error)}"
            hint = "Start foxglove_bridge or rosbridge, or check the port"
            raise LiveError("no_live_server", what, where=self.address, hint=hint) from error

    def _receive(self) -> None:
        given = {topic: kind for topic, kind in self._topics.items() if kind}
        connection = self._connection
        protocol = self._protocol = choose_protocol(connection.subprotocol, self._is_wanted, given)
        begin, asked = time.monotonic(), -_ASK_S
        while not self._stopping.is_set():
            now = time.monotonic()
            if now - asked >= _ASK_S:
                asked = now
                for question in protocol.ask():
                    connection.send(question)
            if not protocol.is_recognized and now - begin > OPEN_S and not given:
                what = "the server speaks neither the Foxglove WebSocket protocol nor rosbridge with rosapi"
                hint = "Check the port; without rosapi give the topics: --topic /odom=nav_msgs/msg/Odometry"
                raise LiveError("not_a_live_server", what, where=self.address, hint=hint)
            try:
                frame = connection.recv(timeout=_POLL_S)
            except TimeoutError:
                self._recording.flush()
            else:
                self._take(protocol, frame)
            self._report()

    def _is_wanted(self, topic: str, kind: str) -> bool:
        if self._topics:
            return topic in self._topics
        return find_type(kind) != MessageType() or plain_type(kind) in _FURTHER_TYPES

    def _take(self, protocol: LiveProtocol, frame: str | bytes) -> None:
        """Answer a frame and write its message."""
        now = time.time_ns()
        try:
            answers, message = protocol.take(frame)
        except FrameError as error:
            self._leave_out(str(error))
            return
        for answer in answers:
            self._connection.send(answer)
        if message is None:
            self._recording.flush()
            return
        self._recording.write(message.channel, self._find_time(message.log_time or now, now), message.data)

    def _find_time(self, log_time: int, now: int) -> int:
        """Log time of a message [ns]: its own, or its arrival if it is not of the clock in use.

        A clock that was set begins a new file. Single messages with another time, as of a second computer,
        and times that no log can hold, are placed by their arrival.
        """
        offset = log_time - now
        if log_time < _LAST_NS:
            self._offset_ns = offset if self._offset_ns is None else self._offset_ns
            if abs(offset - self._offset_ns) <= _CLOCK_NS:
                self._others = 0
                return log_time
            self._others = self._others + 1 if abs(offset - self._other_ns) <= _CLOCK_NS else 1
            self._other_ns = offset
            if self._others >= _IN_A_ROW and self._set < _MOST_SET:
                self._recording.end_part()
                self._offset_ns, self._others, self._set = offset, 0, self._set + 1
                return log_time
        self._placed += 1
        return max(now + (self._offset_ns or 0), 0)

    def _leave_out(self, why: str) -> None:
        self._skipped += 1
        self._why = why[:200]

    def _report(self) -> None:
        """Write a status line if something has changed since the last one, or if it is due."""
        note, now = self.note(), time.monotonic()
        if note != self._last_note or now - self._reported_s > _REPORT_S:
            self._last_note, self._reported_s = note, now
            _write_state(ReceiverState(note, _measure_cpu()))


def _measure_cpu() -> float:
    return sum(os.times()[:2])


def _write_state(state: ReceiverState) -> None:
    # If the reader is gone, it has closed the input too, and that ends the process.
    with suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), msgspec.json.encode(state) + b"\n")


def _list_failures() -> tuple[type[OSError], type[WebSocketException]]:
    """Exceptions that end a connection."""
    from websockets.exceptions import WebSocketException  # noqa: PLC0415 - an extra

    return OSError, WebSocketException


def _explain_end(error: Exception) -> str:
    """Text of the reason why there is no connection."""
    from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if not isinstance(error, ConnectionClosed):
        return " ".join(str(error).split())[:200]
    if error.sent is not None and error.sent.code == _TOO_BIG:
        return f"it sent more than {_MOST_BYTES >> 20} MB at once"
    return "the server closed it" if error.rcvd is not None else "it broke off"


def main() -> int:
    """Receive as ordered by standard input, until it ends.

    The first line is a `ReceiverOrder`. Any second line ends the recording. If the input ends without one,
    the calling program has died, and the next one may continue the recording.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Unbuffered: the waiting thread would still own the lock of a buffer at exit.
    asked = os.fdopen(sys.stdin.fileno(), "rb", buffering=0, closefd=False)
    order = msgspec.json.decode(asked.readline(), type=ReceiverOrder)
    ended = threading.Event()
    try:
        recording = LiveRecording(Path(order.folder))
        receiver = LiveReceiver(order.address, recording, order.topics)

        def listen() -> None:
            if asked.readline():
                ended.set()
            receiver.stop()

        threading.Thread(target=listen, daemon=True).start()
        try:
            receiver.run()
        finally:
            if ended.is_set():
                recording.close()
            else:
                recording.end_part()
                recording.abandon()
    except SlipError as error:
        _write_state(ReceiverState("", _measure_cpu(), error.code, error.what, error.where, error.hint))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
