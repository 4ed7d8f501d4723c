"""What a user is promised of a live server that is watched: everything received is kept, whatever it does."""

import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from live_servers import (
    PATIENCE_S,
    FoxgloveServer,
    OlderFoxgloveServer,
    Played,
    RosbridgeServer,
    playing,
    read_messages,
)
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.rosbag2 import Reader
from verbs import run_verb
from websockets.sync.server import ServerConnection

from pipeline.live import LiveError
from pipeline.live.receiver import LiveReceiver
from pipeline.live.running_log import LiveLog, name_folder, parse_address, receive_live
from pipeline.logs import LogError, open_log, read_topics
from pipeline.logs.index import LISTING
from pipeline.logs.live_recording import (
    MOST_TOPICS,
    Foxglove,
    FrameError,
    LiveChannel,
    LiveRecording,
    Rosbridge,
)
from pipeline.logs.reader import Wanted
from pipeline.simulate import Scenario, simulate_run, write_log

ODOMETRY = "/mapping/icp_odom"
DAY_NS = 86_400 * 10**9


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "source.mcap"
    write_log(simulate_run(Scenario(duration_s=20.0, seed=5)), path)
    return path


def wait_for(is_there: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not is_there():
        assert time.monotonic() < end
        time.sleep(0.05)


def receive(port: int, folder: Path, topics: tuple[str, ...] = (), quiet_s: float = 20.0):  # type: ignore[no-untyped-def]  # noqa: ANN201
    address = parse_address(f"ws://127.0.0.1:{port}")
    assert address is not None
    return receive_live(address, folder, topics, quiet_s)


def count_messages(log: LiveLog) -> int:
    log.update()
    return log.make_index().message_count if log.size else 0


def read_column(path: Path, topic: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    (columns,) = read_topics(open_log(path), [Wanted(topic)]).of(topic)
    return columns.log_time, np.asarray(columns.fields[name])


def make_server(kind: str, messages: list[Played], port: int = 0):  # type: ignore[no-untyped-def]  # noqa: ANN201
    if kind == "sdk":
        server = FoxgloveServer(port)
        server.advertise(messages)
        return server
    return {"older": OlderFoxgloveServer, "rosbridge": RosbridgeServer}[kind](messages, port)


@pytest.mark.parametrize("kind", ["sdk", pytest.param("older", marks=pytest.mark.long), "rosbridge"])
def test_what_a_server_sends_is_recorded_as_it_is(kind: str, source: Path, tmp_path: Path) -> None:
    messages = read_messages(source)
    server = make_server(kind, messages)
    seen = []
    try:
        with receive(server.port, tmp_path / "run") as log, playing(server, messages, 8.0) as player:
            while player.is_alive():
                seen.append(count_messages(log))
                time.sleep(0.2)
            wait_for(lambda: count_messages(log) == len(messages))
            assert "5 topics" in log.note
    finally:
        server.close()
    # It grew while it was received, and is whole afterwards.
    assert len({count for count in seen if 0 < count < len(messages)}) > 1
    index = open_log(tmp_path / "run")
    assert index.complete
    assert {(c.topic, c.type_name, c.message_count) for c in index.channels} == {
        (c.topic, c.type_name, c.message_count) for c in open_log(source).channels
    }
    for name in ("pose.pose.position.x", "header.stamp.nanosec"):
        times, values = read_column(tmp_path / "run", ODOMETRY, name)
        their_times, theirs = read_column(source, ODOMETRY, name)
        np.testing.assert_array_equal(values, theirs)
        if kind != "rosbridge":
            np.testing.assert_array_equal(times, their_times)
    assert (np.diff(times) >= 0).all()
    if kind != "rosbridge":
        # What others make of rosbag2's recordings they make of this one.
        with Reader(tmp_path / "run") as reader:
            assert reader.message_count == len(messages)


def played(topic: str, type_name: str, encoding: str, schema: bytes, schema_encoding: str, data: bytes):  # type: ignore[no-untyped-def]  # noqa: ANN201
    return (
        SimpleNamespace(name=type_name, encoding=schema_encoding, data=schema),
        SimpleNamespace(id=len(topic), topic=topic, message_encoding=encoding),
        SimpleNamespace(log_time=1_700_000_000_000_000_000, data=data),
    )


def test_json_and_protobuf_are_recorded_and_decoded(tmp_path: Path) -> None:
    descriptor = build_file_descriptor_set(Timestamp).SerializeToString()
    stamp = Timestamp(seconds=7, nanos=5).SerializeToString()
    messages = [
        played("/json", "Twist", "json", b'{"type":"object"}', "jsonschema", b'{"linear":{"x":1.5}}'),
        played("/proto", "google.protobuf.Timestamp", "protobuf", descriptor, "protobuf", stamp),
    ]
    server = OlderFoxgloveServer(cast("list[Played]", messages))
    try:
        with (
            receive(server.port, tmp_path / "run", ("/json", "/proto")) as log,
            playing(server, cast("list[Played]", messages), 1.0),
        ):
            wait_for(lambda: count_messages(log) == 2)
    finally:
        server.close()
    assert read_column(tmp_path / "run", "/json", "linear.x")[1] == [1.5]
    assert read_column(tmp_path / "run", "/proto", "seconds")[1] == [7]


def test_a_server_that_goes_and_comes_again_loses_nothing(source: Path, tmp_path: Path) -> None:
    messages = read_messages(source)
    half = len(messages) // 2
    first = make_server("older", messages)
    with receive(first.port, tmp_path / "run") as log:
        with playing(first, messages[:half], 50.0):
            pass
        wait_for(lambda: count_messages(log) == half)
        first.close()
        wait_for(lambda: "no connection" in log.note)
        # What came before stands in a file that is whole, whatever happens now.
        assert open_log(tmp_path / "run" / "run_0.mcap").message_count == half
        second = make_server("older", messages, first.port)
        try:
            with playing(second, messages[half:], 50.0):
                wait_for(lambda: count_messages(log) == len(messages))
            assert "no connection" not in log.note
        finally:
            second.close()
    assert open_log(tmp_path / "run").complete
    times, values = read_column(tmp_path / "run", ODOMETRY, "pose.pose.position.x")
    np.testing.assert_array_equal(values, read_column(source, ODOMETRY, "pose.pose.position.x")[1])
    assert len(set(times.tolist())) == times.size


class Rude(OlderFoxgloveServer):
    """Says what it should not before it says anything else."""

    def speak(self, connection: ServerConnection) -> None:
        for frame in (
            "",
            "[1]",
            "{",
            '{"op":5}',
            b"",
            b"\x01\x02",
            b"\x63abc",
            '{"op":"advertise","channels":[7]}',
        ):
            connection.send(frame)
        many = [
            {"id": 1000 + n, "topic": f"/t{n}", "encoding": "json", "schemaName": "nav_msgs/Odometry"}
            for n in range(3 * MOST_TOPICS)
        ]
        self.many = many
        super().speak(connection)


def test_garbage_is_said_and_what_is_good_beside_it_is_kept(source: Path, tmp_path: Path) -> None:
    messages = read_messages(source)[:200]
    server = Rude(messages)
    try:
        with receive(server.port, tmp_path / "run") as log, playing(server, messages, 50.0):
            wait_for(lambda: count_messages(log) == len(messages))
            number = next(iter(server.numbers.values()))
            for log_time in (1 << 63, (1 << 64) - 1, 12345):
                server.send(struct.pack("<BIQ", 1, number, log_time) + b"x")
            wait_for(lambda: "7 left out" in log.note)
            wait_for(lambda: "3 of another clock: placed by their arrival" in log.note)
            server.send(json.dumps({"op": "advertise", "channels": server.many}))
            wait_for(lambda: f"{MOST_TOPICS} topics" in log.note)
            # A frame beyond all measure costs the connection, never what was received.
            server.send(b"\x01" + bytes(20 << 20))
            wait_for(lambda: "it sent more than 16 MB at once" in log.note)
            wait_for(lambda: server.connections == 2)
    finally:
        server.close()
    index = open_log(tmp_path / "run")
    assert index.message_count == len(messages) + 3
    assert index.complete


@pytest.mark.parametrize(
    "times",
    [
        ("3 days ahead", lambda t: t + 3 * DAY_NS),
        ("to zero", lambda t: t % DAY_NS),
        pytest.param(("3 days back", lambda t: t - 3 * DAY_NS), marks=pytest.mark.long),
        pytest.param(("30 years ahead", lambda t: t + 11_000 * DAY_NS), marks=pytest.mark.long),
    ],
    ids=lambda one: one[0],
)
def test_a_clock_that_is_set_begins_a_file_and_costs_no_message(
    times: tuple[str, Callable[[int], int]], source: Path, tmp_path: Path
) -> None:
    messages = read_messages(source)[:400]
    for _, _, message in messages[200:]:
        message.log_time = times[1](message.log_time)
    # As of a simulation that has not started, and of a message that a second computer has stamped.
    messages[0][2].log_time = 0
    messages[100][2].log_time += 9 * DAY_NS
    server = make_server("older", messages)
    try:
        with receive(server.port, tmp_path / "run") as log, playing(server, messages, 1e12):
            wait_for(lambda: count_messages(log) == len(messages))
            assert "left out" not in log.note
            assert log.end_s < 60.0
    finally:
        server.close()
    files = sorted((tmp_path / "run").glob("*.mcap"))
    counts = [open_log(file).message_count for file in files]
    # The message at zero, and the first ones of each clock, which tell it from a time that is wrong for once.
    assert len(counts) == 3
    assert counts[0] < 25
    assert 200 <= counts[0] + counts[1] < 225
    assert sum(counts) == len(messages)
    assert open_log(tmp_path / "run").message_count == len(messages)


@pytest.mark.parametrize(
    ("address", "code"),
    [
        ("ws://192.168.1.20:8765", "not_this_machine"),
        ("ws://robot.local:9090", "not_this_machine"),
        ("ws://0.0.0.0:9090", "not_this_machine"),
        ("ws://127.0.0.1.example.com:9090", "not_this_machine"),
        ("ws://[2001:db8::1]:9090", "not_this_machine"),
        ("wss://127.0.0.1:9090", "bad_address"),
        ("ws://user@127.0.0.1:9090", "bad_address"),
        ("ws://127.0.0.1:99999", "bad_address"),
        ("ws://", "bad_address"),
    ],
)
def test_only_a_plain_address_of_this_machine_is_watched(address: str, code: str) -> None:
    with pytest.raises(LiveError) as refused:
        parse_address(address)
    assert refused.value.code == code
    assert "\n" not in str(refused.value)


def test_an_address_is_shown_with_the_slash_that_a_path_takes_from_it() -> None:
    with pytest.raises(LiveError) as refused:
        parse_address(str(Path("ws://192.168.1.20:8765")))
    assert refused.value.where == "ws://192.168.1.20:8765"


def test_an_address_is_recognized_and_a_path_is_none() -> None:
    assert str(parse_address("ws://localhost:9090")) == "ws://127.0.0.1:9090/"
    assert str(parse_address("ws:/[::1]/live")) == "ws://[::1]:8765/live"
    assert parse_address("runs/ws.mcap") is None


def answer_once(listener: socket.socket, text: bytes) -> threading.Thread:
    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(4096)
            connection.sendall(text)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return thread


def test_no_server_and_one_of_another_kind_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Whatever the environment says of proxies: the connection goes to this machine and nowhere else.
    with socket.create_server(("127.0.0.1", 0)) as elsewhere:
        port = elsewhere.getsockname()[1]
        for name in ("http_proxy", "all_proxy", "ws_proxy"):
            monkeypatch.setenv(name, f"http://127.0.0.1:{port}")
        told = run_verb("watch", "ws://127.0.0.1:1", "--results", tmp_path / "out", cwd=tmp_path)
        assert told.returncode == 1
        assert told.stderr == (
            "slip: ws://127.0.0.1:1/: no server answers there: Connection refused. "
            "Start foxglove_bridge or rosbridge, or check the port.\n"
        )
        moved = f"HTTP/1.1 302 Found\r\nLocation: ws://127.0.0.1:{port}/\r\nContent-Length: 0\r\n\r\n"
        for text in (b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n", moved.encode(), b"\x00garbage\r\n\r\n"):
            with socket.create_server(("127.0.0.1", 0)) as listener:
                answer_once(listener, text)
                at = f"ws://127.0.0.1:{listener.getsockname()[1]}"
                told = run_verb("watch", at, "--results", tmp_path / "out", cwd=tmp_path)
            assert told.returncode == 1
            assert told.stderr.count("\n") == 1
            assert "no server answers there" in told.stderr
        elsewhere.settimeout(0.2)
        with pytest.raises(TimeoutError):
            elsewhere.accept()
    # No folder is left for a recording that never began.
    assert [entry.name for entry in tmp_path.iterdir()] in ([], ["out"])


def test_without_the_extra_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "websockets.sync.client", None)
    receiver = LiveReceiver("ws://127.0.0.1:1/", LiveRecording(tmp_path / "run"), {})
    with pytest.raises(LiveError, match=r"needs another package. Install the extra `live`"):
        receiver.run()


@pytest.mark.long
def test_rosbridge_without_rosapi_takes_topics_with_types(source: Path, tmp_path: Path) -> None:
    messages = read_messages(source)[:300]
    server = RosbridgeServer(messages, has_rosapi=False)
    try:
        with receive(server.port, tmp_path / "none", quiet_s=1.5) as log:
            wait_for(lambda: "--topic NAME=TYPE" in log.note)
            with pytest.raises(LiveError, match=r"no message of motion came for 1.5 s"):
                wait_for(log.update)
        topic = (f"{ODOMETRY}=nav_msgs/msg/Odometry",)
        with receive(server.port, tmp_path / "run", topic) as log, playing(server, messages, 10.0):
            wait_for(lambda: count_messages(log) > 10)
    finally:
        server.close()
    (channel,) = open_log(tmp_path / "run").channels
    assert (channel.topic, channel.type_name) == (ODOMETRY, "nav_msgs/msg/Odometry")
    assert not (tmp_path / "none").exists()


def test_a_recording_that_cannot_be_written_is_one_line(source: Path, tmp_path: Path) -> None:
    messages = read_messages(source)[:300]
    server = make_server("older", messages)
    (tmp_path / "file").touch()
    ended = tmp_path / "ended"
    ended.mkdir()
    (ended / LISTING).touch()
    try:
        for folder, what in ((tmp_path / "file" / "run", "cannot be written"), (ended, "has ended")):
            told = run_verb(
                "watch", f"ws://127.0.0.1:{server.port}", "--record", folder, "--results", tmp_path / "out"
            )
            assert told.returncode == 1
            assert told.stderr.count("\n") == 1
            assert what in told.stderr
    finally:
        server.close()


def test_a_full_disk_is_said_and_what_was_written_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = LiveRecording(tmp_path / "run")
    channel = LiveChannel("/a", "std_msgs/msg/String", "json", "jsonschema", b"{}")
    for number in range(5):
        recording.write(channel, number, b'{"data":"x"}')
    recording.end_part()
    monkeypatch.setattr("pipeline.logs.live_recording._CHUNK_S", 0.0)
    full = Path("/dev/full").open("wb")  # noqa: SIM115 - closing it fails, too
    monkeypatch.setattr(Path, "open", lambda *_: full)
    for fails in (lambda: recording.write(channel, 9, b'{"data":"x"}'), recording.close):
        with pytest.raises(LogError, match=r"cannot be written: No space left on device"):
            fails()
    monkeypatch.undo()
    assert full.closed
    assert open_log(tmp_path / "run" / "run_0.mcap").message_count == 5


def test_a_recording_that_was_left_is_gone_on_with_and_an_ended_one_is_not(tmp_path: Path) -> None:
    address = parse_address("ws://127.0.0.1:8765")
    assert address is not None
    assert name_folder(address, tmp_path).name.startswith("live_8765_2")
    left, old = tmp_path / "live_8765_2026_01_01-10_00_00", tmp_path / "live_8765_2026_01_01-11_00_00"
    for folder in (left, old):
        folder.mkdir()
        with (folder / "x_0.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            writer.finish()
    os.utime(old / "x_0.mcap", (1, 1))
    assert name_folder(address, tmp_path) == left
    # Who watches the same server a second time gets a folder of his own.
    other = LiveRecording(left)
    assert name_folder(address, tmp_path) not in (left, old)
    with pytest.raises(LogError, match="another watch writes there"):
        LiveRecording(left)
    other.close()
    assert (left / LISTING).exists()
    assert name_folder(address, tmp_path) not in (left, old)


@pytest.mark.long
def test_a_killed_watch_goes_on_in_the_same_folder(source: Path, tmp_path: Path) -> None:
    messages = read_messages(source)
    server = make_server("older", messages)
    command = [sys.executable, "-m", "pipeline", "watch", f"ws://127.0.0.1:{server.port}", "--results", "out"]
    half = len(messages) // 2
    try:
        for part in (messages[:half], messages[half:]):
            server.subscribed.clear()
            with subprocess.Popen(
                command,
                cwd=tmp_path,
                stdout=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": str(Path.cwd())},
            ) as process:
                with playing(server, part, 50.0):
                    pass
                time.sleep(2.0)
                process.kill()
            # What receives ends with the watch, and puts an end to its file.
            wait_for(lambda: not server.clients)
    finally:
        server.close()
    (folder,) = tmp_path.glob("live_*")
    wait_for(lambda: open_log(folder).complete)
    index = open_log(folder)
    assert [file.name for file in sorted(folder.iterdir())] == [f"{folder.name}_{n}.mcap" for n in (0, 1)]
    assert index.message_count == len(messages)


@pytest.mark.parametrize(
    "frame",
    [
        *(b"", b"\x01", b"\x01\x00", "", "null", "[]", '{"op":null}', "{" * 10_000, "\ud800"),
        '{"op":"advertise","channels":' + "[" * 100_000,
        '{"op":"advertise","channels":[{"id":1e400,"topic":"a","encoding":"b"}]}',
        '{"op":"advertise","channels":[{"id":3,"topic":"a","encoding":"protobuf","schema":"%%"}]}',
        '{"op":"unadvertise","channelIds":{}}',
    ],
)
def test_no_frame_of_a_foxglove_server_does_more_than_to_be_left_out(frame: str | bytes) -> None:
    with pytest.raises(FrameError):
        Foxglove(is_wanted=lambda *_: True).take(frame)


@pytest.mark.parametrize(
    "frame",
    [
        *(b"", b"\xff", "", "null", "[]", '{"op":null}', "{" * 10_000, "\ud800"),
        '{"op":"publish","topic":"/a","msg":' + "[" * 100_000,
        '{"op":"publish","topic":"/a","msg":{"x":NaN}}',
        '{"op":"service_response","service":"/rosapi/topics","values":{"topics":"/a"}}',
        '{"op":"service_response","service":"/rosapi/topics","values":{"topics":[1],"types":[2]}}',
    ],
)
def test_no_frame_of_a_rosbridge_server_does_more_than_to_be_left_out(frame: str | bytes) -> None:
    with pytest.raises(FrameError):
        Rosbridge(is_wanted=lambda *_: True, given={"/a": "b"}).take(frame)


@pytest.mark.long
def test_the_answer_of_a_watched_server_is_that_of_its_recording(tmp_path: Path) -> None:
    path = tmp_path / "source.mcap"
    write_log(simulate_run(Scenario(duration_s=100.0, seed=5, effects={"effective_track": {"k": 1.8}})), path)
    messages = read_messages(path)
    # A recorder writes the vehicle into its file; of a server the robot description tells it, or the user.
    vehicle = ("--vehicle", "husky_a200")
    server = make_server("sdk", messages)
    try:
        with playing(server, messages, 5.0):
            told = run_verb(
                "watch", f"ws://127.0.0.1:{server.port}", "--json", "--for", 30, "--record", tmp_path / "run",
                "--results", tmp_path / "out", *vehicle,
            )  # fmt: skip
    finally:
        server.close()
    assert told.returncode == 0, told.stderr
    *looks, final = [json.loads(line) for line in told.stdout.splitlines()]
    assert any(one["knowledge"].get("until_s") for one in looks)
    alone = run_verb("diagnose", tmp_path / "run", "--json", "--results", tmp_path / "alone", *vehicle)
    assert final["runs"] == json.loads(alone.stdout)["runs"]
    source = run_verb("diagnose", path, "--json", "--results", tmp_path / "other", *vehicle)
    effects = [json.loads(told)["runs"][0]["effects"] for told in (alone.stdout, source.stdout)]
    assert effects[0]
    assert [one["parameters"] for one in effects[0]] == [one["parameters"] for one in effects[1]]
