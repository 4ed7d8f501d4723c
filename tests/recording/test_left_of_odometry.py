"""What is left of a log whose poses are computed from the wheels is not taken for a localization."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import (
    GEOMETRY,
    DrawnDrive,
    DrawnTopic,
    draw_drive,
    record_cdr,
    record_json,
    record_twist,
    stamp_ros,
    write_drawn,
)
from drawn_motion import draw, sides

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import Flags, Floats
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.recording.motion import NO_MOTION
from pipeline.recording.outages import find_outages
from pipeline.recording.readings import Reading
from pipeline.words import format_finding

SECONDS = 90.0
UNSTEADY_S = 14.0
"""Time in which an odometry is late by turns, as while a simulator starts: the wheels explain less of it."""
RADIUS, TRACK = 0.1, 0.5


def drive() -> DrawnDrive:
    return draw_drive(SECONDS)


def late(time: Floats) -> Floats:
    """By how much an odometry is late [s]."""
    return np.where(time < UNSTEADY_S, 0.15 + 0.15 * np.sin(5.0 * time), 0.15)


def record_wheels(of: DrawnDrive) -> DrawnTopic:
    """Joints of wheels that do what is commanded."""
    turned = 0.5 * TRACK * of.turn
    rates = np.column_stack([of.speed - turned, of.speed + turned]) / RADIUS
    names = [["left_wheel", "right_wheel"]] * of.time.size
    fields = {"name": names, "velocity": [*rates], "header.frame_id": ""}
    return record_cdr(of, "/joint_states", "sensor_msgs/msg/JointState", stamp_ros(of) | fields)


def record_odometry(of: DrawnDrive, topic: str = "/odom", noise_m: float = 0.0) -> DrawnTopic:
    """An odometry of these wheels, with noise of its positions."""
    at = of.time - late(of.time)
    x, y, yaw = (np.interp(at, of.time, one) for one in (of.x, of.y, of.yaw))
    x, y = (
        one + noise_m * np.random.default_rng(1).normal(size=(2, at.size))[k] for k, one in enumerate((x, y))
    )
    moved = replace(of, x=x, y=y, yaw=yaw)
    fields = (
        stamp_ros(of) | moved.pose("pose.pose.") | {"header.frame_id": "odom", "child_frame_id": "base_link"}
    )
    return record_cdr(of, topic, "nav_msgs/msg/Odometry", fields)


def keep(topic: DrawnTopic, kept: Flags) -> DrawnTopic:
    rows = np.flatnonzero(kept)
    return replace(topic, times=topic.times[rows], messages=[topic.messages[row] for row in rows])


def look(path: Path, topics: Sequence[DrawnTopic]) -> LogSetup:
    return set_up_log(write_drawn(path, *topics), Options(out=path.parent))


def draw_kept(name: str) -> Flags:
    time = drive().time
    chance = np.random.default_rng(3).random(time.size)
    kept = {
        "whole": time >= 0.0,
        "beginning": time < UNSTEADY_S,
        "end": time > 0.8 * SECONDS,
        "third": chance < 0.3,
        "stretches": np.random.default_rng(4).random(100)[(time / 2.0).astype(np.int64)] < 0.3,
    }
    return np.asarray(kept[name])


@pytest.mark.parametrize("name", ["whole", "beginning", "end", "third", "stretches"])
def test_wheel_odometry_is_no_pose_however_little_is_left(name: str, tmp_path: Path) -> None:
    of, kept = drive(), draw_kept(name)
    topics = [keep(one, kept) for one in (record_twist(of), record_wheels(of), record_odometry(of))]
    pose = look(tmp_path / "log.mcap", topics).sources.pose
    assert pose.wheels is not None, f"{pose} is taken for a localization"


@pytest.mark.parametrize("seconds", [SECONDS, 12.0, 6.0])
def test_wheel_odometry_that_is_called_a_localization_is_told_after_seconds(
    seconds: float, tmp_path: Path
) -> None:
    of = drive()
    fields = stamp_ros(of) | of.pose("pose.") | {"header.frame_id": "map"}
    poses = record_cdr(of, "/slam/pose", "geometry_msgs/msg/PoseStamped", fields)
    topics = [keep(one, of.time < seconds) for one in (record_twist(of), record_wheels(of), poses)]
    options = Options(out=tmp_path / "results", report=False, diagnosis=False, overrides=GEOMETRY)
    found = analyze_log(write_drawn(tmp_path / "log.mcap", *topics), options)
    assert "wheel odometry, not a localization" in found.refusal


def test_a_copy_of_wheel_odometry_is_found_though_of_each_other_messages_are_left(tmp_path: Path) -> None:
    """Noise of both hides that they never move sideways: that they are one gives them away."""
    of, chance = drive(), np.random.default_rng(5).random((2, drive().time.size))
    topics = [
        record_twist(of),
        keep(record_odometry(of, noise_m=2e-3), chance[0] < 0.5),
        keep(record_odometry(of, "/base_pose", noise_m=2e-3), chance[1] < 0.5),
    ]
    found = {one.id: format_finding(one) for one in look(tmp_path / "log.mcap", topics).choice.findings}
    assert "it is that of /odom" in found["pose_from_wheels"]


@pytest.mark.parametrize("copy", ["/base_pose", "/pose", "/tf"])
def test_an_odometry_that_another_topic_repeats_still_measures_the_wheels(copy: str, tmp_path: Path) -> None:
    of = drive()
    # What the wheels do: late, and no faster than they can.
    does = replace(
        of,
        speed=np.minimum(0.6, np.interp(of.time - 0.2, of.time, of.speed)),
        turn=np.interp(of.time - 0.2, of.time, of.turn),
    )
    yaw = np.cumsum(does.turn) * np.gradient(of.time)
    x, y = (np.cumsum(does.speed * part) * np.gradient(of.time) for part in (np.cos(yaw), np.sin(yaw)))
    does = replace(does, x=x, y=y, yaw=yaw)
    poses = stamp_ros(does) | does.pose("pose.pose.") | {"header.frame_id": "odom"}
    twist = {"twist.twist.linear.x": does.speed, "twist.twist.angular.z": does.turn}
    odometry = record_cdr(does, "/odom", "nav_msgs/msg/Odometry", poses | twist)
    if copy == "/tf":
        half = 0.5 * yaw
        transforms = [
            {
                "header": {"stamp": {"sec": at // 10**9, "nanosec": at % 10**9}, "frame_id": "odom"},
                "child_frame_id": "base_link",
                "transform": {
                    "translation": {"x": float(x[row]), "y": float(y[row]), "z": 0.0},
                    "rotation": {"x": 0.0, "y": 0.0, "z": np.sin(half[row]), "w": np.cos(half[row])},
                },
            }
            for row, at in enumerate(does.stamps.tolist())
        ]
        messages = [{"transforms": [one]} for one in transforms]
        again = record_json(does, "/tf", "tf2_msgs/msg/TFMessage", messages)
    elif copy == "/pose":
        fields = stamp_ros(does) | does.pose("pose.") | {"header.frame_id": "odom"}
        again = record_cdr(does, copy, "geometry_msgs/msg/PoseStamped", fields)
    else:
        again = record_cdr(does, copy, "nav_msgs/msg/Odometry", poses)
    setup = look(tmp_path / "log.mcap", [record_twist(of), odometry, again])
    said = " ".join(format_finding(one) for one in setup.choice.findings)
    assert str(setup.sources.pose.wheels) == "/odom"
    assert "they are wheel odometry, not a localization" in said
    assert "pose_from_wheels" not in {one.id for one in setup.choice.findings}


def test_of_wheels_beside_which_nothing_is_left_no_outage_is_said() -> None:
    made = sides(draw(2))
    assert find_outages({"left": made.first, "right": made.second}, (0.0, 0.0), Reading(), NO_MOTION) == []


def test_a_flipped_bit_does_not_make_wheel_odometry_a_pose(foreign_logs: Path, tmp_path: Path) -> None:
    """Of a bag of which only the first two fifths are left."""
    whole = foreign_logs / "fuse_turtlebot3.bag"
    content = bytearray(whole.read_bytes())
    content[len(content) // 5] ^= 1
    for path, part in ((whole, None), (tmp_path / "part.bag", content)):
        if part is not None:
            path.write_bytes(part)
        pose = set_up_log(path, Options(out=tmp_path)).sources.pose
        assert pose.wheels is not None, f"{pose} is taken for a localization"
