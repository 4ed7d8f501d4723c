"""Messages of a live server, and the recording that is written while they arrive.

Each protocol, the Foxglove WebSocket protocol and rosbridge, converts the frames of a server to messages with
their channels, and returns the frames to send back. It opens no connection and knows no message type: the
caller selects the topics. The recording is a folder of MCAP files, like a split rosbag2 recording.

Sources: the specification of `foxglove.websocket.v1` (docs/spec.md of foxglove/ws-protocol), whose
advertisements, subscriptions and message data are the same in `foxglove.sdk.v1`; the rosbridge v2.0 protocol
(ROSBRIDGE_PROTOCOL.md of RobotWebTools/rosbridge_suite).
"""

import base64
import binascii
import fcntl
import json
import os
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, ClassVar, Final, TypeVar

import msgspec
from mcap.writer import CompressionType, Writer

from pipeline.core import naming_os_errors
from pipeline.logs.index import LISTING, LogIndex, list_files, open_log
from pipeline.logs.records import LogError
from pipeline.logs.writer import LIBRARY

FOXGLOVE_NAMES: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Subprotocols of a Foxglove server, newest first; a rosbridge server selects none."""

MOST_TOPICS: Final = 200
"""Maximum number of recorded topics: a robot's motion has about a dozen; a server may list any number."""

_MESSAGE_DATA: Final = 1
_HEAD: Final = struct.Struct("<BIQ")
_BINARY_SCHEMAS: Final = frozenset({"protobuf", "flatbuffer"})
_USUAL_SCHEMAS: Final = {"json": "jsonschema", "protobuf": "protobuf", "ros1": "ros1msg", "cdr": "ros2msg"}
_ROSAPI: Final = "/rosapi/topics"
_QUEUE: Final = 100
"""Length of the queue of a topic in rosbridge for a slow reader [messages]."""

_Kind = TypeVar("_Kind")


class FrameError(ValueError):
    """A frame that does not conform to the protocol."""


@dataclass(frozen=True)
class LiveChannel:
    """A topic as described by its server.

    Attributes:
        topic: name of the topic.
        type_name: message type.
        encoding: message encoding: ``cdr``, ``json``, ``protobuf``, ``ros1``.
        schema_encoding: ``ros2msg``, ``jsonschema``, ``protobuf``, ...
        schema: definition of the type.
    """

    topic: str
    type_name: str
    encoding: str
    schema_encoding: str
    schema: bytes


@dataclass(frozen=True)
class LiveMessage:
    """One message; `log_time` [ns] is the time of recording by the server, 0 if not stated."""

    channel: LiveChannel
    log_time: int
    data: bytes


@dataclass(kw_only=True)
class LiveProtocol(ABC):
    """What the clients of both protocols share.

    Attributes:
        name: display name.
        is_wanted: whether a topic is recorded, by its name and type.
        is_recognized: whether the server has sent a frame that only this protocol has.
        warning: last error reported by the server; empty if there is none.
    """

    name: ClassVar[str]
    is_wanted: Callable[[str, str], bool]
    is_recognized: bool = False
    warning: str = ""
    _subscribed: dict[Hashable, LiveChannel] = field(default_factory=dict)

    @property
    def channels(self) -> list[LiveChannel]:
        """Subscribed channels."""
        return list(self._subscribed.values())

    @abstractmethod
    def ask(self) -> list[str]:
        """Frames that request the server's topics; sent first, and again every few seconds."""

    @abstractmethod
    def take(self, frame: str | bytes) -> tuple[list[str], LiveMessage | None]:
        """Process a frame; returns the frames to answer with, and the message in it.

        Raises:
            FrameError: it does not conform to the protocol.
        """


def choose_protocol(
    subprotocol: str | None, is_wanted: Callable[[str, str], bool], given: Mapping[str, str]
) -> LiveProtocol:
    """Protocol of a server.

    Args:
        subprotocol: selection of the server from `FOXGLOVE_NAMES`; None if it selected none.
        is_wanted: whether a topic is recorded, by its name and type.
        given: types by topic as given by the user.
    """
    if subprotocol in FOXGLOVE_NAMES:
        return Foxglove(is_wanted=is_wanted)
    return Rosbridge(is_wanted=is_wanted, given=given)


class _Advertised(msgspec.Struct, rename="camel"):
    id: int
    topic: str
    encoding: str
    schema_name: str = ""
    schema_encoding: str = ""
    schema: str = ""


class _FoxgloveText(msgspec.Struct, rename="camel"):
    """Text frame of a server; `channels` is set in an advertisement."""

    op: str
    channels: msgspec.Raw = msgspec.Raw(b"[]")
    channel_ids: msgspec.Raw = msgspec.Raw(b"[]")
    level: object = None
    message: object = None


@dataclass(kw_only=True)
class Foxglove(LiveProtocol):
    """A client of a Foxglove server; a subscription has the id of its channel."""

    name = "Foxglove WebSocket"

    def ask(self) -> list[str]:
        """No frames: the server advertises its topics without a request."""
        return []

    def take(self, frame: str | bytes) -> tuple[list[str], LiveMessage | None]:
        """Process a frame; returns the frames to answer with, and the message in it.

        Raises:
            FrameError: it does not conform to the protocol.
        """
        if isinstance(frame, bytes):
            return [], self._take_data(frame)
        text = _decode(frame, _FoxgloveText)
        self.is_recognized = True
        if text.op == "advertise":
            return self._subscribe(_decode(bytes(text.channels), list[_Advertised])), None
        if text.op == "unadvertise":
            for number in _decode(bytes(text.channel_ids), list[int]):
                self._subscribed.pop(number, None)
        if text.op == "status" and text.level in {1, 2}:
            self.warning = str(text.message)
        return [], None

    def _take_data(self, frame: bytes) -> LiveMessage | None:
        if not frame:
            raise FrameError("an empty frame")
        if frame[0] != _MESSAGE_DATA:
            # Times, services and assets, which are not requested.
            return None
        if len(frame) < _HEAD.size:
            raise FrameError("a message without a header")
        _, number, log_time = _HEAD.unpack_from(frame)
        channel = self._subscribed.get(number)
        # Messages of a topic that was just unadvertised may still arrive.
        return None if channel is None else LiveMessage(channel, log_time, frame[_HEAD.size :])

    def _subscribe(self, advertised: list[_Advertised]) -> list[str]:
        fresh = []
        for one in advertised:
            if one.id in self._subscribed or not self.is_wanted(one.topic, one.schema_name):
                continue
            if not 0 <= one.id < 1 << 32 or len(self._subscribed) >= MOST_TOPICS:
                continue
            self._subscribed[one.id] = _describe_channel(one)
            fresh.append({"id": one.id, "channelId": one.id})
        return [json.dumps({"op": "subscribe", "subscriptions": fresh})] if fresh else []


def _describe_channel(one: _Advertised) -> LiveChannel:
    kind = one.schema_encoding or _USUAL_SCHEMAS.get(one.encoding, "")
    try:
        data = base64.b64decode(one.schema, validate=True) if kind in _BINARY_SCHEMAS else one.schema.encode()
    except (binascii.Error, UnicodeEncodeError) as error:
        raise FrameError(f"the schema of {one.topic[:100]!r} cannot be read") from error
    return LiveChannel(one.topic, one.schema_name, one.encoding, kind, data)


class _RosbridgeText(msgspec.Struct):
    """Text frame of a server; a message stays raw JSON."""

    op: str
    topic: str = ""
    msg: msgspec.Raw = msgspec.Raw(b"")
    service: str = ""
    values: msgspec.Raw = msgspec.Raw(b"{}")
    result: object = None
    level: object = None


class _Topics(msgspec.Struct):
    topics: list[str]
    types: list[str]


@dataclass(kw_only=True)
class Rosbridge(LiveProtocol):
    """A client of a rosbridge server; topics come from `/rosapi/topics` or are given with their types."""

    name = "rosbridge"
    given: Mapping[str, str]

    def ask(self) -> list[str]:
        """Frames that subscribe to the given topics and request the list of topics, which may have grown."""
        return [
            *self._subscribe(self.given),
            json.dumps({"op": "call_service", "service": _ROSAPI, "id": _ROSAPI}),
        ]

    def take(self, frame: str | bytes) -> tuple[list[str], LiveMessage | None]:
        """Process a frame; returns the frames to answer with, and the message in it.

        Raises:
            FrameError: it does not conform to the protocol.
        """
        text = _decode(frame, _RosbridgeText)
        if text.op == "publish":
            self.is_recognized = True
            channel = self._subscribed.get(text.topic)
            return [], None if channel is None else LiveMessage(channel, 0, bytes(text.msg))
        if text.op == "service_response" and text.service == _ROSAPI:
            self.is_recognized = True
            if text.result is False:
                self.warning = f"it has no {_ROSAPI}: start rosapi with it, or give --topic NAME=TYPE"
                return [], None
            listed = _decode(bytes(text.values), _Topics)
            pairs = zip(listed.topics, listed.types, strict=False)
            return self._subscribe({t: k for t, k in pairs if self.is_wanted(t, k)}), None
        if text.op == "status" and text.level == "error":
            self.is_recognized = True
            self.warning = bytes(text.msg).decode("utf-8", "replace").strip('"')
        return [], None

    def _subscribe(self, types: Mapping[str, str]) -> list[str]:
        asked = []
        for topic, kind in types.items():
            if topic in self._subscribed or len(self._subscribed) >= MOST_TOPICS:
                continue
            self._subscribed[topic] = LiveChannel(topic, kind, "json", "jsonschema", b'{"type":"object"}')
            content = {"op": "subscribe", "topic": topic, "type": kind, "queue_length": _QUEUE}
            asked.append(json.dumps(content))
        return asked


def _decode(content: str | bytes, kind: type[_Kind]) -> _Kind:
    try:
        return msgspec.json.decode(content, type=kind)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise FrameError(f"a text outside the protocol ({error})") from error


_CHUNK_S: Final = 1.0
"""Maximum time of a message in memory [s]: the loss of a killed program, and the delay of a watch."""
_CHUNK_BYTES: Final = 1 << 20


class _Writer(Writer):
    """An MCAP writer that can end a chunk before it is full."""

    def end_chunk(self) -> None:
        """Write the messages so far as a chunk.

        The called method is private to the base class. Its mangled name is the same here, because mangling
        drops the leading underscore of a class name.
        """
        self.__finalize_chunk()  # type: ignore[no-untyped-call]


@dataclass
class _Part:
    """One file that is being written.

    Attributes:
        stream: the file.
        writer: MCAP writer of the file.
        numbers: channel numbers in the file.
        start_s: start of the current chunk [s of `time.monotonic`].
        waiting: number of messages in that chunk.
    """

    stream: BinaryIO
    writer: _Writer
    numbers: dict[LiveChannel, int] = field(default_factory=dict)
    start_s: float = field(default_factory=time.monotonic)
    waiting: int = 0


def lock_folder(folder: Path) -> int | None:
    """Lock a folder for one writer; returns the file descriptor of the lock, None if it is already locked.

    Raises:
        OSError: the folder cannot be opened, or its file system has no locks.
    """
    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(number)
        return None
    except OSError:
        os.close(number)
        raise
    return number


class LiveRecording:
    """Writes messages to a folder of MCAP files, one per connection to a server.

    A file grows at least every `_CHUNK_S`, so that a reader can follow it. Files of a killed program stay
    unchanged in the folder; the next file continues the recording.

    Args:
        folder: created if it does not exist.

    Raises:
        LogError: ``recording_unwritable``; ``recording_ended``, the folder has a finished recording;
            ``recording_in_use``, another program writes to it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.message_count = 0
        self._part: _Part | None = None
        if (folder / LISTING).exists():
            hint = "Name another folder with --record"
            raise LogError("recording_ended", "this recording has ended", where=str(folder), hint=hint)
        with self._naming_os_errors():
            folder.mkdir(parents=True, exist_ok=True)
            lock = lock_folder(folder)
        if lock is None:
            hint = "End the other watch, or name another folder with --record"
            raise LogError("recording_in_use", "another watch writes there", where=str(folder), hint=hint)
        # The lock is held until this process ends, even if it is killed.
        self._lock = lock

    def _naming_os_errors(self) -> AbstractContextManager[None]:
        what = "the recording cannot be written"
        hint = "Check the folder, its permissions and the space on the disk; what was written before is kept"
        return naming_os_errors(LogError, "recording_unwritable", what, where=self.folder, hint=hint)

    def write(self, channel: LiveChannel, log_time: int, data: bytes) -> None:
        """Add a message.

        Args:
            channel: channel of the message.
            log_time: [ns].
            data: payload as sent by the server.

        Raises:
            LogError: ``recording_unwritable``.
        """
        with self._naming_os_errors():
            part = self._part = self._part or self._begin_part()
            number = part.numbers.get(channel)
            if number is None:
                kind = part.writer.register_schema(channel.type_name, channel.schema_encoding, channel.schema)
                number = part.writer.register_channel(channel.topic, channel.encoding, kind)
                part.numbers[channel] = number
            part.writer.add_message(number, log_time, data, log_time)
        part.waiting += 1
        self.message_count += 1
        self.flush()

    def _begin_part(self) -> _Part:
        name = self.folder.resolve().name
        count = len(list_files(self.folder))
        stream = (self.folder / f"{name}_{count}.mcap").open("xb")
        writer = _Writer(
            stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        writer.start(profile="ros2", library=LIBRARY)
        return _Part(stream, writer)

    def flush(self) -> None:
        """Write the current chunk if it is at least `_CHUNK_S` old.

        Raises:
            LogError: ``recording_unwritable``.
        """
        part = self._part
        if part is None or not part.waiting or time.monotonic() - part.start_s < _CHUNK_S:
            return
        with self._naming_os_errors():
            part.writer.end_chunk()
            part.stream.flush()
        part.start_s, part.waiting = time.monotonic(), 0

    def end_part(self) -> None:
        """Finish the current file; the next message starts another.

        Raises:
            LogError: ``recording_unwritable``.
        """
        part, self._part = self._part, None
        if part is None:
            return
        with self._naming_os_errors(), part.stream:
            part.writer.finish()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Finish the recording; a folder without messages is removed.

        Raises:
            LogError: ``recording_unwritable``.
        """
        self.end_part()
        if not list_files(self.folder):
            self.abandon()
            return
        listing = _spell_listing(open_log(self.folder, is_one=True), list_files(self.folder))
        with self._naming_os_errors():
            (self.folder / LISTING).write_text(listing, encoding="utf-8")

    def abandon(self) -> None:
        """Remove the folder if it is empty."""
        with suppress(OSError):
            self.folder.rmdir()


def _spell_listing(index: LogIndex, files: list[Path]) -> str:
    """Text of the rosbag2 metadata file, version 4, as `ros2 bag play` requires it."""
    import yaml  # noqa: PLC0415 - once, at the end

    topics = [
        {
            "topic_metadata": {
                "name": channel.topic,
                "type": channel.type_name,
                "serialization_format": channel.message_encoding,
                "offered_qos_profiles": "",
            },
            "message_count": channel.message_count,
        }
        for channel in index.channels
    ]
    about = {
        "version": 4,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name for file in files],
        "duration": {"nanoseconds": index.end_ns - index.start_ns},
        "starting_time": {"nanoseconds_since_epoch": index.start_ns},
        "message_count": index.message_count,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
    }
    text: str = yaml.safe_dump({"rosbag2_bagfile_information": about}, sort_keys=False, allow_unicode=True)
    return text
