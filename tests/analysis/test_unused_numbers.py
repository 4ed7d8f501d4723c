"""Topics of two numbers a message are named, with the lines that take them for wheels."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    DrawnDrive,
    DrawnTopic,
    draw_drive,
    extract_drawn,
    read_findings,
    record_cdr,
    record_json,
    record_twist,
    write_drawn,
)

from pipeline.core import SlipError

POSE = "geometry_msgs/msg/PoseStamped"


def wheel_speeds(drive: DrawnDrive) -> np.ndarray:
    """Left and right [rad/s], of wheels of 0.1 m and a track of 0.5 m."""
    return np.stack([(drive.speed + side * 0.25 * drive.turn) / 0.1 for side in (-1.0, 1.0)], axis=1)


def record_numbers(drive: DrawnDrive, values: np.ndarray, topic: str = "/wheel_speeds") -> DrawnTopic:
    return record_cdr(drive, topic, "std_msgs/msg/Float32MultiArray", {"data": values})


@pytest.mark.parametrize(("topic", "role"), [("/wheel_speeds", "wheels"), ("/motor_cmd", "command")])
def test_two_numbers_a_message_are_named_with_the_lines_that_use_them(
    topic: str, role: str, tmp_path: Path
) -> None:
    drive = draw_drive()
    speeds = wheel_speeds(drive)
    pose = record_cdr(drive, "/icp", POSE, drive.pose("pose."))
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), pose, record_numbers(drive, speeds, topic))
    said = read_findings(log)["numbers_not_used"]
    left, right = (
        f'{side}_topic = "{topic}.data[{number}]"' for number, side in enumerate(("left", "right"))
    )
    assert said.startswith(f"not used: {topic} (two numbers a message)")
    assert f"{role} = {{{left}, {right}}}" in said
    lines = "\n".join((f"[{role}]", left, right, 'unit = "rad/s"'))
    (tmp_path / "run.toml").write_text(lines, encoding="utf-8")
    table = extract_drawn(log, "wheels" if role == "wheels" else "commands")
    for side, values in zip(("left", "right"), speeds.T, strict=True):
        np.testing.assert_allclose(table[side], values, rtol=1e-6)
    assert "numbers_not_used" not in read_findings(log)


def test_four_numbers_of_motors_are_named(tmp_path: Path) -> None:
    drive = draw_drive()
    pose = record_cdr(drive, "/icp", POSE, drive.pose("pose."))
    speeds = record_numbers(drive, np.repeat(wheel_speeds(drive), 2, axis=1), "/motor_rpm")
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), pose, speeds)
    said = read_findings(log)["numbers_not_used"]
    assert said.startswith("not used: /motor_rpm (four numbers a message)")
    # The first two may be of one side.
    assert "put the number of a left one for 0 and that of a right one for 1" in said


def test_a_topic_with_quotes_is_written_as_toml_reads_it(tmp_path: Path) -> None:
    drive = draw_drive()
    pose = record_cdr(drive, "/icp", POSE, drive.pose("pose."))
    topic = '/the "fast\\slow" wheels'
    speeds = record_numbers(drive, wheel_speeds(drive), topic)
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), pose, speeds)
    said = read_findings(log)["numbers_not_used"]
    line = said.partition("in run.toml: ")[2].partition(" (the motion")[0]
    assert tomllib.loads(line) == {
        "wheels": {"left_topic": f"{topic}.data[0]", "right_topic": f"{topic}.data[1]"}
    }


@pytest.mark.parametrize(
    "values", [np.zeros((600, 2)), np.ones((600, 3)) * np.arange(600)[:, None]], ids=["still", "three"]
)
def test_other_numbers_are_not_named(values: np.ndarray, tmp_path: Path) -> None:
    drive = draw_drive()
    pose = record_cdr(drive, "/icp", POSE, drive.pose("pose."))
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), pose, record_numbers(drive, values))
    assert "numbers_not_used" not in read_findings(log)


def test_without_commands_such_a_topic_may_be_named(tmp_path: Path) -> None:
    drive = draw_drive()
    pose = record_cdr(drive, "/icp", POSE, drive.pose("pose."))
    log = write_drawn(tmp_path / "run.mcap", pose, record_numbers(drive, wheel_speeds(drive)))
    with pytest.raises(SlipError, match=r"Name it in run\.toml") as caught:
        extract_drawn(log)
    assert caught.value.code == "no_command"


@pytest.mark.parametrize("split", [False, True], ids=["one message", "two topics"])
def test_left_and_right_numbers_of_an_unknown_type_are_named_with_the_lines_that_use_them(
    split: bool,  # noqa: FBT001
    tmp_path: Path,
) -> None:
    drive = draw_drive()
    speeds = wheel_speeds(drive)
    if split:
        names = ("/left_ticks.data", "/right_ticks.data")
        counts = np.cumsum(speeds, axis=0).astype(np.int64)
        topics = [
            record_cdr(drive, name.removesuffix(".data"), "std_msgs/msg/Int64", {"data": values})
            for name, values in zip(names, counts.T, strict=True)
        ]
    else:
        names = ("/wheels.left_speed", "/wheels.right_speed")
        fields = [{"left_speed": left, "right_speed": right} for left, right in speeds.tolist()]
        topics = [record_json(drive, "/wheels", "own.Wheels", fields)]
    pose = record_cdr(drive, "/icp", POSE, drive.pose("pose."))
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), pose, *topics)
    said = read_findings(log)["numbers_not_used"]
    left, right = (f'{side}_topic = "{name}"' for side, name in zip(("left", "right"), names, strict=True))
    assert f"wheels = {{{left}, {right}" in said
    unit = 'unit = "ticks"\nper_turn = 1000' if split else 'unit = "rad/s"'
    (tmp_path / "run.toml").write_text(f"[wheels]\n{left}\n{right}\n{unit}", encoding="utf-8")
    assert not extract_drawn(log, "wheels").is_empty()
    assert "numbers_not_used" not in read_findings(log)
