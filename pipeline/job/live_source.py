"""A live server as a recording that grows: messages are received, written, and followed like any file.

The client reaches this machine only. Receiving runs in a thread of its own, with one message in hand: what it
cannot keep up with waits at the server.
"""

from __future__ import annotations

import ipaddress
import logging
import re
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from pipeline.job.options import JobError
from pipeline.logs.growing import GrowingLog
from pipeline.logs.index import list_files
from pipeline.logs.live_protocol import FOXGLOVE_NAMES, FrameError, LiveProtocol, choose_protocol
from pipeline.logs.live_recording import LISTING, LiveRecording
from pipeline.sources.message_types import MessageType, find_type, plain_type
from pipeline.sources.topics import STRING_TYPE, TRANSFORM_TYPES

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

_SCHEME: Final = re.compile(r"(wss?):/+", re.IGNORECASE)
_DEFAULT_PORT: Final = 8765
_FURTHER_TYPES: Final = frozenset({*TRANSFORM_TYPES, STRING_TYPE, "rcl_interfaces/ParameterEvent"})
"""Beside those of motion: transforms, the robot description, what controllers are told."""
_OPEN_S: Final = 5.0
"""Longest time for a connection, and for the first answer: on one machine both take milliseconds."""
_POLL_S: Final = 0.5
_ASK_S: Final = 5.0
"""Between two questions for topics: those of nodes that start later."""
_DELAYS_S: Final = (0.5, 10.0)
"""First and longest pause before a lost server is tried again; each is twice the one before."""
_MOST_BYTES: Final = 16 << 20
"""Of one frame: messages of motion have kilobytes, the list of a large robot's topics a few megabytes."""
_TOO_BIG: Final = 1009
"""Code with which a connection is closed after a frame that is too large."""
_CLOCK_NS: Final = 86_400_000_000_000
"""A day: how far times may run from those of the first message, against the clock of this machine."""
_LAST_NS: Final = 1 << 63
_SAME_DRIVE_S: Final = 600.0
"""A recording that was not ended and is younger is gone on with: a program that was killed is started again
within minutes."""

# What the library logs of a connection is said in one line by `LiveReceiver.note`.
_SILENT: Final = logging.getLogger(f"{__name__}.connection")
_SILENT.disabled = True


@dataclass(frozen=True)
class LiveAddress:
    """Where a server listens on this machine.

    Attributes:
        host: numeric address.
        port: of the server.
        path: behind it.
    """

    host: str
    port: int
    path: str

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"ws://{host}:{self.port}{self.path}"


def parse_address(text: str) -> LiveAddress | None:
    """The server of an address such as ``ws://127.0.0.1:8765``; None where the text is a path.

    Args:
        text: as given; a slash that `Path` has taken from it need not be there.

    Raises:
        JobError: ``bad_address``; ``not_this_machine``.
    """
    found = _SCHEME.match(text)
    if found is None:
        return None
    hint = "Give one such as ws://127.0.0.1:8765"
    try:
        parts = urlsplit(f"{found[1].lower()}://{text[found.end() :]}")
        name, port = parts.hostname or "", parts.port or _DEFAULT_PORT
    except ValueError as error:
        raise JobError("bad_address", f"that is no address ({error})", where=text, hint=hint) from error
    if parts.scheme == "wss" or parts.username or parts.query or parts.fragment or not name:
        what = "only a plain address can be watched: ws://, a host and a port"
        raise JobError("bad_address", what, where=text, hint=hint)
    # On the other address of that name somebody else may listen.
    host = "127.0.0.1" if name == "localhost" else name
    try:
        is_here = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_here = False
    if not is_here:
        what = "only a server on this machine is watched: the connection has no password and no encryption"
        tunnel = f"ssh -L {port}:127.0.0.1:{port} {name}"
        hint = f"Fetch its port here with `{tunnel}`, then watch ws://127.0.0.1:{port}"
        raise JobError("not_this_machine", what, where=text, hint=hint)
    return LiveAddress(host, port, parts.path or "/")


def name_folder(address: LiveAddress, parent: Path) -> Path:
    """The folder of a recording: one that a killed program left a moment ago, or a new one by date."""
    begin = f"live_{address.port}_"
    left = [
        folder
        for folder in parent.glob(f"{begin}*")
        if folder.is_dir() and not (folder / LISTING).exists() and _measure_age(folder) < _SAME_DRIVE_S
    ]
    if left:
        return max(left, key=lambda folder: folder.name)
    return parent / f"{begin}{time.strftime('%Y_%m_%d-%H_%M_%S')}"


def _measure_age(folder: Path) -> float:
    """Seconds since a file of a recording was written to; those since the beginning of time without any."""
    newest = max((file.stat().st_mtime for file in list_files(folder)), default=0.0)
    return time.time() - newest


def parse_topics(texts: Sequence[str]) -> dict[str, str]:
    """Types by topic of `--topic NAME` or `--topic NAME=TYPE`; an empty type is asked of the server."""
    return {topic: kind for topic, _, kind in (text.partition("=") for text in texts)}


class LiveReceiver(threading.Thread):
    """Receives the messages of a server and writes them, over lost connections, until it is stopped.

    Args:
        address: of the server.
        recording: where messages go.
        topics: what to record, of `parse_topics`; everything that speaks of motion where it is empty.

    Raises:
        JobError: ``needs_live``, the extra is not installed; ``no_live_server``.
    """

    def __init__(self, address: LiveAddress, recording: LiveRecording, topics: dict[str, str]) -> None:
        super().__init__(daemon=True, name="live receiver")
        self.address, self._recording, self._topics = address, recording, topics
        self.error: BaseException | None = None
        self._protocol: LiveProtocol | None = None
        self._reason, self._left_out, self._why = "", 0, ""
        # Between the server's clock and this machine's, told by the first message [ns].
        self._offset_ns: int | None = None
        self._stopping = threading.Event()
        # A wrong address is said at once; later the server may come and go.
        self._connection: ClientConnection | None = None
        self._held: ExitStack | None = self._connect()

    def note(self) -> str:
        """How it stands with the server, one line."""
        if self._connection is None:
            return f"no connection to {self.address} ({self._reason}): trying again"
        protocol = self._protocol
        told = [f"{self.address}, {protocol.name}, {len(protocol.channels)} topics"] if protocol else []
        told += [protocol.warning[:200]] if protocol and protocol.warning else []
        told += [f"{self._left_out} left out ({self._why})"] if self._left_out else []
        return "; ".join(told)

    def _is_wanted(self, topic: str, kind: str) -> bool:
        if self._topics:
            return topic in self._topics
        return find_type(kind) != MessageType() or plain_type(kind) in _FURTHER_TYPES

    def _connect(self) -> ExitStack:
        try:
            from websockets.exceptions import WebSocketException  # noqa: PLC0415 - an extra
            from websockets.sync.client import connect  # noqa: PLC0415 - an extra
            from websockets.typing import Subprotocol  # noqa: PLC0415 - an extra
        except ImportError as error:
            what = "watching a server needs another package"
            hint = "Install the extra `live`: pip install 'slip-pipeline[live]'"
            raise JobError("needs_live", what, where=str(self.address), hint=hint) from error
        hint = (
            "Start `ros2 launch foxglove_bridge foxglove_bridge_launch.xml` or rosbridge, or check the port"
        )
        try:
            with ExitStack() as stack:
                # With a socket that is connected, the library asks no proxy and follows no redirect.
                place = (self.address.host, self.address.port)
                reached = stack.enter_context(socket.create_connection(place, timeout=_OPEN_S))
                reached.settimeout(None)
                self._connection = stack.enter_context(
                    connect(
                        str(self.address),
                        sock=reached,
                        subprotocols=[Subprotocol(name) for name in FOXGLOVE_NAMES],
                        compression=None,
                        open_timeout=_OPEN_S,
                        close_timeout=1.0,
                        max_size=_MOST_BYTES,
                        logger=_SILENT,
                    )
                )
                return stack.pop_all()
        except (OSError, ValueError, WebSocketException) as error:
            why = error.strerror if isinstance(error, OSError) else None
            what = f"no server answers there: {why or ' '.join(str(error).split())[:200]}"
            raise JobError("no_live_server", what, where=str(self.address), hint=hint) from error

    def run(self) -> None:
        """Receive until `stop`; what ends it is kept in `error`."""
        try:
            self._receive_always()
        except BaseException as error:  # noqa: BLE001 - raised again where the recording is followed
            self.error = error

    def _receive_always(self) -> None:
        from websockets.exceptions import WebSocketException  # noqa: PLC0415 - an extra

        delay = _DELAYS_S[0]
        while True:
            count = self._recording.message_count
            try:
                with self._held or self._connect():
                    self._receive()
            except (JobError, OSError, WebSocketException) as error:
                if isinstance(error, JobError) and error.code != "no_live_server":
                    raise
                self._reason = error.what if isinstance(error, JobError) else _explain_end(error)
            finally:
                self._connection = self._held = None
            # Whole files stand for what was received, whatever becomes of the server.
            self._recording.end_part()
            if self._recording.message_count > count:
                delay = _DELAYS_S[0]
            if self._stopping.wait(delay):
                return
            delay = min(2.0 * delay, _DELAYS_S[1])

    def _receive(self) -> None:
        connection = self._connection
        if connection is None:
            return
        given = {topic: kind for topic, kind in self._topics.items() if kind}
        protocol = self._protocol = choose_protocol(connection.subprotocol, self._is_wanted, given)
        begin, asked = time.monotonic(), 0.0
        while not self._stopping.is_set():
            now = time.monotonic()
            if not asked or now - asked > _ASK_S:
                asked = now
                for question in protocol.ask():
                    connection.send(question)
            if not protocol.is_recognized and not protocol.channels and now - begin > _OPEN_S:
                what = "the server speaks neither the Foxglove WebSocket protocol nor rosbridge with rosapi"
                hint = "Check the port; without rosapi give the topics: --topic /odom=nav_msgs/msg/Odometry"
                raise JobError("not_a_live_server", what, where=str(self.address), hint=hint)
            try:
                frame = connection.recv(timeout=_POLL_S)
            except TimeoutError:
                self._recording.flush()
                continue
            self._take(connection, protocol, frame)

    def _take(self, connection: ClientConnection, protocol: LiveProtocol, frame: str | bytes) -> None:
        """Answer a frame and write the message in it."""
        try:
            answers, message = protocol.take(frame)
        except FrameError as error:
            self._leave_out(str(error))
            return
        for answer in answers:
            connection.send(answer)
        if message is None:
            self._recording.flush()
            return
        now = time.time_ns()
        log_time = message.log_time or now
        if self._offset_ns is None and log_time < _LAST_NS:
            self._offset_ns = log_time - now
        if log_time >= _LAST_NS or abs(log_time - now - (self._offset_ns or 0)) > _CLOCK_NS:
            self._leave_out("a time that is more than a day from those before")
            return
        self._recording.write(message.channel, log_time, message.data)

    def _leave_out(self, why: str) -> None:
        self._left_out += 1
        self._why = why[:200]

    def stop(self) -> None:
        """Receive no more, and put an end to the recording.

        Raises:
            LogError: ``recording_unwritable``.
        """
        self._stopping.set()
        if self.is_alive():
            self.join(_OPEN_S + _DELAYS_S[0])
        self._recording.close()


def _explain_end(error: Exception) -> str:
    """Why a connection ended, in words."""
    from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

    if not isinstance(error, ConnectionClosed):
        return " ".join(str(error).split())[:200]
    if error.sent is not None and error.sent.code == _TOO_BIG:
        return f"it sent more than {_MOST_BYTES >> 20} MB at once"
    return "the server closed it" if error.rcvd is not None else "it broke off"


class LiveLog(GrowingLog):
    """The recording of a receiver, followed while it is written.

    Args:
        path: folder of the recording.
        receiver: writes it.
        quiet_s: a server that sends nothing for so long after the start is an error [s].
    """

    def __init__(self, path: Path, receiver: LiveReceiver, quiet_s: float) -> None:
        super().__init__(path)
        self._receiver, self._quiet_s = receiver, quiet_s
        self._begin = time.monotonic()

    def update(self) -> bool:
        """Walk what was added since the last time; whether anything was.

        Raises:
            SlipError: what has ended the receiver.
            JobError: ``nothing_received``.
        """
        if self._receiver.error is not None:
            raise self._receiver.error
        if list_files(self.path):
            return super().update()
        if time.monotonic() - self._begin > self._quiet_s:
            what = f"it sent no message of motion for {self._quiet_s:g} s ({self._receiver.note()})"
            hint = "Start the robot's nodes, name topics with --topic, or wait longer with --for SECONDS"
            raise JobError("nothing_received", what, where=str(self._receiver.address), hint=hint)
        return False

    @property
    def is_closed(self) -> bool:
        """Never: a server that is silent may speak again."""
        return False

    @property
    def note(self) -> str:
        """How it stands with the server."""
        return self._receiver.note()


@contextmanager
def receive_live(
    address: LiveAddress, folder: Path | None, topics: Sequence[str], quiet_s: float
) -> Iterator[LiveLog]:
    """Receive from a server as long as the block runs; its recording is whole afterwards.

    Args:
        address: of `parse_address`.
        folder: of the recording; None for `name_folder` in the current folder.
        topics: of `parse_topics`; none for everything that speaks of motion.
        quiet_s: see `LiveLog`.

    Raises:
        LogError: ``recording_unwritable``, ``recording_ended``.
        JobError: as `LiveReceiver`.
    """
    recording = LiveRecording(folder or name_folder(address, Path()))
    try:
        receiver = LiveReceiver(address, recording, parse_topics(topics))
    except BaseException:
        recording.abandon()
        raise
    receiver.start()
    try:
        yield LiveLog(recording.folder, receiver, quiet_s)
    finally:
        receiver.stop()
