"""Every encoding of messages that is met is read as it was meant, or named."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_files import (
    FLOAT,
    JOINTS,
    START,
    payloads,
    read_one,
    text_of,
    write_channels,
)

from pipeline.logs import (
    LogError,
    Strings,
    Wanted,
    read_topics,
)


def big_endian_joints() -> bytes:
    body = struct.pack(">iI", 5, 6) + struct.pack(">I", 4) + b"abc\0"
    body += struct.pack(">I", 1) + struct.pack(">I", 3) + b"xy\0"
    body += b"\0" + struct.pack(">I", 1)
    body += b"\0" * (-len(body) % 8) + struct.pack(">d", 1.5)
    body += struct.pack(">I", 2) + b"\0" * 4 + struct.pack(">2d", 2.5, -3.5) + struct.pack(">I", 0)
    return b"\x00\x00\x00\x00" + body


def test_big_endian_messages_are_read_among_little_endian_ones(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    little = payloads(JOINTS, 1, {"name": ["xy"], "velocity": np.array([[7.0]])})
    write_channels(path, [("/j", JOINTS, "ros2msg", text_of(JOINTS), "cdr", [big_endian_joints(), *little])])
    columns = read_one(path, "/j")
    assert columns.fields["velocity"].row(0).tolist() == [2.5, -3.5]
    assert columns.fields["velocity"].row(1).tolist() == [7.0]
    assert columns.fields["name"].row(0) == ["xy"]
    assert columns.fields["header.frame_id"].to_list() == ["abc", ""]
    assert columns.header_time.tolist() == [5_000_000_006, 0]


def test_plain_xcdr2_is_aligned_to_four_and_counts_bytes_of_sequences(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    text = "uint8 flag\nfloat64 value\nstring[] names\nfloat64[] list\n"
    names = struct.pack("<I", 2) + struct.pack("<I", 2) + b"a\0" + b"\0\0" + struct.pack("<I", 2) + b"b\0"
    body = b"\x01\0\0\0" + struct.pack("<d", 2.25) + struct.pack("<I", len(names)) + names
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", 1) + struct.pack("<d", -4.0)
    write_channels(
        path, [("/x", "demo/msg/X", "ros2msg", text.encode(), "cdr", [b"\x00\x07\x00\x00" + body])]
    )
    fields = read_one(path, "/x").fields
    assert fields["value"].tolist() == [2.25]
    assert fields["names"].row(0) == ["a", "b"]
    assert fields["list"].row(0).tolist() == [-4.0]


@pytest.mark.parametrize(("kind", "name"), [(0x03, "PL_CDR_LE"), (0x09, "D_CDR2_LE"), (0x0B, "PL_CDR2_LE")])
def test_other_encapsulations_are_named_never_decoded_as_plain(tmp_path: Path, kind: int, name: str) -> None:
    path = tmp_path / "log.mcap"
    good = payloads(FLOAT, 3, {"data": np.array([1.0, 2.0, 3.0])})
    odd = bytes([0, kind]) + good[1][2:]
    write_channels(path, [("/x", FLOAT, "ros2msg", text_of(FLOAT), "cdr", [good[0], odd, good[2]])])
    data = read_topics(path, [Wanted("/x")])
    assert data.of("/x")[0].fields["data"].tolist() == [1.0, 3.0]
    (loss,) = data.losses
    assert loss.kind == "unsupported_encoding"
    assert name in loss.text
    assert (loss.start_ns, loss.end_ns) == (START + 1, START + 1)


def test_payloads_that_do_not_fit_their_type_are_lost_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    good = payloads(JOINTS, 2, {"name": ["a"], "velocity": np.array([[1.0], [2.0]])})
    too_long = bytearray(good[0])
    struct.pack_into("<I", too_long, 12, 1 << 31)
    bad = [b"", b"\0", good[0][:30], bytes(too_long), b"\xff\xff\0\0" + good[0][4:]]
    write_channels(path, [("/j", JOINTS, "ros2msg", text_of(JOINTS), "cdr", [good[0], *bad, good[1]])])
    data = read_topics(path, [Wanted("/j", ("velocity[0]",))])
    assert data.of("/j")[0].fields["velocity[0]"].tolist() == [1.0, 2.0]
    assert {loss.kind for loss in data.losses} == {"undecodable"}
    assert sum(int(loss.text.split()[0]) for loss in data.losses) == len(bad)


def test_json_messages_are_columns(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    messages = [
        {"speed": 1.5, "mode": "calib", "wheels": [1, 2], "pose": {"x": 3}, "points": [{"x": 1}, {"x": 2}]},
        {"speed": 2.5, "mode": "idle", "wheels": [], "pose": {"x": 4}, "points": []},
    ]
    encoded = [json.dumps(message).encode() for message in messages]
    write_channels(path, [("/j", "Status", "jsonschema", b"{}", "json", [*encoded, b"{broken"])])
    data = read_topics(path, [Wanted("/j")])
    fields: Any = data.of("/j")[0].fields
    assert fields["speed"].tolist() == [1.5, 2.5]
    assert isinstance(fields["mode"], Strings)
    assert fields["wheels"].row(0).tolist() == [1, 2]
    assert fields["points[].x"].row(0).tolist() == [1, 2]
    assert fields["pose.x"].tolist() == [3, 4]
    assert [loss.kind for loss in data.losses] == ["undecodable"]
    only = read_topics(path, [Wanted("/j", ("wheels[1]",))]).of("/j")[0].fields
    assert np.array_equal(only["wheels[1]"], [2.0, np.nan], equal_nan=True)


def test_protobuf_messages_are_columns(tmp_path: Path) -> None:
    timestamp = pytest.importorskip("google.protobuf.timestamp_pb2", reason="protobuf is not installed")
    support = pytest.importorskip("mcap_protobuf.writer", reason="mcap-protobuf-support is not installed")
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream, support.Writer(stream) as writer:
        for row in range(3):
            message = timestamp.Timestamp(seconds=row, nanos=row * 2)
            writer.write_message("/p", message, START + row, START + row)
    fields = read_one(path, "/p").fields
    assert fields["seconds"].tolist() == [0, 1, 2]
    assert fields["nanos"].tolist() == [0, 2, 4]


PROTOBUF_NAMES = ("DESCRIPTOR", "items", "__class__", "HasField")


def describe_protobuf(*files: str) -> Any:  # noqa: ANN401 - made at run time
    """A set of files, each with a type ``T``: numbers by the names above, an ``In``, and a ``T`` in it."""
    pytest.importorskip("google.protobuf", reason="protobuf is not installed")
    from google.protobuf import descriptor_pb2  # noqa: PLC0415 - optional

    found = descriptor_pb2.FileDescriptorSet()
    for file in files:
        described = found.file.add(name=file, syntax="proto3")
        outer, inner = described.message_type.add(name="T"), described.message_type.add(name="In")
        inner.field.add(name="items", number=1, type=1, label=1)
        for number, name in enumerate(PROTOBUF_NAMES, 1):
            outer.field.add(name=name, number=number, type=1, label=1)
        outer.field.add(name="inner", number=10, type=11, label=1, type_name=".In")
        outer.field.add(name="next", number=11, type=11, label=1, type_name=".T")
    return found


def test_protobuf_fields_may_bear_any_name_and_types_hold_themselves(tmp_path: Path) -> None:
    def spell(value: float, inside: bytes = b"") -> bytes:
        numbers = b"".join(bytes([(n << 3) | 1]) + struct.pack("<d", value + n) for n in range(1, 5))
        inner = b"\x52\x09\x09" + struct.pack("<d", value)
        return numbers + inner + (bytes([(11 << 3) | 2, len(inside)]) + inside if inside else b"")

    path = tmp_path / "log.mcap"
    schema = describe_protobuf("a.proto").SerializeToString()
    messages = [spell(1.0), spell(2.0, spell(5.0))]
    write_channels(path, [("/p", "T", "protobuf", schema, "protobuf", messages)])
    fields = read_one(path, "/p").fields
    for number, name in enumerate(PROTOBUF_NAMES, 1):
        assert fields[name].tolist() == [1.0 + number, 2.0 + number]
    assert fields["inner.items"].tolist() == [1.0, 2.0]
    assert np.array_equal(fields["next.inner.items"], [np.nan, 5.0], equal_nan=True)


def test_a_protobuf_schema_that_contradicts_itself_is_named(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    schema = describe_protobuf("a.proto", "a.proto").SerializeToString()
    write_channels(path, [("/p", "T", "protobuf", schema, "protobuf", [b""])])
    (loss,) = read_topics(path, [Wanted("/p")]).losses
    assert "the protobuf schema is damaged" in loss.text


def test_messages_that_name_their_fields_at_will_fill_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    messages = [json.dumps({"a": row, f"k{row}": 1}).encode() for row in range(5000)]
    write_channels(path, [("/j", "T", "jsonschema", b"{}", "json", messages)])
    with pytest.raises(LogError, match="5000 messages have 5001 different fields"):
        read_topics(path, [Wanted("/j")])
    assert read_topics(path, [Wanted("/j", ("a",))]).of("/j")[0].fields["a"].tolist() == list(range(5000))
