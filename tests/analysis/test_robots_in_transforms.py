"""Several robots in one topic of transforms: the command's robot is taken, and the others are named."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    DrawnDrive,
    DrawnTopic,
    draw_drive,
    extract_drawn,
    record_cdr,
    record_twist,
    write_drawn,
)

TRANSFORMS = "tf2_msgs/msg/TFMessage"


def record_transforms(
    drive: DrawnDrive, robots: Mapping[str, tuple[str, float]], topic: str = "/tf"
) -> DrawnTopic:
    """Bodies by frame: their parent, and the share of the drive's motion that they make."""
    count, frames = drive.time.size, len(robots)
    whole, rest = (np.repeat(one[:, None], frames, axis=1) for one in np.divmod(drive.stamps, 10**9))
    shares = np.array([share for _, share in robots.values()])
    fields = {
        "transforms[].header.stamp.sec": whole,
        "transforms[].header.stamp.nanosec": rest,
        "transforms[].header.frame_id": [[parent for parent, _ in robots.values()]] * count,
        "transforms[].child_frame_id": [list(robots)] * count,
        "transforms[].transform.translation.x": drive.x[:, None] * shares,
        "transforms[].transform.translation.y": drive.y[:, None] * shares,
        "transforms[].transform.rotation.z": np.sin(np.outer(drive.yaw, shares) / 2.0),
        "transforms[].transform.rotation.w": np.cos(np.outer(drive.yaw, shares) / 2.0),
    }
    return record_cdr(drive, topic, TRANSFORMS, fields)


@pytest.mark.parametrize(
    ("command", "frame"),
    [
        ("/robot1/cmd_vel", "robot{}/base_link"),
        ("/fleet/robot1/base/cmd_vel", "robot{}/base_footprint"),
        ("/robot1/cmd_vel", "robot{}_base_link"),
    ],
)
def test_the_robot_of_the_command_is_taken(command: str, frame: str, tmp_path: Path) -> None:
    drive = draw_drive()
    robots = {frame.format(0): ("map", 0.4), frame.format(1): ("map", 1.0), frame.format(2): ("map", 0.7)}
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive, command), record_transforms(drive, robots))
    np.testing.assert_allclose(extract_drawn(log)["x"], drive.x, atol=1e-9)
    findings = {one["id"]: one for one in extract_drawn(log, "findings").to_dicts()}
    if "/" in frame:
        assert findings["several_robots"]["severity"] == "info"
        assert f"{frame.format(1)} is taken" in findings["several_robots"]["text"]
        assert frame.format(2) in findings["several_robots"]["text"]


def test_where_no_namespace_tells_all_are_named(tmp_path: Path) -> None:
    drive = draw_drive()
    robots = {"alice/base_link": ("map", 1.0), "bob/base_link": ("map", 0.4)}
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), record_transforms(drive, robots))
    (said,) = [one for one in extract_drawn(log, "findings").to_dicts() if one["id"] == "several_robots"]
    assert said["severity"] == "warning"
    assert "alice/base_link and bob/base_link" in said["text"]
    assert "[pose] frames" in said["text"]


def test_an_arm_on_the_robot_is_no_other_robot(tmp_path: Path) -> None:
    drive = draw_drive()
    robots = {"base_link": ("map", 1.0), "arm/base_link": ("base_link", 0.0)}
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive), record_transforms(drive, robots))
    np.testing.assert_allclose(extract_drawn(log)["x"], drive.x, atol=1e-9)
    assert "several_robots" not in [one["id"] for one in extract_drawn(log, "findings").to_dicts()]


def test_equal_frames_in_namespaces_are_those_of_each_robot(tmp_path: Path) -> None:
    drive = draw_drive()
    shares = {"/robot1/tf": 0.4, "/robot2/tf": 1.0}
    transforms = [
        record_transforms(drive, {"base_link": ("map", share)}, topic) for topic, share in shares.items()
    ]
    log = write_drawn(tmp_path / "run.mcap", record_twist(drive, "/robot2/cmd_vel"), *transforms)
    np.testing.assert_allclose(extract_drawn(log)["x"], drive.x, atol=1e-9)
