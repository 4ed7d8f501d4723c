"""Two types on one topic: both are read where both can serve; otherwise it is said what is left out."""

from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    TWIST,
    DrawnDrive,
    DrawnTopic,
    draw_drive,
    extract_drawn,
    read_findings,
    record_cdr,
    record_twist,
    stamp_ros,
    write_drawn,
)

from pipeline.core.arrays import Ints
from pipeline.sources.message_types import find_alike

STAMPED = "geometry_msgs/msg/TwistStamped"
POSE, COVARIANCE = (f"geometry_msgs/msg/{name}Stamped" for name in ("Pose", "PoseWithCovariance"))


def record_stamped(drive: DrawnDrive, rows: Ints) -> DrawnTopic:
    fields = {"twist.linear.x": drive.speed, "twist.angular.z": drive.turn} | stamp_ros(drive)
    return record_cdr(drive, "/cmd_vel", STAMPED, fields, rows=rows)


def record_plain(drive: DrawnDrive, rows: Ints) -> DrawnTopic:
    fields = {"linear.x": drive.speed, "angular.z": drive.turn}
    return record_cdr(drive, "/cmd_vel", TWIST, fields, rows=rows)


def record_pose(drive: DrawnDrive, kind: str = POSE, rows: Ints | None = None) -> DrawnTopic:
    prefix = "pose.pose." if kind == COVARIANCE else "pose."
    return record_cdr(drive, "/icp", kind, drive.pose(prefix) | stamp_ros(drive), rows=rows)


@pytest.mark.parametrize("change_s", [10.0, 20.0], ids=["mostly stamped", "mostly plain"])
def test_commands_of_two_types_are_one_series(change_s: float, tmp_path: Path) -> None:
    drive = draw_drive()
    plain, stamped = (
        record_plain(drive, drive.rows(0.0, change_s)),
        record_stamped(drive, drive.rows(change_s)),
    )
    log = write_drawn(tmp_path / "run.mcap", plain, stamped, record_pose(drive))
    commands = extract_drawn(log, "commands")
    np.testing.assert_allclose(commands["body_x"], drive.speed)
    np.testing.assert_allclose(commands["body_w"], drive.turn)
    (shown,) = extract_drawn(log, "findings").filter(id="several_types").to_dicts()
    assert shown["severity"] == "warning"
    said = shown["text"]
    assert said.startswith(f"/cmd_vel carries two types, both read: {TWIST} and {STAMPED}")
    assert "the times of recording are used" in said


def test_poses_of_two_types_keep_their_stamps(tmp_path: Path) -> None:
    drive = draw_drive()
    first, second = (
        record_pose(drive, kind, rows)
        for kind, rows in ((POSE, drive.rows(0.0, 15.0)), (COVARIANCE, drive.rows(15.0)))
    )
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), first, second)
    np.testing.assert_allclose(extract_drawn(log)["x"], drive.x)
    assert "times of recording" not in read_findings(log)["several_types"]


def test_a_type_that_cannot_serve_is_left_out_with_its_time(tmp_path: Path) -> None:
    drive = draw_drive()
    words = record_cdr(
        drive, "/cmd_vel", "std_msgs/msg/String", {"data": "forward"}, rows=drive.rows(0.0, 10.0)
    )
    log = write_drawn(tmp_path / "run.mcap", words, record_plain(drive, drive.rows(10.0)), record_pose(drive))
    np.testing.assert_allclose(extract_drawn(log, "commands")["body_x"], drive.speed[drive.rows(10.0)])
    said = read_findings(log)["type_left_out"]
    assert "200 messages of std_msgs/msg/String, 0 to 10 s after the start of the log, are left out" in said
    assert "several_types" not in read_findings(log)


def test_types_are_alike_by_meaning_and_unit() -> None:
    twist = ("linear.x", "angular.z")
    assert find_alike(TWIST, twist)["geometry_msgs/TwistStamped"] == {
        "linear.x": "twist.linear.x",
        "angular.z": "twist.angular.z",
    }
    assert "nav_msgs/Odometry" not in find_alike(TWIST, twist)
    pose = find_alike(POSE, [f"pose.position.{axis}" for axis in "xyz"])
    assert pose["nav_msgs/Odometry"]["pose.position.x"] == "pose.pose.position.x"
    assert "px4_msgs/VehicleOdometry" not in pose
    assert "geometry_msgs/Pose2D" not in find_alike(POSE, ["pose.position.z"])
    ticks = find_alike("duckietown_msgs/WheelEncoderStamped", ["data"])
    assert "std_msgs/Float32" not in ticks
    assert find_alike("std_msgs/Float32", ["data"])["std_msgs/Float64"] == {"data": "data"}
    assert find_alike("lab_msgs/Unknown", ["data"]) == {}
