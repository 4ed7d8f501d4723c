"""Small logs, their truth, and the official reader, for the tests of the room."""

# ruff: noqa: ANN401 - columns and messages come in many shapes
from __future__ import annotations

import io
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2._vendor.rosidl_adapter.parser import is_valid_message_name
from mcap_ros2.decoder import DecoderFactory

from pipeline.logs import (
    LogData,
    LogError,
    Ragged,
    RaggedStrings,
    Strings,
    Wanted,
    definition_text,
    open_log,
    read_topics,
)
from pipeline.logs.schema import parse_msg
from pipeline.logs.writer import LogWriter, encode_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mcap.records import McapRecord, Schema

SHARED = Path(__file__).parents[2] / ".." / "shared"
START = 1_700_000_000_000_000_000
FLOAT = "std_msgs/msg/Float64"
JOINTS = "sensor_msgs/msg/JointState"
TEXT = "std_msgs/msg/String"

Truth = dict[tuple[str, int], object]


def payloads(
    type_name: str, rows: int, fields: Mapping[str, Any], definition: str | None = None
) -> list[bytes]:
    """Serialized messages of a type."""
    text = definition or definition_text(type_name)
    assert text is not None
    found = [b""] * rows
    for chosen, block in encode_rows(parse_msg(type_name, text), rows, fields, where=type_name):
        for row, payload in zip(chosen.tolist(), block, strict=True):
            found[row] = payload.tobytes()
    return found


def small_truth(rows: int = 60) -> tuple[dict[str, tuple[str, np.ndarray, dict[str, Any]]], Truth]:
    """Three topics with values that differ everywhere, and what a reader must return for each message."""
    time = START + np.arange(rows) * 10_000_000
    number = np.arange(rows)
    joints = {
        "name": ["left", "right"],
        "velocity": np.stack((np.sqrt(number + 2.0), np.exp(-0.1 * number)), axis=1),
        "header.frame_id": [f"frame{row % 3}" for row in range(rows)],
    }
    texts = [f"state {row} {'x' * (row % 7)}" for row in range(rows)]
    topics: dict[str, tuple[str, np.ndarray, dict[str, Any]]] = {
        "/speed": (FLOAT, time, {"data": np.sin(number + 0.5)}),
        "/joints": (JOINTS, time + 1, joints),
        "/state": (TEXT, time + 2, {"data": texts}),
    }
    truth: Truth = {}
    for row in range(rows):
        truth["/speed", int(time[row])] = float(np.sin(row + 0.5))
        velocity = tuple(joints["velocity"][row].tolist())
        truth["/joints", int(time[row]) + 1] = (("left", "right"), velocity, f"frame{row % 3}")
        truth["/state", int(time[row]) + 2] = texts[row]
    return topics, truth


def write_small(path: Path, *, rows: int = 60, chunk_size: int = 700, compression: str = "zstd") -> Truth:
    """Write the small log with our writer."""
    topics, truth = small_truth(rows)
    with LogWriter(path, chunk_size=chunk_size, compression=compression) as writer:
        writer.metadata("deployment", {"vehicle": "husky_a200"})
        for topic, (kind, time, fields) in topics.items():
            writer.write_columns(topic, kind, time, fields)
    return truth


def write_official(path: Path, *, rows: int = 60, **options: Any) -> Truth:
    """Write the small log with the official writer."""
    topics, truth = small_truth(rows)
    defaults: dict[str, Any] = {"compression": CompressionType.ZSTD, "chunk_size": 700}
    with path.open("wb") as stream:
        writer = Writer(stream, **(defaults | options))
        writer.start(profile="ros2", library="test")
        messages = []
        for topic, (kind, time, fields) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", (definition_text(kind) or "").encode())
            channel = writer.register_channel(topic, "cdr", schema)
            encoded = payloads(kind, time.size, fields)
            messages += [(int(t), channel, p) for t, p in zip(time, encoded, strict=True)]
        for number, (time_ns, channel, payload) in enumerate(sorted(messages)):
            writer.add_message(channel, time_ns, payload, time_ns, number)
        writer.finish()
    return truth


WITHOUT_INDEX = IndexType.NONE


def read_small(path: Path) -> tuple[LogData, Truth]:
    """Read every topic of a (damaged) small log: what came out, in the form of the truth."""
    index = open_log(path)
    data = read_topics(index, [Wanted(topic) for topic in index.topics()], threads=1, sha256="-")
    found: Truth = {}
    for columns in data.topics:
        for row, time in enumerate(columns.log_time.tolist()):
            found[columns.topic, time] = value_of(columns.fields, row)
    return data, found


Channel = tuple[str, str, str, bytes, str, list[bytes]]
"""Topic, type, encoding of the schema, schema, encoding of the messages, payloads."""

CHUNK = 6
CODES = {"log_empty", "not_mcap"}


def chunk_places(content: bytes) -> list[tuple[int, int]]:
    """Where every chunk of a whole file starts and ends."""
    starts = record_starts(content)
    return [(a, b) for a, b in pairwise(starts) if content[a] == CHUNK]


def read_damaged(path: Path, content: bytes, truth: Truth) -> tuple[Truth, list[str]]:
    """What comes out of damaged bytes; everything of it must be true."""
    path.write_bytes(content)
    try:
        data, found = read_small(path)
    except LogError as error:
        if error.code not in CODES:
            raise
        return {}, [error.code]
    wrong = {key: value for key, value in found.items() if truth.get(key) != value}
    assert not wrong
    return found, [loss.kind for loss in data.losses]


def value_of(fields: Mapping[str, Any], row: int) -> object:
    """One message in the form of the truth."""
    data = fields.get("data")
    if isinstance(data, Strings):
        return data.values[data.codes[row]]
    if data is not None:
        return float(data[row])
    names, velocity, frame = fields["name"], fields["velocity"], fields["header.frame_id"]
    return tuple(names.row(row)), tuple(velocity.row(row).tolist()), frame.values[frame.codes[row]]


def value_in_full(fields: Mapping[str, Any], row: int) -> object:
    """Every field of one message, whatever its type."""
    found = []
    for name, column in sorted(fields.items()):
        if isinstance(column, Strings):
            value: object = column.values[column.codes[row]] if column.codes[row] >= 0 else None
        elif isinstance(column, RaggedStrings):
            value = tuple(column.row(row))
        elif isinstance(column, Ragged):
            value = column.row(row).tobytes()
        else:
            value = np.asarray(column[row]).tobytes()
        found.append((name, value))
    return tuple(found)


def records_of(content: bytes) -> list[McapRecord]:
    """Every record of a whole file, chunks kept."""
    return list(StreamReader(io.BytesIO(content), emit_chunks=True).records)


def record_starts(content: bytes) -> list[int]:
    """Where every top-level record of a whole file starts, and where the last ends."""
    starts, place = [], 8
    while place < len(content) - 8:
        starts.append(place)
        place += 9 + int.from_bytes(content[place + 1 : place + 9], "little")
    return [*starts, place]


class OfficialDecoder(DecoderFactory):
    """The official decoder, which is given a name of ROS 2 where a type of ROS 1 has none: fields stay."""

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        if schema is not None and not is_ros2_name(schema.name):
            schema = replace(schema, name=f"{schema.name.rpartition('/')[0]}/Renamed")
        return super().decoder_for(message_encoding, schema)


def is_ros2_name(type_name: str) -> bool:
    """Whether ROS 2 takes the name of a message type; ROS 1 takes small letters and underscores as well."""
    return bool(is_valid_message_name(type_name.rpartition("/")[2]))


def assert_equals_official(path: Path) -> int:
    """Compare every field of every message with mcap + mcap-ros2-support; the count of messages."""
    index = open_log(path)
    data = read_topics(index, [Wanted(topic) for topic in index.topics()])
    reference: dict[int, list[tuple[int, int, Any]]] = {}
    with path.open("rb") as stream:
        for _, channel, message, decoded in make_reader(
            stream, decoder_factories=[OfficialDecoder()]
        ).iter_decoded_messages():
            reference.setdefault(channel.id, []).append((message.log_time, message.publish_time, decoded))
    assert not data.losses
    assert {columns.channel_id for columns in data.topics if len(columns)} == set(reference)
    for columns in data.topics:
        expected = reference.get(columns.channel_id, [])
        assert columns.log_time.tolist() == [log for log, _, _ in expected]
        assert columns.publish_time.tolist() == [publish for _, publish, _ in expected]
        for field, column in columns.fields.items():
            assert_column_equals(column, [get_field(message, field) for _, _, message in expected])
    return sum(map(len, reference.values()))


def get_field(message: Any, path: str) -> Any:
    """A field of a decoded message by our path."""
    head, _, rest = path.partition(".")
    value = getattr(message, head.removesuffix("[]"))
    if not rest:
        return value
    if head.endswith("[]"):
        below = [get_field(each, rest) for each in value]
        nested = (
            below
            and (isinstance(below[0], bytes) or hasattr(below[0], "__len__"))
            and not isinstance(below[0], str)
        )
        return [value for each in below for value in each] if nested else below
    return get_field(value, rest)


def assert_column_equals(column: Any, expected: list[Any]) -> None:
    """A column holds exactly these values."""
    if isinstance(column, Strings):
        assert column.to_list() == expected
    elif isinstance(column, RaggedStrings):
        assert [column.row(row) for row in range(len(column))] == expected
    elif isinstance(column, Ragged):
        assert len(column) == len(expected)
        for row, values in enumerate(expected):
            assert np.array_equal(column.row(row).reshape(-1), np.array(list(values)), equal_nan=True)
    else:
        values = np.array([list(v) if isinstance(v, bytes) else v for v in expected])
        assert np.array_equal(column, values.reshape(column.shape), equal_nan=True)


def write_channels(
    path: Path, channels: list[Channel], *, times: list[int] | None = None, **options: Any
) -> None:
    """Channels as (topic, type, schema encoding, schema, message encoding, payloads)."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2", library="test")
        for topic, kind, schema_encoding, schema, encoding, encoded in channels:
            schema_id = writer.register_schema(kind, schema_encoding, schema) if kind else 0
            channel = writer.register_channel(topic, encoding, schema_id)
            for number, payload in enumerate(encoded):
                time = times[number] if times else START + number
                writer.add_message(channel, time, payload, time, number)
        writer.finish()


def read_one(path: Path, topic: str, *fields: str) -> Any:
    """The columns of a topic of one channel, nothing lost."""
    data = read_topics(path, [Wanted(topic, fields or None)])
    assert not data.losses
    (columns,) = data.of(topic)
    return columns


def text_of(kind: str) -> bytes:
    """The definition of a bundled type."""
    return (definition_text(kind) or "").encode()
