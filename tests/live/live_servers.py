"""Servers that play a log: Foxglove's own, one of the older protocol, and rosbridge.

`FoxgloveServer` is that of the Foxglove SDK, which `foxglove_bridge` is built on. The others are written
from the published specifications (docs/spec.md of foxglove/ws-protocol; ROSBRIDGE_PROTOCOL.md of
rosbridge_suite): what implements them needs ROS.
"""

import base64
import json
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import foxglove
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

PATIENCE_S = 90.0
"""For a program to start on a busy machine."""

Played = tuple["Schema", "Channel", "Message"]


def read_messages(log: Path) -> list[Played]:
    """All messages of a log in the order of their times."""
    with log.open("rb") as stream:
        return [(s, c, m) for s, c, m in make_reader(stream).iter_messages(log_time_order=True) if s]


def pace(messages: list[Played], speed: float) -> Iterator[Played]:
    """The messages one by one, so many times as fast as they were recorded."""
    begin, first = time.monotonic(), messages[0][2].log_time
    for played in messages:
        late = (played[2].log_time - first) * 1e-9 / speed - (time.monotonic() - begin)
        if late > 0.002:
            time.sleep(late)
        yield played


class LiveServer(Protocol):
    """What plays a log to whoever is connected."""

    @property
    def port(self) -> int: ...

    def play(self, messages: list[Played], speed: float) -> None: ...


class FoxgloveServer:
    """The server of the Foxglove SDK."""

    def __init__(self, port: int = 0) -> None:
        self._context = foxglove.Context()
        self._server = foxglove.start_server(
            host="127.0.0.1", port=port, context=self._context, message_backlog_size=100_000
        )
        self.port = self._server.port
        self._channels: dict[int, foxglove.Channel] = {}

    def advertise(self, messages: list[Played]) -> None:
        for schema, channel, _ in messages:
            if channel.id not in self._channels:
                self._channels[channel.id] = foxglove.Channel(
                    channel.topic,
                    message_encoding=channel.message_encoding,
                    schema=foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
                    context=self._context,
                )

    def wait(self) -> None:
        """Until somebody has subscribed."""
        while not any(channel.has_sinks() for channel in self._channels.values()):
            time.sleep(0.02)
        time.sleep(0.3)

    def play(self, messages: list[Played], speed: float) -> None:
        self.advertise(messages)
        self.wait()
        for _, channel, message in pace(messages, speed):
            self._channels[channel.id].log(message.data, log_time=message.log_time)

    def close(self) -> None:
        self._server.stop()


class _Written:
    """A server of this file: what it says to whoever connects is `speak`."""

    subprotocols: tuple[str, ...] = ()

    def __init__(self, port: int = 0) -> None:
        self._server: Server = serve(
            self._serve, "127.0.0.1", port, subprotocols=self.subprotocols or None, compression=None
        )
        self.port = int(self._server.socket.getsockname()[1])
        self.clients: list[ServerConnection] = []
        self.connections = 0
        self.subscribed = threading.Event()
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _serve(self, connection: ServerConnection) -> None:
        self.connections += 1
        self.clients.append(connection)
        try:
            self.speak(connection)
        except ConnectionClosed:
            pass
        finally:
            self.clients.remove(connection)

    def speak(self, connection: ServerConnection) -> None:
        connection.close()

    def send(self, frame: str | bytes) -> None:
        for client in list(self.clients):
            try:
                client.send(frame)
            except ConnectionClosed:
                continue

    def close(self) -> None:
        self._server.shutdown()
        for client in list(self.clients):
            client.close()
        self._thread.join(5.0)


class OlderFoxgloveServer(_Written):
    """`foxglove.websocket.v1`, with schemas of JSON, protobuf and CDR."""

    subprotocols = ("foxglove.websocket.v1",)

    def __init__(self, messages: list[Played], port: int = 0) -> None:
        self.channels = {channel.id: (schema, channel) for schema, channel, _ in messages}
        self.numbers: dict[int, int] = {}
        super().__init__(port)

    def speak(self, connection: ServerConnection) -> None:
        connection.send(json.dumps({"op": "serverInfo", "name": "older", "capabilities": []}))
        channels = [
            {
                "id": channel.id,
                "topic": channel.topic,
                "encoding": channel.message_encoding,
                "schemaName": schema.name,
                "schemaEncoding": schema.encoding,
                "schema": base64.b64encode(schema.data).decode()
                if schema.encoding == "protobuf"
                else schema.data.decode(),
            }
            for schema, channel in self.channels.values()
        ]
        connection.send(json.dumps({"op": "advertise", "channels": channels}))
        for frame in connection:
            asked = json.loads(frame)
            if asked["op"] == "subscribe":
                self.numbers |= {one["channelId"]: one["id"] for one in asked["subscriptions"]}
                self.subscribed.set()

    def play(self, messages: list[Played], speed: float) -> None:
        assert self.subscribed.wait(PATIENCE_S)
        for _, channel, message in pace(messages, speed):
            if channel.id in self.numbers:
                head = struct.pack("<BIQ", 1, self.numbers[channel.id], message.log_time)
                self.send(head + message.data)


class RosbridgeServer(_Written):
    """rosbridge v2.0: JSON, topics by `/rosapi/topics`."""

    def __init__(self, messages: list[Played], port: int = 0, *, has_rosapi: bool = True) -> None:
        self.types = {channel.topic: schema.name for schema, channel, _ in messages}
        self.has_rosapi = has_rosapi
        self.topics: set[str] = set()
        super().__init__(port)

    def speak(self, connection: ServerConnection) -> None:
        for frame in connection:
            asked = json.loads(frame)
            if asked["op"] == "call_service" and asked["service"] == "/rosapi/topics":
                values = {"topics": list(self.types), "types": list(self.types.values())}
                told = {"op": "service_response", "id": asked["id"], "service": asked["service"]}
                told |= (
                    {"values": values, "result": True}
                    if self.has_rosapi
                    else {"values": "Service /rosapi/topics does not exist", "result": False}
                )
                connection.send(json.dumps(told))
            elif asked["op"] == "subscribe":
                self.topics.add(asked["topic"])
                self.subscribed.set()

    def play(self, messages: list[Played], speed: float) -> None:
        assert self.subscribed.wait(PATIENCE_S)
        time.sleep(0.2)
        factory = DecoderFactory()
        for schema, channel, message in pace(messages, speed):
            if channel.topic not in self.topics:
                continue
            decode = factory.decoder_for(channel.message_encoding, schema)
            assert decode is not None
            told = {"op": "publish", "topic": channel.topic, "msg": _plain(decode(message.data))}
            self.send(json.dumps(told))


def _plain(value: object) -> object:
    """A decoded message as rosbridge writes it; what JSON has no word for is null."""
    if hasattr(value, "__slots__"):
        return {name: _plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return None if isinstance(value, float) and value != value else value  # noqa: PLR0124 - not a number


@contextmanager
def playing(server: LiveServer, messages: list[Played], speed: float) -> Iterator[threading.Thread]:
    """A server that plays in a thread of its own."""
    thread = threading.Thread(target=server.play, args=(messages, speed), daemon=True)
    thread.start()
    yield thread
    thread.join(PATIENCE_S)
