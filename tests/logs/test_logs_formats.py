"""Everything that is legal, and much that is not but met in the field, is read as it was meant."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_files import (
    FLOAT,
    START,
    TEXT,
    Channel,
    payloads,
    read_one,
    read_small,
    small_truth,
    text_of,
    write_channels,
    write_official,
    write_small,
)

from pipeline.logs import (
    LogError,
    Ragged,
    TransformBuffer,
    Wanted,
    hash_log,
    open_log,
    read_topics,
)
from pipeline.logs.writer import LogWriter

IDL = """================================================================================
IDL: demo_msgs/msg/Status
module demo_msgs {
  module msg {
    const long COUNT = 2;
    typedef double double__2[COUNT];
    @verbatim (language="comment", text="a } brace; in words")
    struct Status {
      std_msgs::msg::Header header;
      @unit ("m/s") double speed;
      double__2 pair;
      sequence<float, 4> history;
      string<16> name;
      unsigned long long count;
    };
  };
};
================================================================================
IDL: std_msgs/msg/Header
module std_msgs { module msg { struct Header {
  builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
================================================================================
IDL: builtin_interfaces/msg/Time
module builtin_interfaces { module msg { struct Time { long sec; unsigned long nanosec; }; }; };
"""
SAME_AS_IDL = """std_msgs/Header header
float64 speed
float64[2] pair
float32[<=4] history
string<=16 name
uint64 count
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""


def test_two_channels_on_one_topic_stay_apart(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(FLOAT, "ros2msg", text_of(FLOAT))
        for value in (1.0, 2.0):
            channel = writer.register_channel("/speed", "cdr", schema, {"node": str(value)})
            (payload,) = payloads(FLOAT, 1, {"data": value})
            writer.add_message(channel, START, payload, START)
        writer.finish()
    data = read_topics(path, [Wanted("/speed")])
    assert sorted(float(columns.fields["data"][0]) for columns in data.of("/speed")) == [1.0, 2.0]


def test_one_name_with_two_definitions_is_decoded_by_each(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    first, second = "float64 x\nfloat64 y\n", "float64 y\nfloat64 x\n"
    values = {"x": 1.0, "y": 2.0}
    write_channels(
        path,
        [
            (
                "/a",
                "demo/msg/Pair",
                "ros2msg",
                first.encode(),
                "cdr",
                payloads("demo/Pair", 1, values, first),
            ),
            (
                "/b",
                "demo/msg/Pair",
                "ros2msg",
                second.encode(),
                "cdr",
                payloads("demo/Pair", 1, values, second),
            ),
        ],
    )
    for topic in ("/a", "/b"):
        fields = read_one(path, topic).fields
        assert (fields["x"][0], fields["y"][0]) == (1.0, 2.0)


def test_idl_schemas_mean_the_same_as_msg(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    fields = {
        "speed": np.array([1.0, 2.0]),
        "pair": np.array([[1.0, 2.0], [3.0, 4.0]]),
        "history": Ragged(np.array([1.0, 2.0, 3.0], dtype=np.float32), np.array([0, 1, 3])),
        "name": ["a", "bcd"],
        "count": np.array([1, 2**40]),
    }
    encoded = payloads("demo_msgs/msg/Status", 2, fields, SAME_AS_IDL)
    write_channels(
        path,
        [
            ("/idl", "demo_msgs/msg/Status", "ros2idl", IDL.encode(), "cdr", encoded),
            ("/msg", "demo_msgs/msg/Status", "ros2msg", SAME_AS_IDL.encode(), "cdr", encoded),
        ],
    )
    idl, msg = read_one(path, "/idl"), read_one(path, "/msg")
    assert list(idl.fields) == list(msg.fields)
    assert idl.fields["history"].row(1).tolist() == [2.0, 3.0]
    assert idl.fields["pair"].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert idl.fields["count"].tolist() == [1, 2**40]
    assert idl.fields["name"].to_list() == msg.fields["name"].to_list() == ["a", "bcd"]


def test_messages_longer_than_a_guessed_type_are_refused_and_than_their_own_noted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    encoded = [payload + bytes(8) for payload in payloads(FLOAT, 2, {"data": np.array([1.0, 2.0])})]
    channels: list[Channel] = [
        ("/own", FLOAT, "ros2msg", text_of(FLOAT), "cdr", encoded),
        ("/guessed", FLOAT, "ros2msg", b"", "cdr", encoded),
    ]
    write_channels(path, channels)
    data = read_topics(path, [Wanted("/own"), Wanted("/guessed")])
    assert data.of("/own")[0].fields["data"].tolist() == [1.0, 2.0]
    assert "2 messages hold more bytes" in data.of("/own")[0].notes[0]
    assert len(data.of("/guessed")[0]) == 0
    assert [loss.kind for loss in data.losses] == ["other_version"]


def test_unchunked_logs_and_log_time_zero_are_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    truth = write_official(path, use_chunking=False)
    data, found = read_small(path)
    assert found == truth
    assert not data.losses
    encoded = payloads(FLOAT, 3, {"data": np.array([1.0, 2.0, 3.0])})
    channel: Channel = ("/x", FLOAT, "ros2msg", text_of(FLOAT), "cdr", encoded)
    write_channels(path, [channel], times=[0, START, START + 1])
    assert open_log(path).start_ns == 0
    assert read_one(path, "/x").log_time.tolist() == [0, START, START + 1]


def test_messages_come_in_the_order_of_log_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    encoded = payloads(TEXT, 4, {"data": ["c", "a", "b", "b2"]})
    times = [START + 9, START, START + 5, START + 5]
    write_channels(path, [("/x", TEXT, "ros2msg", text_of(TEXT), "cdr", encoded)], times=times, chunk_size=10)
    columns = read_one(path, "/x")
    assert columns.log_time.tolist() == sorted(times)
    assert columns.fields["data"].to_list() == ["a", "b", "b2", "c"]


def transform(parent: str, child: str) -> dict[str, Any]:
    return {
        "transforms[].header.frame_id": parent,
        "transforms[].child_frame_id": child,
        "transforms[].transform.rotation.w": 1.0,
    }


@pytest.mark.parametrize("listed", [True, False])
def test_a_split_recording_is_one_run(tmp_path: Path, *, listed: bool) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    topics, truth = small_truth()
    kind = "tf2_msgs/msg/TFMessage"
    for part in range(3):
        with LogWriter(folder / f"run_{part}.mcap") as writer:
            first = START + part * 200_000_000
            if part == 0:
                writer.write_columns("/tf_static", kind, np.array([first]), transform("base_link", "imu"))
            writer.write_columns("/tf", kind, np.array([first, first + 1]), transform("odom", "base_link"),
                                 header_time=np.array([first, first + 1]))  # fmt: skip
            for topic in sorted(topics) if part % 2 else sorted(topics, reverse=True):
                name, time, fields = topics[topic]
                rows = slice(part * 20, part * 20 + 20)
                chosen = {key: value[rows] if key != "name" else value for key, value in fields.items()}
                writer.write_columns(topic, name, time[rows], chosen)
    if listed:
        lines = "\n".join(f"    - run_{part}.mcap" for part in range(3))
        (folder / "metadata.yaml").write_text(
            f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}\n"
        )
    index = open_log(folder)
    assert index.message_count == len(truth) + 7
    data = read_topics(index, [Wanted(topic) for topic in index.topics()])
    assert not data.losses
    for topic, (_, time, _) in topics.items():
        (columns,) = data.of(topic)
        assert columns.log_time.tolist() == time.tolist()
    assert TransformBuffer(data.topics).chain("odom", "imu") == ("odom", "base_link", "imu")
    assert data.sha256 == hash_log(folder)
    (folder / "run_1.mcap").unlink()
    if listed:
        assert [loss.kind for loss in open_log(folder).losses] == ["missing_part"]


def test_a_listing_names_no_file_outside_of_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    write_small(tmp_path / "secret.mcap", rows=50)
    write_small(folder / "run_0.mcap", rows=2)
    own = open_log(folder).message_count
    names = ["../secret.mcap", str(tmp_path / "secret.mcap"), "x/../../secret.mcap", "..\\secret.mcap",
             "\uff0e\uff0e/secret.mcap", "C:secret.mcap", "x" * 300 + ".mcap"]  # fmt: skip
    listing = folder / "metadata.yaml"
    for name in names:
        for listed in ([name], ["run_0.mcap", name]):
            lines = "\n".join(f"    - '{each}'" for each in listed)
            listing.write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}\n")
            index = open_log(folder)
            assert index.message_count == own
            assert [loss.kind for loss in index.losses] == ["missing_part"]
            assert hash_log(folder) == hash_log(folder / "run_0.mcap")
    (folder / "run_0.mcap").unlink()
    with pytest.raises(LogError) as caught:
        open_log(folder)
    assert caught.value.code == "not_a_recording"


def test_parts_may_be_links_to_where_their_owner_keeps_them(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    write_small(tmp_path / "kept.mcap", rows=2)
    (tmp_path / "run" / "run_0.mcap").symlink_to(tmp_path / "kept.mcap")
    (tmp_path / "run" / "metadata.yaml").write_text("x:\n  relative_file_paths:\n    - run_0.mcap\n")
    assert open_log(tmp_path / "run").message_count == open_log(tmp_path / "kept.mcap").message_count


def test_a_folder_of_several_recordings_is_refused(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        write_small(tmp_path / name, rows=2)
    with pytest.raises(LogError) as caught:
        open_log(tmp_path)
    assert caught.value.code == "not_a_recording"


def test_a_chunk_without_checksum_is_read_up_to_the_last_wanted_message(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    encoded = payloads(FLOAT, 50, {"data": np.arange(50.0)})
    large = payloads("demo/Big", 50, {"data": np.zeros((50, 4000), dtype=np.uint8)}, "uint8[] data\n")
    channels: list[Channel] = [
        ("/x", FLOAT, "ros2msg", text_of(FLOAT), "cdr", encoded),
        ("/image", "demo/msg/Big", "ros2msg", b"uint8[] data\n", "cdr", large),
    ]
    write_channels(path, channels, enable_crcs=False)
    data = read_topics(path, [Wanted("/x")])
    assert data.of("/x")[0].fields["data"].tolist() == list(range(50))
    assert not data.losses
    assert "no checksum" in data.unchecked
