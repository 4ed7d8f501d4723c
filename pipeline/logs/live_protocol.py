"""Messages of a live server: the Foxglove WebSocket protocol and rosbridge.

Each protocol converts the frames of a server to messages with their channels, and returns the frames to send
back. It opens no connection and knows no message type: the caller selects the topics.

Sources: the specification of `foxglove.websocket.v1` (docs/spec.md of foxglove/ws-protocol), whose
advertisements, subscriptions and message data are the same in `foxglove.sdk.v1`; the rosbridge v2.0 protocol
(ROSBRIDGE_PROTOCOL.md of RobotWebTools/rosbridge_suite).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol, TypeVar

import msgspec

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


class LiveProtocol(Protocol):
    """Interface of both protocols.

    Attributes:
        name: display name.
        channels: subscribed channels.
        is_recognized: whether the server has sent a frame that only this protocol has.
        warning: last error reported by the server; empty if there is none.
    """

    name: str
    is_recognized: bool
    warning: str

    @property
    def channels(self) -> list[LiveChannel]:
        """Subscribed channels."""
        ...

    def ask(self) -> list[str]:
        """Frames that request the server's topics; sent first, and again every few seconds."""
        ...

    def take(self, frame: str | bytes) -> tuple[list[str], LiveMessage | None]:
        """Process a frame; returns the frames to answer with, and the message in it.

        Raises:
            FrameError: it does not conform to the protocol.
        """
        ...


def choose_protocol(
    subprotocol: str | None, is_wanted: Callable[[str, str], bool], given: Mapping[str, str]
) -> LiveProtocol:
    """Protocol of a server.

    Args:
        subprotocol: selection of the server from `FOXGLOVE_NAMES`; None if it selected none.
        is_wanted: whether a topic is recorded, by its name and type.
        given: types by topic as given by the user.
    """
    return Foxglove(is_wanted) if subprotocol in FOXGLOVE_NAMES else Rosbridge(is_wanted, given)


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


@dataclass
class Foxglove:
    """A client of a Foxglove server; a subscription has the id of its channel."""

    is_wanted: Callable[[str, str], bool]
    name: str = "Foxglove WebSocket"
    is_recognized: bool = False
    warning: str = ""
    _subscribed: dict[int, LiveChannel] = field(default_factory=dict)

    @property
    def channels(self) -> list[LiveChannel]:
        """Subscribed channels."""
        return list(self._subscribed.values())

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
            raise FrameError("a message without a head")
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


@dataclass
class Rosbridge:
    """A client of a rosbridge server; topics come from `/rosapi/topics` or are given with their types."""

    is_wanted: Callable[[str, str], bool]
    given: Mapping[str, str]
    name: str = "rosbridge"
    is_recognized: bool = False
    warning: str = ""
    _subscribed: dict[str, LiveChannel] = field(default_factory=dict)

    @property
    def channels(self) -> list[LiveChannel]:
        """Subscribed channels."""
        return list(self._subscribed.values())

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
