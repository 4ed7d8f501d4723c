"""Messages of odometry whose pose contradicts their own speeds."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_drives import DrawnDrive, DrawnTopic, draw_drive, record_cdr, record_twist, stamp_ros, write_drawn

from pipeline.analysis import Options
from pipeline.core import Floats
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.words import format_finding

ODOMETRY = "nav_msgs/msg/Odometry"


def set_up(tmp_path: Path, *topics: DrawnTopic) -> LogSetup:
    return set_up_log(write_drawn(tmp_path / "log.mcap", *topics), Options(out=tmp_path))


def told(setup: LogSetup) -> str:
    return " ".join(format_finding(one) for one in setup.choice.findings)


def follow(values: Floats, share: float = 0.4) -> Floats:
    made = np.zeros(values.size)
    for row in range(1, values.size):
        made[row] = made[row - 1] + share * (values[row - 1] - made[row - 1])
    return made


def record_odometry(
    drive: DrawnDrive, topic: str, frame: str, *, pose: float = 1.0, speeds: float = 1.0, every: int = 1
) -> DrawnTopic:
    """Odometry of a base that follows late, its pose and its speeds with factors."""
    speed, turn = follow(drive.speed), follow(drive.turn)
    step = drive.time[1] * pose
    yaw = np.cumsum(turn) * step
    place = np.cumsum(speed * np.exp(1j * yaw)) * step
    fields: Mapping[str, Any] = {
        **stamp_ros(drive),
        "header.frame_id": frame,
        "child_frame_id": "base_link",
        "pose.pose.position.x": place.real,
        "pose.pose.position.y": place.imag,
        "pose.pose.orientation.z": np.sin(0.5 * yaw),
        "pose.pose.orientation.w": np.cos(0.5 * yaw),
        "twist.twist.linear.x": speeds * speed,
        "twist.twist.angular.z": speeds * turn,
    }
    return record_cdr(drive, topic, ODOMETRY, fields, rows=drive.rows()[::every])


@pytest.mark.parametrize(("topic", "frame"), [("/odom", "odom"), ("/wheel/odometry", "map")])
def test_a_pose_that_is_added_up_without_the_time_step_is_refused(
    topic: str, frame: str, tmp_path: Path
) -> None:
    drive = draw_drive(60.0)
    step = float(drive.time[1])
    setup = set_up(tmp_path, record_twist(drive), record_odometry(drive, topic, frame, pose=1.0 / step))
    text = told(setup)
    assert f"the pose of {topic} turns {1.0 / step:.3g} times as far as its own speeds say" in text
    assert f"without the time step of {step:.3g} s" in text
    assert setup.sources.pose is not None
    assert setup.sources.pose.wheels is not None
    assert not {"command_corrected", "pose_turned", "command_scale"} & {
        one.id for one in setup.choice.findings
    }


def test_another_pose_is_taken_for_one_that_contradicts_itself(tmp_path: Path) -> None:
    drive = draw_drive(60.0)
    noise = np.random.default_rng(2).normal(0.0, 0.01, (2, drive.x.size))
    noisy = replace(drive, x=drive.x + noise[0], y=drive.y + noise[1])
    fields = stamp_ros(drive) | noisy.pose("pose.") | {"header.frame_id": "map"}
    beside = record_cdr(drive, "/other/pose", "geometry_msgs/msg/PoseStamped", fields)
    wrong = record_odometry(drive, "/wheel/odometry", "map", pose=8.0)
    setup = set_up(tmp_path, record_twist(drive), wrong, beside)
    assert str(setup.sources.pose) == "/other/pose"


@pytest.mark.parametrize("has_command", [True, False])
def test_speeds_that_are_changes_of_a_message_are_left_out(*, has_command: bool, tmp_path: Path) -> None:
    drive = draw_drive(60.0)
    step = float(drive.time[1])
    odometry = record_odometry(drive, "/wheel/odometry", "map", speeds=step)
    command = record_twist(drive) if has_command else record_twist(drive, "/other/twist")
    setup = set_up(tmp_path, command, odometry)
    assert f"not divided by the time step of {step:.3g} s; not used: its speeds" in told(setup)
    assert str(setup.sources.pose) == "/wheel/odometry"
    assert setup.sources.wheels is None


@pytest.mark.parametrize(("pose", "speeds"), [(1.0, 1.0), (1.0, 0.7), (0.6, 1.0)])
def test_a_base_that_skids_contradicts_nothing(pose: float, speeds: float, tmp_path: Path) -> None:
    drive = draw_drive(60.0)
    odometry = record_odometry(drive, "/wheel/odometry", "map", pose=pose, speeds=speeds)
    assert "its own speeds say" not in told(set_up(tmp_path, record_twist(drive), odometry))


@pytest.mark.parametrize("every", [1, 4])
def test_speeds_that_are_differences_of_positions_are_those_of_the_way_that_is_gone(
    every: int, tmp_path: Path
) -> None:
    """Of an odometry on a clock that jitters, or sent more often than its encoders are read."""
    of = draw_drive(60.0)
    turn = np.where(of.speed > 0.0, 0.8 * np.sign(np.sin(0.5 * of.time)), 0.0)
    of = replace(of, turn=turn)
    rng = np.random.default_rng(7)
    jitter = 0.0 if every > 1 else rng.uniform(0.0, 0.9 * of.time[1], of.time.size)
    speed, rate = follow(of.speed), follow(of.turn)
    read = np.arange(of.time.size) // every * every
    yaw = (np.cumsum(rate) * of.time[1])[read]
    place = (np.cumsum(speed * np.exp(1j * np.cumsum(rate) * of.time[1])) * of.time[1])[read]
    sent = replace(of, time=of.time + jitter)
    elapsed = np.gradient(sent.time) if every > 1 else np.diff(sent.time, prepend=sent.time[0] - of.time[1])
    moved = (np.diff(place, prepend=0.0) * np.exp(-1j * yaw)).real
    fields: Mapping[str, Any] = {
        **stamp_ros(sent),
        **replace(sent, x=place.real, y=place.imag, yaw=yaw).pose("pose.pose."),
        "header.frame_id": "odom",
        "twist.twist.linear.x": moved / elapsed,
        "twist.twist.angular.z": np.diff(yaw, prepend=0.0) / elapsed,
    }
    setup = set_up(tmp_path, record_twist(of), record_cdr(sent, "/odom", ODOMETRY, fields))
    assert setup.choice.recording is not None
    evidence = {one.name: one for one in setup.choice.recording.evidence}
    for one in (evidence["/cmd_vel"], evidence["/odom"]):
        assert one.ahead == pytest.approx(1.0, abs=0.02)
        assert one.turned == pytest.approx(1.0, abs=0.02)


LOCAL = "px4_msgs/msg/VehicleLocalPosition"
LAYOUT = (
    "uint64 timestamp\nuint64 timestamp_sample\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "float32 vx\nfloat32 vy\nfloat32 heading\n"
)


def record_local(drive: DrawnDrive, *, pose: float = 1.0, speeds: float = 1.0) -> DrawnTopic:
    """North, east and their velocities, as of PX4."""
    course = drive.speed * np.exp(1j * drive.yaw)
    stamp = np.round(drive.time * 1e6).astype(np.int64) + 35_000_000
    fields = {
        "timestamp": stamp,
        "timestamp_sample": stamp,
        "x": pose * drive.y,
        "y": pose * drive.x,
        "z": np.zeros(stamp.size),
        "vx": speeds * course.imag,
        "vy": speeds * course.real,
        "heading": np.pi / 2.0 - drive.yaw,
    }
    return record_cdr(drive, "/fmu/out/vehicle_local_position", LOCAL, fields, LAYOUT)


def record_fix(drive: DrawnDrive, *, pose: float = 1.0, speeds: float = 1.0) -> tuple[DrawnTopic, ...]:
    """Fixes and velocities of one receiver, five a second."""
    rows = drive.rows()[::4]
    stamps = stamp_ros(drive) | {"header.frame_id": "gps"}
    degree = 2.0 * np.pi * 6.371e6 / 360.0
    place = {"latitude": pose * drive.y / degree, "longitude": pose * drive.x / degree}
    course = speeds * drive.speed * np.exp(1j * drive.yaw)
    velocity = {"twist.linear.x": course.real, "twist.linear.y": course.imag}
    return (
        record_cdr(drive, "/gps/fix", "sensor_msgs/msg/NavSatFix", stamps | place, rows=rows),
        record_cdr(
            drive, "/gps/fix_velocity", "geometry_msgs/msg/TwistStamped", stamps | velocity, rows=rows
        ),
    )


@pytest.mark.parametrize(
    ("pose", "speeds", "wrong"), [(1.0, 1.0, ""), (20.0, 1.0, "pose"), (1.0, 0.05, "speeds")]
)
@pytest.mark.parametrize("kind", ["local", "fix"])
def test_positions_are_compared_with_the_velocities_that_are_sent_with_them(
    kind: str, pose: float, speeds: float, wrong: str, tmp_path: Path
) -> None:
    drive = draw_drive(120.0)
    topics = (
        record_fix(drive, pose=pose, speeds=speeds)
        if kind == "fix"
        else (record_local(drive, pose=pose, speeds=speeds),)
    )
    setup = set_up(tmp_path, record_twist(drive), *topics)
    found = [one for one in setup.choice.findings if one.id == "odometry_contradicts_itself"]
    if kind == "fix" and wrong == "pose":
        # The velocities are a pose themselves, which follows the commands better.
        assert str(setup.sources.pose) == "/gps/fix_velocity"
        return
    assert [one.values["kind"] for one in found] == [wrong] * bool(wrong)
    for one in found:
        assert one.value == pytest.approx(20.0, rel=0.1)
