"""Time to look at a log grows with the number of its topics, whatever they hold, and no faster."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from pipeline.analysis import Options
from pipeline.logs.writer import LogWriter
from pipeline.recording import log_choice, pose_choice
from pipeline.recording.inspection import inspect_log
from pipeline.recording.log_choice import MOST_POSES
from pipeline.simulate import simulate_case
from pipeline.words import format_finding

FEW = 150
"""Topics of a kind beside those of a drive."""

OPTIONS = Options(overrides={"vehicle": {"preset": "husky_a200"}})
SECOND = 10**9
STAMPED = np.arange(5, dtype=np.int64) * SECOND

KINDS: dict[str, tuple[str, dict[str, object], str, bool]] = {
    "texts": ("std_msgs/msg/String", {"data": ["x"] * 5}, "note", False),
    "descriptions": ("std_msgs/msg/String", {"data": ["<robot/>"] * 5}, "robot_description", False),
    "events": ("rcl_interfaces/msg/ParameterEvent", {}, "parameter_events", False),
    "transforms": ("tf2_msgs/msg/TFMessage", {}, "tf_static", False),
    "odometries": ("nav_msgs/msg/Odometry", {}, "odom", True),
    "fixes": ("sensor_msgs/msg/NavSatFix", {"latitude": np.full(5, 46.0)}, "fix", True),
    "commands": ("geometry_msgs/msg/Twist", {}, "cmd_vel", False),
    "requests": ("unitree_api/msg/Request", {"parameter": ["x"] * 5}, "api/sport/request", False),
    "joints": ("sensor_msgs/msg/JointState", {}, "joint_states", True),
    "currents": ("std_msgs/msg/Float32", {"data": np.ones(5)}, "motor_current", False),
}
"""Type, fields and name of the topics of a kind, and whether they are stamped."""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    simulate_case("husky_tile", out=path, duration_s=10.0, seed=1)
    return path


def add_topics(drive: Path, kind: str, count: int) -> Path:
    """The log of a drive with more topics of five messages each."""
    type_name, fields, name, is_stamped = KINDS[kind]
    one, path = drive.with_name(f"{kind}.mcap"), drive.with_name(f"{kind}_{count}.mcap")
    with drive.open("rb") as stream:
        recorded = list(make_reader(stream).iter_messages())
    stamps = recorded[0][2].log_time + STAMPED
    with LogWriter(one) as log:
        log.write_columns("/x", type_name, stamps, fields, **({"header_time": stamps} if is_stamped else {}))  # type: ignore[arg-type]
    with one.open("rb") as stream:
        more = list(make_reader(stream).iter_messages())
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="a stranger")
        numbers: dict[str, int] = {}
        for topic, messages in [
            *((channel.topic, [(schema, message)]) for schema, channel, message in recorded),
            *((f"/robot/s{number}/{name}", [(s, m) for s, _, m in more]) for number in range(count)),
        ]:
            schema = messages[0][0]
            assert schema is not None
            if topic not in numbers:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[topic] = writer.register_channel(topic, "cdr", known)
            for _, message in messages:
                writer.add_message(
                    numbers[topic], message.log_time, message.data, message.publish_time, message.sequence
                )
        writer.finish()
    return path


def count_calls(monkeypatch: pytest.MonkeyPatch, room: object, name: str) -> list[object]:
    calls: list[object] = []
    inner: Callable[..., object] = getattr(room, name)

    def count(*arguments: object, **options: object) -> object:
        calls.append(arguments)
        return inner(*arguments, **options)

    monkeypatch.setattr(room, name, count)
    return calls


@pytest.mark.parametrize("kind", ["descriptions", "events", "transforms"])
def test_small_topics_are_read_together(drive: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = add_topics(drive, kind, FEW)
    calls = count_calls(monkeypatch, log_choice, "read_topics")
    inspect_log(path, Options())
    assert 0 < len(calls) < 10


def test_of_many_poses_those_with_most_messages_are_compared_and_the_others_counted(
    drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = add_topics(drive, "odometries", FEW)
    calls = count_calls(monkeypatch, pose_choice, "Extraction")
    choice = inspect_log(path, OPTIONS).choice
    assert choice is not None
    assert len(calls) == len(choice.ratings) == MOST_POSES
    assert str(choice.sources.pose) == str(inspect_log(drive, OPTIONS).choice.sources.pose)  # type: ignore[union-attr]
    (finding,) = [one for one in choice.findings if one.id == "poses_left_out"]
    assert finding.count == FEW + 1 - MOST_POSES
    assert (
        format_finding(finding)
        == f"{FEW + 1} topics or frames hold poses: the 40 with most messages were compared"
    )
